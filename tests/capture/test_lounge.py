# SPDX-License-Identifier: Apache-2.0
"""One real walk in every form, seen by a fixed network: the same places."""

from __future__ import annotations

import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch

from raytran.capture.open import open_scene
from raytran.capture.orientation import WorldSettings
from raytran.data.scan import even_views
from raytran.data.scannet.scan import read_scan
from raytran.run.entry import compose
from raytran.run.train.build import build_model

from .forms import Walk, tum_line, words, write_colmap, write_transforms, write_video

FRAMES = 8
Y_UP = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])


@pytest.fixture(scope="module")
def network():
    """An untrained network that is the same each time, with queries that keep their order."""
    torch.manual_seed(0)
    small = ["preset=tiny", "model.grid_resolution=[8,8,4]", "model.heads.objects.queries=null"]
    return build_model(compose("train", [*small, "output_dir=x"])).eval()


@pytest.fixture
def lounge(shared_dir, tmp_path):
    """Eight frames of the lounge in ScanNet's layout, ``walk``."""
    source = read_scan(shared_dir / "realdata" / "hololens_lounge" / "scans" / "hololens_000")
    folder = tmp_path / "walk"
    for part in ("color", "pose", "intrinsic"):
        (folder / part).mkdir(parents=True)
    for n in range(0, 96, 96 // FRAMES):
        shutil.copy(source.image_path[n], folder / "color")
        np.savetxt(folder / "pose" / f"{source.frame_id[n]}.txt", source.world_from_camera[n])
    matrix = np.eye(4)
    matrix[:3, :3] = source.intrinsics[0]
    np.savetxt(folder / "intrinsic" / "intrinsic_color.txt", matrix)
    return folder


@pytest.fixture
def walk(lounge, tmp_path):
    """The same frames, to be written in other forms."""
    scan = read_scan(lounge)
    folder = tmp_path / "other"
    shutil.copytree(lounge / "color", folder / "images")
    fx, fy, cx, cy = (float(scan.intrinsics[0, i, j]) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
    names = tuple(path.name for path in scan.image_path)
    return Walk(folder, names, scan.world_from_camera.numpy(), scan.image_size, (fx, fy, cx, cy))


def predicted(network, scene, **settings):
    """Return the centres in which the network places its queries, metres in the world."""
    with open_scene(scene, settings=WorldSettings(check=False, **settings)) as scan:
        views, _ = even_views(scan, image_size=(48, 64), num_views=FRAMES)
    with torch.no_grad():
        return network(views, tasks=("objects",)).objects[-1].center.numpy()


def test_every_form_of_the_lounge_gives_the_same_objects(network, lounge, walk, tmp_path):
    expected = predicted(network, lounge)
    for binary in (True, False):
        model = walk.folder / "sparse" / "0"
        write_colmap(walk, model, binary=binary)
        np.testing.assert_allclose(predicted(network, walk.folder), expected, atol=0.01)
        shutil.rmtree(model)
    write_transforms(walk)
    np.testing.assert_allclose(predicted(network, walk.folder), expected, atol=0.01)
    turned = replace(walk, poses=Y_UP @ walk.poses)
    write_transforms(turned)
    np.testing.assert_allclose(predicted(network, walk.folder), expected, atol=0.01)
    millimetres = walk.poses.copy()
    millimetres[:, :3, 3] *= 1000
    write_transforms(replace(walk, poses=millimetres))
    np.testing.assert_allclose(predicted(network, walk.folder, scale=0.001), expected, atol=0.01)
    # The tolerance is small enough: without the scale it would be another scene.
    assert np.abs(predicted(network, walk.folder) - expected).max() > 1


def test_a_video_of_the_lounge_gives_the_same_objects(network, lounge, walk, tmp_path):
    pytest.importorskip("av", reason="PyAV, the reader of videos, is not installed")
    folder = tmp_path / "video"
    folder.mkdir()
    write_video(walk, folder / "walk.mp4")
    lines = [tum_line(n / 10, pose) for n, pose in enumerate(walk.poses)]
    (folder / "walk.txt").write_text("\n".join(lines))
    (folder / "walk.intrinsics.txt").write_text(words(walk.camera))
    expected = predicted(network, lounge)
    np.testing.assert_allclose(predicted(network, folder / "walk.mp4"), expected, atol=0.01)
