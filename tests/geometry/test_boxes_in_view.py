# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import torch

from raytran.geometry.boxes import OrientedBoxes
from raytran.geometry.boxes_in_view import boxes_in_view
from raytran.geometry.camera import Cameras
from raytran.geometry.rotation import rotation_from_yaw

from ..scan_forms import INTRINSICS, look_along_x

CAMERAS = Cameras(
    torch.tensor(np.array(INTRINSICS)[:3, :3]).expand(2, 3, 3),
    torch.from_numpy(np.stack([look_along_x(0.0), look_along_x(1.0)])),
    (32, 48),
)
"""Both look along +x from (0, 0, 1) and (1, 0, 1)."""


def seen(center, size=(0.5, 0.5, 0.5), yaw=0.3, cameras=CAMERAS):
    boxes = OrientedBoxes(
        torch.tensor([center], dtype=torch.float64),
        torch.tensor([size], dtype=torch.float64),
        rotation_from_yaw(torch.tensor([yaw], dtype=torch.float64)),
    )
    return boxes_in_view(boxes, cameras).tolist()[0]


def test_boxes_ahead_are_seen_and_others_are_not():
    assert seen([3.0, 0, 1])
    assert not seen([-3.0, 0, 1])
    assert not seen([3.0, 9, 1])
    assert seen([0.9, 0, 1])  # by the first camera alone


def test_a_part_of_a_box_is_enough():
    assert not seen([3.0, 2.5, 1])
    assert seen([3.0, 2.5, 1], size=(0.5, 0.5, 4.0), yaw=0.0)
    assert seen([0.0, 0, 1], size=(8.0, 0.5, 0.5), yaw=0.0)


def test_what_is_further_than_any_room_is_not_seen():
    assert seen([18.0, 0, 1])
    assert not seen([30.0, 0, 1])


def test_nothing_is_seen_beside_the_picture():
    cropped = Cameras(
        CAMERAS.intrinsics,
        CAMERAS.world_from_camera,
        (32, 48),
        torch.tensor([[0.0, 0, 10, 32]], dtype=torch.float64).expand(2, 4),
    )
    assert not seen([5.0, 0, 1], cameras=cropped)
