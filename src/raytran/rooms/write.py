# SPDX-License-Identifier: Apache-2.0
"""Writes a scene in the layouts of ScanNet, ShapeNet and Scan2CAD: images, poses, CAD models, annotation."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageFilter
from scipy.spatial.transform import Rotation

from raytran.data.files import finished_folder, write_text
from raytran.data.shapenet.models import copy_model
from raytran.rooms.film import BRIGHTEST, Film, moved_blur
from raytran.rooms.objects import PlacedObject
from raytran.rooms.scene import Scene
from raytran.rooms.shapenet_files import write_model

FRAME_STEP = 10
"""Step of the frame numbers, as in exports that keep every tenth frame of a video."""

_SYMMETRY = {1: "__SYM_NONE", 2: "__SYM_ROTATE_UP_2", 4: "__SYM_ROTATE_UP_4", 0: "__SYM_ROTATE_UP_INF"}
_JPEG_QUALITY = 90


def write_scene(scene: Scene, *, scan_id: str, root: Path, rng: np.random.Generator) -> int:
    """Write a scene below ``root``; the scan's folder gets its name last, when everything else is written.

    Args:
        scene: what to write.
        scan_id: e.g. ``scene0000_00``.
        root: the data set.
        rng: source of the lost poses and the noise of the images.

    Returns:
        the number of objects.
    """
    for model in (placed.model for placed in scene.objects):
        if model.source is None:
            write_model(model, root / "shapenet")
        else:
            copy_model(model.source, model.catid, model.model_id, root / "shapenet")
    annotation = annotate(scene, scan_id=scan_id, rng=rng)
    write_text(annotation_path(root, scan_id), json.dumps(annotation))
    scans = root / "scannet" / "scans"
    with finished_folder(scans / scan_id) as folder:
        for name in ("color", "pose", "intrinsic"):
            (folder / name).mkdir()
        if scene.film is None:
            count = _write_frames(scene, folder, rng)
        else:
            count = _write_film(scene, scene.film, folder, rng)
        _write_scan_facts(scene, folder, scan_id, count)
    return len(scene.objects)


def annotation_path(root: Path, scan_id: str) -> Path:
    """Return the file that holds one scan's entry of ``full_annotations.json``."""
    return root / "scan2cad" / "scans" / f"{scan_id}.json"


def annotate(scene: Scene, *, scan_id: str, rng: np.random.Generator) -> dict[str, Any]:
    """Return a scene's entry of Scan2CAD's ``full_annotations.json``.

    Scan2CAD's world is y-up: the scan is rotated by -90 degrees about x and shifted, and CAD models are
    placed in that world.
    """
    world_from_scan = np.eye(4)
    world_from_scan[:3, :3] = [[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]
    world_from_scan[:3, 3] = rng.uniform(-3.0, 3.0, size=3)
    world_from_room = world_from_scan @ scene.scan_from_room
    return {
        "id_scan": scan_id,
        "id_alignment": rng.bytes(12).hex(),
        "n_aligned_models": len(scene.objects),
        "trs": _trs(world_from_scan, np.ones(3)),
        "aligned_models": [_aligned_model(placed, world_from_room) for placed in scene.objects],
    }


def _aligned_model(placed: PlacedObject, world_from_room: NDArray[np.float64]) -> dict[str, Any]:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = placed.rotation, placed.translation
    center, half = placed.cad_box
    no_keypoints = {"n_keypoints": 0, "position": []}
    return {
        "trs": _trs(world_from_room @ pose, placed.scale),
        "bbox": half.tolist(),
        "center": center.tolist(),
        "sym": _SYMMETRY[placed.model.symmetry],
        "catid_cad": placed.model.catid,
        "id_cad": placed.model.model_id,
        "keypoints_cad": no_keypoints,
        "keypoints_scan": no_keypoints,
    }


def _trs(pose: NDArray[np.float64], scale: NDArray[np.float64]) -> dict[str, list[float]]:
    x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat()
    rotation = [float(value) for value in (w, x, y, z)]
    return {"translation": pose[:3, 3].tolist(), "rotation": rotation, "scale": scale.tolist()}


def _write_frames(scene: Scene, folder: Path, rng: np.random.Generator) -> int:
    """Write pictures and poses, two or three of the poses lost; return how many frames there are."""
    height, width = scene.cameras[0].image_size
    grain = rng.standard_normal((height + 32, width + 32, 3), dtype=np.float32) * np.float32(
        rng.uniform(1.0, 3.0)
    )
    lost_after = set(
        rng.choice(len(scene.cameras), size=min(int(rng.integers(2, 4)), len(scene.cameras)), replace=False)
    )
    number = 0
    for index, camera in enumerate(scene.cameras):
        shift = rng.integers(33, size=2)
        noise = grain[shift[0] : shift[0] + height, shift[1] : shift[1] + width]
        picture = Image.fromarray(scene.renderer.render(camera, noise))
        _write_frame(folder, number, picture, scene.scan_from_room @ camera.room_from_camera)
        number += FRAME_STEP
        if index in lost_after:
            # Tracking is lost in fast motion, which blurs the image.
            _write_frame(
                folder, number, picture.filter(ImageFilter.BoxBlur(width / 80)), np.full((4, 4), -np.inf)
            )
            number += FRAME_STEP
    return number // FRAME_STEP


def _write_film(scene: Scene, film: Film, folder: Path, rng: np.random.Generator) -> int:
    """Write pictures as a telephone takes them and poses as it tracks them; return how many frames there are.

    Where tracking is lost the picture is blurred most.
    """
    count = len(scene.cameras)
    lost_after = set(rng.choice(count, size=int(rng.integers(0, min(4, count + 1))), replace=False))
    tracked = scene.tracked if scene.tracked is not None else [c.room_from_camera for c in scene.cameras]
    light = [scene.renderer.radiance(camera, BRIGHTEST) for camera in scene.cameras]
    usual = float(np.mean([np.minimum(each[:, ::4, ::4], 2.0).mean() for each in light]))
    turns = np.gradient(np.stack([camera.room_from_camera[:2, 2] for camera in scene.cameras]), axis=0)
    number = 0
    for index, pose in enumerate(tracked):
        motion = np.array([np.linalg.norm(turns[index]), 0.0]) + rng.normal(0, 0.15, size=2)
        picture = Image.fromarray(film.develop(light[index], usual, motion, rng))
        quality = int(rng.integers(film.quality[0], film.quality[1] + 1))
        _write_frame(folder, number, picture, scene.scan_from_room @ pose, quality=quality)
        number += FRAME_STEP
        if index in lost_after:
            blurred = Image.fromarray(
                film.develop(moved_blur(light[index], motion, 12.0), usual, motion, rng)
            )
            _write_frame(folder, number, blurred, np.full((4, 4), -np.inf), quality=quality)
            number += FRAME_STEP
    return number // FRAME_STEP


def _write_frame(
    folder: Path,
    number: int,
    picture: Image.Image,
    pose: NDArray[np.float64],
    *,
    quality: int = _JPEG_QUALITY,
) -> None:
    picture.save(folder / "color" / f"{number}.jpg", quality=quality)
    (folder / "pose" / f"{number}.txt").write_text(_matrix_text(pose), encoding="ascii")


def _matrix_text(matrix: NDArray[np.float64]) -> str:
    return "".join(" ".join(f"{value:f}" for value in row) + "\n" for row in matrix)


def _write_scan_facts(scene: Scene, folder: Path, scan_id: str, count: int) -> None:
    """Write the intrinsics and ``<scan>.txt``, whose ``axisAlignment`` sets the room straight."""
    camera = scene.cameras[0]
    height, width = camera.image_size
    known = camera.intrinsics if scene.calibrated is None else scene.calibrated
    intrinsics = np.eye(4)
    intrinsics[:3, :3] = known
    (folder / "intrinsic" / "intrinsic_color.txt").write_text(_matrix_text(intrinsics), encoding="ascii")
    centered = np.eye(4)
    centered[:2, 3] = -np.array(scene.room.size[:2]) / 2
    alignment = centered @ np.linalg.inv(scene.scan_from_room)
    facts = {
        "axisAlignment": " ".join(f"{value:f}" for value in alignment.ravel()),
        "colorHeight": height,
        "colorWidth": width,
        "fx_color": f"{known[0, 0]:f}",
        "fy_color": f"{known[1, 1]:f}",
        "mx_color": f"{known[0, 2]:f}",
        "my_color": f"{known[1, 2]:f}",
        "numColorFrames": count,
        "sceneType": scene.room.kind.capitalize(),
    }
    text = "".join(f"{key} = {value}\n" for key, value in facts.items())
    (folder / f"{scan_id}.txt").write_text(text, encoding="ascii")
