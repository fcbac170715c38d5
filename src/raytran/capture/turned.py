# SPDX-License-Identifier: Apache-2.0
"""Scans whose images were stored sideways, as phones held upright write them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from raytran.data.scan import OpenScan

_MOSTLY = 0.5
"""Smallest mean of cos(angle between up and an image's side) for which that side is where up is."""


@dataclass(frozen=True, kw_only=True)
class TurnedScan(OpenScan):
    """Another scan with its images turned by quarters, and its cameras with them.

    Attributes:
        stored: the scan as it is stored.
        quarters: number of quarter turns counter-clockwise, 1 to 3.
    """

    stored: OpenScan
    quarters: int

    @property
    def path(self) -> Path:
        """Where the stored scan lies."""
        return self.stored.path

    def color_bytes(self, index: int) -> None:
        """Return None: no frame is used as stored."""
        return

    def read_color(self, index: int, image_size: tuple[int, int] | None = None) -> NDArray[np.uint8]:
        """See ``OpenScan``."""
        size = image_size if image_size is None or self.quarters == 2 else (image_size[1], image_size[0])
        return np.ascontiguousarray(np.rot90(self.stored.read_color(index, size), self.quarters))

    def close(self) -> None:
        """Close the stored scan."""
        self.stored.close()


def turned_upright(scan: OpenScan, up: NDArray[np.float64]) -> OpenScan:
    """Return the scan with its images turned so that up in the world is up in most of them.

    Args:
        scan: with cameras in OpenCV axes.
        up: ``(3,)`` direction of up in its world, known by other means than the images' tops.

    Returns:
        The scan itself if its images are upright, or turn in all ways.
    """
    sides = scan.world_from_camera[:, :3, :2].double().numpy().transpose(0, 2, 1) @ up
    right, bottom = sides.mean(axis=0)
    # How far up points to the images' top, right, bottom and left.
    quarters = int(np.argmax([-bottom, right, bottom, -right]))
    if quarters == 0 or max(abs(right), abs(bottom)) < _MOSTLY:
        return scan
    poses, intrinsics, (height, width) = scan.world_from_camera.clone(), scan.intrinsics, scan.image_size
    for _ in range(quarters):
        # The side that was on the right comes to the top: x is what was down, and down what was left.
        poses = torch.cat([poses[..., 1:2], -poses[..., :1], poses[..., 2:]], dim=-1)
        fx, fy, cx, cy = (intrinsics[i, j].item() for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
        intrinsics = torch.tensor([[fy, 0, cy], [0, fx, width - cx], [0, 0, 1]], dtype=torch.float64)
        height, width = width, height
    return TurnedScan(
        scene_id=scan.scene_id,
        frame_id=scan.frame_id,
        world_from_camera=poses,
        intrinsics=intrinsics,
        image_size=(height, width),
        axis_alignment=scan.axis_alignment,
        dropped=scan.dropped,
        damage=scan.damage,
        stored=scan,
        quarters=quarters,
    )
