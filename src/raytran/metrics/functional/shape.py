# SPDX-License-Identifier: Apache-2.0
"""IoU and chamfer distance of two shape grids of one object."""

from __future__ import annotations

import torch
from scipy.spatial import cKDTree
from torch import Tensor


def grid_iou(predicted: Tensor, target: Tensor) -> float:
    """Return the IoU of the occupied cells of two ``(S, S, S)`` bool grids; 0 if both are empty.

    Cells are compared by their index, so each grid is taken in its own box, stretched to a cube axis by
    axis: errors of pose and size do not count. This is what the shape head is trained to predict.
    """
    return int((predicted & target).sum()) / max(int((predicted | target).sum()), 1)


def surface_points(occupied: Tensor, size: Tensor) -> Tensor:
    """Return the centres of the surface cells of a shape, in the object's frame.

    A surface cell is an occupied one that shares a face with an empty cell or with the outside of the grid.

    Args:
        occupied: ``(S, S, S)`` bool.
        size: ``(3,)`` float64, of the box that the grid fills, metres.

    Returns:
        ``(n, 3)`` float64, metres from the centre of the box.
    """
    padded = torch.nn.functional.pad(occupied, (1,) * 6)
    inner = occupied.clone()
    for axis in range(3):
        for step in (-1, 1):
            inner &= padded.roll(step, axis)[1:-1, 1:-1, 1:-1]
    cells = (occupied & ~inner).nonzero().double()
    return ((cells + 0.5) / len(occupied) - 0.5) * size


def chamfer_distance(a: Tensor, b: Tensor) -> float:
    """Return the mean of the two mean distances from each point to the nearest point of the other set.

    ½ (1/|A| Σ_a min_b |a - b| + 1/|B| Σ_b min_a |a - b|), distances not squared.

    Args:
        a: ``(n, 3)``.
        b: ``(m, 3)``.

    Returns:
        The distance in the unit of the points; NaN if a set is empty.
    """
    if not len(a) or not len(b):
        return float("nan")
    first, second = a.cpu().numpy(), b.cpu().numpy()
    to_second, to_first = cKDTree(second).query(first)[0], cKDTree(first).query(second)[0]
    return float(to_second.mean() + to_first.mean()) / 2
