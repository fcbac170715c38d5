# SPDX-License-Identifier: Apache-2.0
"""From a video without poses to objects: cameras beside the true ones of a generated and a real room."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest

from raytran.capture.open import open_scene
from raytran.data.scannet.scan import read_scan
from raytran.rooms.generate import generate_rooms

from ..capture.forms import Walk, write_video
from ..capture.poses.box_room import aligned

pytest.importorskip("pycolmap", reason="pycolmap, which finds the cameras, is not installed")
pytestmark = pytest.mark.nightly


def compared(folder, true):
    """Return share of the frames, largest error of positions (m), of up (degrees), of scale (a part)."""
    with open_scene(folder) as scan:
        found = scan.world_from_camera.double().numpy()
        numbers = [int(name) for name in scan.frame_id]
    fitted, scale = aligned(found, true[numbers])
    error = np.linalg.norm(fitted[:, :3, 3] - true[numbers][:, :3, 3], axis=1)
    turn = fitted[0, :3, :3] @ found[0, :3, :3].T
    up_deg = np.degrees(np.arccos(np.clip(turn[2, 2], -1, 1)))
    return len(numbers) / len(true), float(error.max()), float(up_deg), float(scale - 1)


def test_a_generated_room_from_its_video_alone(command, tmp_path):
    root = tmp_path / "rooms"
    size = (240, 320)
    generate_rooms(
        root, num_train=1, num_val=0, seed=5, frames=150, image_size=size, room_size=((3, 4), (3, 4)),
        min_objects=6, max_objects=10, processes=1, progress=False,
    )  # fmt: skip
    scan = read_scan(next((root / "scannet" / "scans").iterdir()))
    true = scan.world_from_camera.double().numpy()
    images = tmp_path / "film" / "images"
    images.mkdir(parents=True)
    names = tuple(f"{number}.jpg" for number in range(len(scan)))
    for name, path in zip(names, scan.image_path, strict=True):
        shutil.copy(path, images / name)
    write_video(Walk(tmp_path / "film", names, true, size, (1, 1, 1, 1)), tmp_path / "walk.mp4")
    floor = -float(scan.axis_alignment[2, 3])
    height = true[:, 2, 3].mean() - floor
    made = command("poses", "walk.mp4", f"camera_height={height:.3f}", folder=tmp_path)
    assert made.returncode == 0, made.stderr
    assert "next: raytran predict outputs/scans/walk" in made.stdout
    share, error, up_deg, scale = compared(tmp_path / "outputs" / "scans" / "walk", true)
    assert share > 0.8
    assert error < 0.05
    assert up_deg < 2.0
    assert abs(scale) < 0.05
    predicted = command("predict", "outputs/scans/walk", folder=tmp_path)
    assert predicted.returncode == 0, predicted.stderr
    result = json.loads((tmp_path / "outputs" / "predictions" / "walk" / "scene.json").read_text())
    assert result["objects"]


def test_a_real_room_of_which_little_hangs_together(command, shared_dir, tmp_path):
    """Every fourth frame of a walk: a third is placed, and where it is placed it is right."""
    source = read_scan(shared_dir / "realdata" / "hololens_lounge" / "scans" / "hololens_000")
    for number, path in enumerate(source.image_path):
        (tmp_path / "film").mkdir(exist_ok=True)
        shutil.copy(path, tmp_path / "film" / f"{number}.jpg")
    made = command("poses", "film", "output=lounge", "camera_height=1.64", folder=tmp_path)
    assert made.returncode == 0, made.stderr
    assert "placed only" in made.stdout
    true = source.world_from_camera.double().numpy()
    share, error, up_deg, scale = compared(tmp_path / "lounge", true)
    assert share > 0.2
    assert error < 0.15
    assert up_deg < 3.0
    assert abs(scale) < 0.1
