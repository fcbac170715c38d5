# SPDX-License-Identifier: Apache-2.0
"""Oriented boxes as line segments in an image, cut at the camera's near plane."""

from __future__ import annotations

import torch
from torch import Tensor

from raytran.geometry.boxes import OrientedBoxes
from raytran.geometry.camera import Cameras
from raytran.structs import ObjectSet

NEAR = 0.05
"""Metres in front of the camera where edges are cut."""

# Corners whose numbers differ in one bit share an edge: bit 2 is x, bit 1 is y, bit 0 is z.
_EDGES = torch.tensor([(i, i | bit) for i in range(8) for bit in (1, 2, 4) if not i & bit])
_FRONT = tuple(e for e, (a, b) in enumerate(_EDGES.tolist()) if not a & 1 and not b & 1)
"""Edges of the front face, z = -½ in the object frame."""


def box_corners(objects: ObjectSet) -> Tensor:
    """Return corners in the world, ``(M, 8, 3)`` metres, numbered as ``OrientedBoxes.corners`` does."""
    return OrientedBoxes(objects.center, objects.size, objects.rotation).corners()


def box_edges() -> tuple[Tensor, list[bool]]:
    """Return the corners that each edge joins, ``(12, 2)`` int64, and whether it belongs to the front."""
    return _EDGES, [edge in _FRONT for edge in range(len(_EDGES))]


def box_segments(objects: ObjectSet, camera: Cameras) -> list[list[tuple[float, float, float, float, bool]]]:
    """Project each box's edges.

    An edge that crosses the plane ``NEAR`` metres in front of the camera is cut there before it is projected;
    projecting a point behind the camera would mirror it to the other side of the image.

    Args:
        objects: ``M`` boxes.
        camera: one camera, no leading dimensions.

    Returns:
        For each box the visible pieces of its edges, far ones first: (u0, v0, u1, v1, belongs to the front).
    """
    corners = box_corners(objects).double()
    rotation, position = camera.world_from_camera[:3, :3].double(), camera.position.double()
    ends = ((corners - position) @ rotation)[:, _EDGES]
    start, stop = ends[:, :, 0], ends[:, :, 1]
    start, stop = _cut(start, stop), _cut(stop, start)
    visible = (start[..., 2] >= NEAR) & (stop[..., 2] >= NEAR)
    depth = start[..., 2] + stop[..., 2]
    intrinsics = camera.intrinsics.double()
    a, b = _project(start, intrinsics), _project(stop, intrinsics)
    segments = []
    for m in range(len(objects)):
        order = depth[m].argsort(descending=True).tolist()
        segments.append(
            [(*a[m, e].tolist(), *b[m, e].tolist(), e in _FRONT) for e in order if bool(visible[m, e])]
        )
    return segments


def _cut(point: Tensor, other: Tensor) -> Tensor:
    """Move points in front of the near plane along their edge onto it, where the edge reaches it."""
    rise = other[..., 2] - point[..., 2]
    crosses = (point[..., 2] < NEAR) & (other[..., 2] >= NEAR)
    share = (NEAR - point[..., 2]) / torch.where(crosses, rise, torch.ones_like(rise))
    moved = point + share[..., None] * (other - point)
    moved[..., 2] = NEAR
    return torch.where(crosses[..., None], moved, point)


def _project(points: Tensor, intrinsics: Tensor) -> Tensor:
    image = points @ intrinsics.T
    return image[..., :2] / torch.where(
        points[..., 2:] >= NEAR, image[..., 2:], torch.ones_like(image[..., 2:])
    )
