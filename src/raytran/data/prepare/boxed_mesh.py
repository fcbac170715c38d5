# SPDX-License-Identifier: Apache-2.0
"""What of a scan's mesh stands in an object's box: the nearest thing to a CAD model where there is none."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from trimesh.intersections import slice_faces_plane

Mesh = tuple[NDArray[np.float64], NDArray[np.int64]]
"""Vertices ``(V, 3)`` and faces ``(F, 3)``."""

_SLACK = 0.02
"""Metres around a box that belong to it: scans are as exact, and a table's top lies in the top of its box."""

_FLOOR = 0.03
"""Metres above the bottom of a box in which level surfaces are the floor, on which the object stands."""

_LEVEL = 0.9
"""Least cosine between the normal of a face and up for which the face is level."""

_LEAST_COVER = 0.05
"""Surface in a box, as a share of the box's own, below which it shows no shape."""

_CUBE_CORNERS = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
_CUBE_FACES = np.array(
    [
        *([0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1]),
        *([2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]),
    ]
)


def box_mesh() -> Mesh:
    """Return the cube [-½, ½]³ with normals that point outwards."""
    return _CUBE_CORNERS.copy(), _CUBE_FACES.copy()


def cut_to_box(
    mesh: Mesh,
    *,
    center: NDArray[np.float64],
    size: NDArray[np.float64],
    rotation: NDArray[np.float64],
    on_floor: bool = True,
) -> Mesh | None:
    """Return the part of a mesh that stands in a box, in the box's frame with the box as the cube [-½, ½]³.

    What lies up to two centimetres outside of the box is taken for its side. Of a scan the floor under the
    object is left out: level surfaces at the bottom of the box, which no scan sees of the object itself.

    Args:
        mesh: in the world.
        center: ``(3,)`` of the box, metres.
        size: ``(3,)`` its full extents.
        rotation: ``(3, 3)`` world_from_object.
        on_floor: leave out the floor.

    Returns:
        None if there is too little to tell a shape.
    """
    vertices, faces = mesh
    local = (vertices - center) @ rotation
    reach = size / 2 + _SLACK
    corners = local[faces]
    is_near = (corners.min(axis=1) <= reach).all(axis=1) & (corners.max(axis=1) >= -reach).all(axis=1)
    if not is_near.any():
        return None
    points, triangles = local, faces[is_near]
    for axis in range(3):
        for side in (-1.0, 1.0):
            normal = -side * np.eye(3)[axis]
            points, triangles, *_ = slice_faces_plane(points, triangles, normal, -normal * reach[axis])
            if not len(triangles):
                return None
    if on_floor:
        band = min(_FLOOR, size[1] / 4)
        is_low = points[triangles, 1].max(axis=1) < -size[1] / 2 + band
        upward, area = _normals(points, triangles) @ rotation[2], _areas(points, triangles)
        triangles = triangles[~(is_low & (np.abs(upward) > 2 * _LEVEL * area))]
    points = np.clip(points / size, -0.5, 0.5)
    if _areas(points * size, triangles).sum() < _LEAST_COVER * _surface_of_box(size):
        return None
    used, numbers = np.unique(triangles, return_inverse=True)
    return points[used], numbers.reshape(-1, 3)


def share_in_box(
    mesh: Mesh, *, center: NDArray[np.float64], size: NDArray[np.float64], rotation: NDArray[np.float64]
) -> float:
    """Return the share of a mesh's vertices that lie in a box; arguments as of ``cut_to_box``."""
    local = np.abs((mesh[0] - center) @ rotation)
    return float((local <= size / 2 + _SLACK).all(axis=1).mean())


def _normals(points: NDArray[np.float64], triangles: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return normals ``(F, 3)`` twice as long as the triangles are large."""
    first, second, third = (points[triangles[:, i]] for i in range(3))
    return np.asarray(np.cross(second - first, third - first))


def _areas(points: NDArray[np.float64], triangles: NDArray[np.int64]) -> NDArray[np.float64]:
    return np.asarray(np.linalg.norm(_normals(points, triangles), axis=1) / 2)


def _surface_of_box(size: NDArray[np.float64]) -> float:
    x, y, z = size.tolist()
    return 2 * (x * y + y * z + z * x)
