# SPDX-License-Identifier: Apache-2.0
"""Which boxes cameras look at, whether or not something stands between."""

from __future__ import annotations

from itertools import chain, product

import torch
from torch import Tensor

from raytran.geometry.boxes import OrientedBoxes
from raytran.geometry.camera import Cameras
from raytran.structs import constant

_LATTICE = tuple(chain.from_iterable(product((-0.5, 0.0, 0.5), repeat=3)))
"""x, y, z of the points of a box that are looked for, one after another: its corners, the middles of its
edges and faces, and its centre."""

_FARTHEST = 20.0
"""Metres up to which a camera in a room sees: what is in line with it further away is in no room."""


def boxes_in_view(boxes: OrientedBoxes, cameras: Cameras) -> Tensor:
    """Return which boxes have a corner, the middle of an edge or face, or the centre in some image.

    What is more than 20 m away is not seen.

    Args:
        boxes: M of them.
        cameras: of N images, leading dimensions ``(N,)``.

    Returns:
        ``(M,)`` bool.
    """
    lattice = constant(_LATTICE, boxes.size.dtype, device=boxes.size.device).view(-1, 3)
    offset = torch.einsum("mij,mkj->mki", boxes.rotation, lattice * boxes.size[:, None])
    points = (offset + boxes.center[:, None]).reshape(-1, 3).double()
    is_seen = torch.zeros(len(points), dtype=torch.bool, device=points.device)
    # Camera by camera: all points in all images of a long scan are too many at once.
    for n in range(len(cameras.intrinsics)):
        camera = cameras[n].to(torch.float64)
        pixels, depth = camera.project(points)
        is_seen |= camera.sees(pixels, depth) & (depth < _FARTHEST)
    return is_seen.view(-1, len(lattice)).any(dim=1)
