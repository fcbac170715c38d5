# SPDX-License-Identifier: Apache-2.0
"""Solid and surface voxels of triangle meshes that need be neither watertight nor cleanly oriented.

Solid cells are found by signed scan conversion: along each axis, every column of cells is cut with the
faces, the signs of the cuts (+1 entering, -1 leaving) are summed from either end, and a cell whose sum is
not zero gets a vote. Of the 6 votes (3 axes, 2 directions) 4 must agree, so that holes and faces turned
inside out do little harm. Sheets and thin shells have no inside, hence the surface cells are added.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from raytran.structs import SHAPE_SIZE

Cells = NDArray[np.bool_]
Floats = NDArray[np.floating]
Columns = tuple[NDArray[np.int64], NDArray[np.int64]]

# Rays miss the cell centres by these fractions of a cell, so that they hit no edge or vertex exactly.
_SHIFT = (1.37e-4, 2.11e-4)
_VOTES_NEEDED = 4

_MAX_CELLS = 1 << 20
"""Most cells that the boxes of the triangles of one block cover, over all three axes; limits the memory."""


def voxelize_solid(
    vertices: ArrayLike,
    faces: ArrayLike,
    size: int = SHAPE_SIZE,
    *,
    box: tuple[float, float] | None = None,
) -> Cells:
    """Return the cells of a box that lie inside a mesh or on its surface.

    Args:
        vertices: ``(V, 3)``, any unit.
        faces: ``(F, 3)`` vertex indices.
        size: cells along each side (S).
        box: from where to where the box reaches along each axis; no vertex may lie outside. None: the
            axis-aligned box of all ``vertices``.

    Returns:
        ``(S, S, S)`` bool indexed [x, y, z]. The cells divide the box, each axis by itself: cell ``i`` spans
        ``low + [i, i + 1] / S * (high - low)``.
    """
    points = np.asarray(vertices, dtype=np.float64)
    if box is None:
        low, extent = points.min(axis=0), np.ptp(points, axis=0)
    else:
        low, extent = np.full(3, box[0]), np.full(3, box[1] - box[0])
    # A mesh that is flat along an axis lies in the middle layer of cells.
    unit = np.where(extent > 0, (points - low) / np.where(extent > 0, extent, 1.0), 0.5)
    solid, surface = scan_convert(unit * size, faces, size)
    return solid | surface


def scan_convert(points: Floats, faces: ArrayLike, size: int) -> tuple[Cells, Cells]:
    """Return the solid and the surface cells of a mesh given in units of cells.

    Args:
        points: ``(V, 3)`` in [0, size]; cell ``(i, j, k)`` is the unit cube from that point.
        faces: ``(F, 3)`` vertex indices.
        size: cells along each side (S).

    Returns:
        Two ``(S, S, S)`` bool arrays indexed [x, y, z]. Neither contains the other.
    """
    triangles = points[_without_duplicates(points, np.asarray(faces, dtype=np.int64))]
    surface = np.zeros((size, size, size), dtype=bool)
    crossings = [np.zeros((size + 1, size, size), dtype=np.int32) for _ in range(3)]
    for block in _blocks(triangles, size):
        for axis in range(3):
            cut, depth, sign = _cut_columns(block, axis, size)
            surface[_at(cut, axis, np.clip(depth.astype(np.int64), 0, size - 1))] = True
            above = np.clip(np.ceil(depth - 0.5), 0, size).astype(np.int64)
            np.add.at(crossings[axis], (above, *cut), sign.astype(np.int32))
        _mark_edges(block, surface)
    votes = np.zeros((size, size, size), dtype=np.int8)
    for axis in range(3):
        votes += _votes(crossings[axis], axis)
    return votes >= _VOTES_NEEDED, surface


def _blocks(triangles: Floats, size: int) -> list[Floats]:
    """Split triangles into blocks that cover so few cells that cutting them takes little memory."""
    width = np.minimum(np.ptp(triangles, axis=1), size) + 1
    cells = (width * np.roll(width, 1, axis=1)).sum(axis=1)
    number = np.cumsum(cells) // _MAX_CELLS
    return np.split(triangles, np.flatnonzero(np.diff(number)) + 1)


def _without_duplicates(points: Floats, faces: NDArray[np.int64]) -> NDArray[np.int64]:
    """Drop faces with the same three corners as an earlier face: cut twice they would count twice."""
    grid = np.round(points * 2**13).astype(np.int64)
    key = (grid[:, 0] << 42) + (grid[:, 1] << 21) + grid[:, 2]
    merged = np.unique(key, return_inverse=True)[1].reshape(-1)
    corners = np.sort(merged[faces], axis=1)
    count = int(merged.max(initial=0)) + 1
    face_key = (corners[:, 0] * count + corners[:, 1]) * count + corners[:, 2]
    return faces[np.sort(np.unique(face_key, return_index=True)[1])]


def _cut_columns(triangles: Floats, axis: int, size: int) -> tuple[Columns, Floats, Floats]:
    """Cut the columns of cells that run along ``axis`` with the triangles ``(F, 3, 3)``.

    Returns:
        For every cut: its column, i.e. its cell along the other two axes in cyclic order; its depth along
        ``axis``; and +1 where a ray towards larger depth enters (the normal points against it), -1 where it
        leaves.
    """
    # With the axes in cyclic order (u, v, axis), the sign of the area in (u, v) is that of the normal.
    corners = triangles[..., [(axis + 1) % 3, (axis + 2) % 3, axis]]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    shift_u, shift_v = 0.5 + _SHIFT[0], 0.5 + _SHIFT[1]
    low, high = corners.min(axis=1), corners.max(axis=1)
    face, row = _expand(np.ceil(low[:, 1] - shift_v), np.ceil(high[:, 1] - shift_v), size)
    begin, end = _row_spans(corners, face, row + shift_v)
    span, column = _expand(np.ceil(begin - shift_u), np.ceil(end - shift_u), size)
    face, row = face[span], row[span]
    corner, slope = corners[face, 0], normal[face]
    rise = (column + shift_u - corner[:, 0]) * slope[:, 0] + (row + shift_v - corner[:, 1]) * slope[:, 1]
    # The plane of a sliver is ill-conditioned: its cut stays within the face all the same.
    depth = np.clip(corner[:, 2] - rise / slope[:, 2], low[face, 2], high[face, 2])
    return (column, row), depth, -np.sign(slope[:, 2])


def _row_spans(triangles: Floats, face: NDArray[np.int64], height: Floats) -> tuple[Floats, Floats]:
    """Return where each line v = ``height`` enters and leaves the triangle ``face``, along u."""
    begin = np.full(len(face), np.inf)
    end = np.full(len(face), -np.inf)
    for i in range(3):
        start, stop = triangles[face, i, :2], triangles[face, (i + 1) % 3, :2]
        crosses = (start[:, 1] <= height) != (stop[:, 1] <= height)
        run = np.where(crosses, stop[:, 1] - start[:, 1], 1.0)
        crossing = start[:, 0] + (height - start[:, 1]) / run * (stop[:, 0] - start[:, 0])
        begin = np.where(crosses, np.minimum(begin, crossing), begin)
        end = np.where(crosses, np.maximum(end, crossing), end)
    return begin, end


def _expand(first: Floats, last: Floats, size: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """List the integers of the ranges ``first <= i < last`` within [0, size), each with its range."""
    low = np.clip(first, 0, size).astype(np.int64)
    count = np.maximum(np.clip(last, 0, size).astype(np.int64) - low, 0)
    owner = np.repeat(np.arange(len(low)), count)
    start = np.cumsum(count) - count
    return owner, low[owner] + np.arange(len(owner)) - start[owner]


def _votes(crossings: NDArray[np.int32], axis: int) -> NDArray[np.int8]:
    """Return ``(S, S, S)`` votes [x, y, z], 0 to 2, of the two directions along ``axis``.

    Args:
        crossings: ``(S + 1, S, S)`` sum of the signs of the cuts between one cell and the next along
            ``axis``; then the column's cell along the other two axes in cyclic order. Overwritten.
        axis: 0, 1 or 2.
    """
    # ``np.cumsum`` along the first axis is several times slower than adding whole planes.
    for i in range(1, len(crossings)):
        crossings[i] += crossings[i - 1]
    winding, beyond = crossings[:-1], crossings[-1]
    votes = (winding != 0).astype(np.int8) + (winding != beyond)
    # From the order (axis, axis + 1, axis + 2) to (x, y, z).
    return votes.transpose([(i - axis) % 3 for i in range(3)])


def _at(column: Columns, axis: int, depth: NDArray[np.int64]) -> tuple[NDArray[np.int64], ...]:
    """Return the [x, y, z] index of the cells at ``depth`` of the given columns along ``axis``."""
    cell = (*column, depth)
    return tuple(cell[(i - axis - 1) % 3] for i in range(3))


def _mark_edges(triangles: Floats, surface: Cells) -> None:
    """Set the cells along all edges: the parts of thin faces that no ray through a cell centre meets."""
    start = triangles.reshape(-1, 3)
    stop = np.roll(triangles, -1, axis=1).reshape(-1, 3)
    steps = np.ceil(2 * np.abs(stop - start).max(axis=1)) + 1
    edge, step = _expand(np.zeros(len(start)), steps + 1, 2 * max(surface.shape) + 2)
    share = (step / steps[edge])[:, None]
    cell = (start[edge] * (1 - share) + stop[edge] * share).astype(np.int64)
    x, y, z = np.clip(cell, 0, surface.shape[0] - 1).T
    surface[x, y, z] = True
