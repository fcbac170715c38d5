# SPDX-License-Identifier: Apache-2.0
"""The occupancy of a scene as a cloud of points."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib import colormaps
from torch import Tensor

from raytran.geometry.grid import VoxelGrid

THRESHOLD = 0.5
"""Voxels with a higher probability are points."""

# trimesh writes no cloud without points, and no numbers of our own.
_PROPERTIES = {
    **dict.fromkeys(("x", "y", "z"), ("<f4", "float")),
    **dict.fromkeys(("red", "green", "blue"), ("u1", "uchar")),
    "probability": ("<f4", "float"),
}
"""Name of each property of a point → its type in numpy and in PLY."""


def write_occupancy(
    path: Path, occupancy: Tensor, *, center: Tensor, extent: tuple[float, float, float]
) -> Path:
    """Write the centres of the voxels that are likely occupied as a PLY, coloured by how likely.

    Colours run along matplotlib's ``viridis``, from dark violet at probability ½ to yellow at 1; the
    probability itself is the property ``probability``.

    Args:
        path: the file.
        occupancy: ``(X, Y, Z)`` probability.
        center: ``(3,)`` centre of the voxel grid in the world, metres.
        extent: sizes of the voxel grid, metres.

    Returns:
        ``path``.
    """
    x, y, z = occupancy.shape
    chosen = (occupancy > THRESHOLD).cpu()
    centers = VoxelGrid((x, y, z), extent, center.double().cpu()).voxel_centers()[chosen].numpy()
    probability = occupancy.double().cpu()[chosen].numpy()
    colors = colormaps["viridis"]((probability - THRESHOLD) / (1 - THRESHOLD), bytes=True)
    points = np.empty(len(centers), dtype=[(name, kind) for name, (kind, _) in _PROPERTIES.items()])
    columns = (*centers.T, *colors[:, :3].T, probability)
    for name, column in zip(_PROPERTIES, columns, strict=True):
        points[name] = column
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(points)}"]
    lines += [f"property {kind} {name}" for name, (_, kind) in _PROPERTIES.items()]
    path.write_bytes("\n".join([*lines, "end_header\n"]).encode("ascii") + points.tobytes())
    return path
