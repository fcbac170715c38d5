# SPDX-License-Identifier: Apache-2.0
"""Volume of the intersection of two parallelepipeds, exact and differentiable, for a flat list of pairs.

In the frame of A, A is the cube [-1, 1]³. The volume of A ∩ B is the volume of the part of B over the square
|y|, |z| ≤ 1 with x clamped to [-1, 1]; by the divergence theorem that is the sum over the six faces of B of
the integral of clamp(x, -1, 1) · n_x dS over the part of the face with |y|, |z| ≤ 1. The faces of A never
appear, so coplanar faces are no special case, and each term is continuous in the corners of B.

Faces are kept as an unordered set of directed edges p → q, arrays of shape (3, edge, face, pair): the pair is
last so that every operation runs over long rows. Clipping adds one closing edge for each plane.
"""

from __future__ import annotations

from itertools import product

import torch
from torch import Tensor

_CORNER_SIGNS = tuple(product((-1.0, 1.0), repeat=3))
_FACE_CORNERS = ((4, 6, 7, 5), (0, 1, 3, 2), (2, 3, 7, 6), (0, 4, 5, 1), (1, 5, 7, 3), (0, 2, 6, 4))
"""Corners (numbered x-major, z fastest) of each face, counter-clockwise seen from outside."""


def cube_intersection(offset: Tensor, edges: Tensor) -> Tensor:
    """Return the volume that parallelepipeds share with the cube [-1, 1]³.

    Args:
        offset: ``(3, n)`` centres.
        edges: ``(3, 3, n)``, coordinate by edge: a parallelepiped is ``offset + Σ_j t_j · edges[:, j]``
            with |t_j| ≤ 1. Right- or left-handed.

    Returns:
        ``(n,)`` volumes in units of the cube's frame (the cube has 8).
    """
    # An end counts as outside a plane only beyond rounding, lest a face lying in the plane cross it twice.
    extent = 1 + offset.abs() + edges.abs().sum(dim=1)
    bound = (1 + 16 * torch.finfo(offset.dtype).eps * extent).detach()
    start, end = _face_edges(offset, edges)
    for axis in (1, 2):
        start, end = _clip_to_slab(start, end, axis, bound[axis])
    return _clamped_flux(start, end, bound[0]).sum(dim=0).abs() / 2


def _face_edges(offset: Tensor, edges: Tensor) -> tuple[Tensor, Tensor]:
    """Return the ends of the four edges of the six faces, each ``(3, 4, 6, n)``."""
    signs = offset.new_tensor(_CORNER_SIGNS)[:, :, None]
    along_x, along_y, along_z = edges[:, None].unbind(dim=2)
    corners = offset[:, None] + (signs[:, 0] * along_x + signs[:, 1] * along_y + signs[:, 2] * along_z)
    index = torch.tensor(_FACE_CORNERS, device=offset.device).T
    return corners[:, index], corners[:, index.roll(-1, dims=0)]


def _crossings(start: Tensor, end: Tensor, bound: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Find where edges cross the planes at +1 and -1 of one coordinate.

    Args:
        start: ``(E, 6, n)`` that coordinate of p.
        end: ``(E, 6, n)`` that coordinate of q.
        bound: ``(n,)`` beyond which an end counts as outside.

    Returns:
        ``(2, E, 6, n)`` each, first for the plane at +1, then at -1: whether p is outside, whether q is
        outside, and the crossing parameter in [0, 1] where exactly one of them is.
    """
    side = start.new_tensor([1.0, -1.0])[:, None, None, None]
    start, end = side * start, side * end
    start_out, end_out = start > bound, end > bound
    # The guard inside the division keeps the gradients of edges that do not cross finite.
    length = torch.where(start_out ^ end_out, end - start, 1.0)
    return start_out, end_out, ((1 - start) / length).clamp(0.0, 1.0)


def _pick(points: Tensor, chosen: Tensor) -> Tensor:
    """Return the one chosen point among the edges, or 0: ``(k, 2, E, 6, n)`` → ``(k, 2, 6, n)``."""
    total = torch.where(chosen, points, 0.0).sum(dim=2)
    return total / chosen.sum(dim=1).clamp(min=1)


def _clip_to_slab(start: Tensor, end: Tensor, axis: int, bound: Tensor) -> tuple[Tensor, Tensor]:
    """Cut the faces to |coordinate ``axis``| ≤ 1: ``(3, E, 6, n)`` → ``(3, E + 2, 6, n)``.

    Ends that stay are copied bit for bit: both edges at a corner must see the same corner, or a face would
    leave the slab without coming back. An edge wholly outside shrinks to the point p and bounds no area.
    """
    start_out, end_out, t = _crossings(start[axis], end[axis], bound)
    leaves, returns = end_out & ~start_out, start_out & ~end_out
    crossing = start[:, None] + t * (end - start)[:, None]
    # What is left of the face is closed along the plane, from where it left the slab to where it returned.
    closing_start, closing_end = _pick(crossing, leaves), _pick(crossing, returns)
    end = torch.where((start_out & end_out).any(dim=0), start, end)
    for plane in (0, 1):
        start = torch.where(returns[plane], crossing[:, plane], start)
        end = torch.where(leaves[plane], crossing[:, plane], end)
    return torch.cat([start, closing_start], dim=1), torch.cat([end, closing_end], dim=1)


def _cross(a: Tensor, b: Tensor) -> Tensor:
    """Return the cross product of plane vectors, ``(2, ...)`` → ``(...)``."""
    return a[0] * b[1] - a[1] * b[0]


def _clamped_flux(start: Tensor, end: Tensor, bound: Tensor) -> Tensor:
    """Return twice the integral of clamp(x, -1, 1) · n_x dS over each face, ``(3, E, 6, n)`` → ``(6, n)``.

    A face is cut into its parts with x > 1, x < -1 and between. Seen along x each part is a fan of triangles
    from one point r of the face's plane, and the part of an edge has its fraction of the edge's triangle,
    so no polygon is built.
    """
    live = (start[1:] != end[1:]).any(dim=0)
    r = torch.where(live, start, 0.0).sum(dim=1) / live.sum(dim=0).clamp(min=1)
    p, q = start[1:] - r[1:, None], end[1:] - r[1:, None]
    area = _cross(p, q)

    start_out, end_out, t = _crossings(start[0], end[0], bound)
    leaves, returns = end_out & ~start_out, start_out & ~end_out
    outside = torch.where(returns, t, torch.where(leaves, 1 - t, (start_out & end_out).to(t.dtype)))
    outer_area = (area * outside).sum(dim=1)
    inside = area * (1 - outside.sum(dim=0))
    moment = (inside * (start[0].clamp(-1.0, 1.0) + end[0].clamp(-1.0, 1.0) + r[0])).sum(dim=0) / 3

    crossing = p[:, None] + t * (q - p)[:, None]
    closing = _cross(_pick(crossing, leaves), _pick(crossing, returns))
    plane_x = closing.new_tensor([1.0, -1.0])[:, None, None]
    closing_moment = (closing * (2 * plane_x + r[0])).sum(dim=0) / 3
    return moment + closing_moment + (plane_x * (outer_area - closing)).sum(dim=0)
