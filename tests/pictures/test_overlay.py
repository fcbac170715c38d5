# SPDX-License-Identifier: Apache-2.0
"""Objects drawn over frames lie where the camera sees them."""

from __future__ import annotations

import numpy as np
import torch
import trimesh
from PIL import Image

from raytran.pictures.overlay import draw_overlays
from raytran.structs import ObjectSet, ScenePrediction, Views

UPRIGHT = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
BLUE = np.array([31, 119, 180])


def walk(count: int) -> Views:
    """White frames of 120 × 160 taken along +y, from y = 0 on, 10 cm apart."""
    pose = torch.eye(4)[None].repeat(count, 1, 1)
    pose[:, :3, :3] = torch.tensor([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    pose[:, 1, 3] = torch.arange(count) * 0.1
    intrinsics = torch.tensor([[100.0, 0, 80], [0, 100, 60], [0, 0, 1]]).expand(count, 3, 3)
    images = torch.full((1, count, 3, 120, 160), 255, dtype=torch.uint8)
    return Views(images, intrinsics[None], pose[None])


def one_chair() -> tuple[ScenePrediction, list[trimesh.Trimesh | None]]:
    objects = ObjectSet(
        label=torch.tensor([3]),
        center=torch.tensor([[0.6, 4.0, 0.0]]),
        size=torch.tensor([[1.0, 1.0, 1.0]]),
        rotation=UPRIGHT[None],
        symmetry=torch.ones(1, dtype=torch.int64),
        score=torch.tensor([0.9]),
    )
    mesh = trimesh.creation.icosphere(radius=0.4)
    mesh.apply_translation([0.6, 4.0, 0.0])
    return ScenePrediction("room", objects, torch.zeros(3)), [mesh]


def blueness(path) -> np.ndarray:
    """How far each pixel is from white, 0, to the blue of the chair, 1, by its red."""
    pixels = np.asarray(Image.open(path)).astype(float)
    return (255 - pixels[..., 0]) / (255 - BLUE[0])


def test_mesh_and_box_lie_where_the_chair_is(tmp_path):
    prediction, meshes = one_chair()
    paths = draw_overlays(tmp_path, walk(1), ["0"], prediction, meshes, count=1, min_height=120)
    assert [path.name for path in paths] == ["0.jpg"]
    seen = blueness(paths[0])
    assert seen.shape == (120, 160)
    # The sphere's centre is at u = 80 + 100 · 0.6 / 4 = 95, v = 60; its radius is 10 pixels.
    assert 0.3 < seen[56:64, 91:99].mean() < 0.95
    # The near face of the box is 3.5 m away: u from 82.9 to 111.4, v from 45.7 to 74.3.
    assert seen[50:70, 80:86].max() > 0.5
    # No ink outside the box, but for the name above it.
    assert seen[:, :60].max() < 0.1
    assert seen[80:].max() < 0.1


def test_frames_are_spread_over_the_walk_and_enlarged(tmp_path):
    prediction, _ = one_chair()
    names = [f"{10 * n}" for n in range(9)]
    paths = draw_overlays(tmp_path, walk(9), names, prediction, [None], count=3, min_height=240)
    assert [path.stem for path in paths] == ["10", "40", "70"]
    assert Image.open(paths[0]).size == (320, 240)


def test_no_objects_leave_the_frame_as_it_was(tmp_path):
    nothing = ScenePrediction("room", ObjectSet.empty(), torch.zeros(3))
    paths = draw_overlays(tmp_path, walk(2), ["a", "b"], nothing, [], min_height=120)
    assert len(paths) == 2
    assert all(np.asarray(Image.open(path)).min() == 255 for path in paths)


def test_a_camera_inside_the_object(tmp_path):
    prediction, meshes = one_chair()
    views = walk(1)
    views.world_from_camera[0, 0, :3, 3] = torch.tensor([0.6, 4.0, 0.0])
    paths = draw_overlays(tmp_path, views, ["0"], prediction, meshes, min_height=120)
    assert blueness(paths[0]).mean() > 0.3
