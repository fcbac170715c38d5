# SPDX-License-Identifier: Apache-2.0
"""What furniture is made of: coloured, closed triangle meshes such as boxes, cushions, lathed bodies, tubes.

Everything here lives in the object frame of ShapeNet (+Y up, front -Z, metres). Faces are wound outwards, so
that overlapping parts can be joined by simply listing their faces: their winding numbers add up. Outlines are
``(N, 2)`` arrays of (x, z), counter-clockwise seen from above (+Y).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

Vertices = NDArray[np.float64]
Color = tuple[float, float, float]


class Part(NamedTuple):
    """A closed mesh: ``vertices`` (V, 3) in metres and outward ``faces`` (F, 3)."""

    vertices: Vertices
    faces: NDArray[np.int64]


class ColoredPart(NamedTuple):
    """A part and its RGB colour in [0, 1]."""

    part: Part
    color: Color


@dataclass
class Design:
    """A piece of furniture while it is put together: coloured parts, and the facts that a layout needs.

    Attributes:
        kind: what a person would call it, e.g. ``office chair``.
        support: where it stands (see ``CadModel.support``).
        symmetry: equal turns about +Y through the origin: 1, 2, 4, or 0 for a body of revolution.
        parts: everything added so far.
    """

    kind: str
    support: str = "floor"
    symmetry: int = 1
    parts: list[ColoredPart] = field(default_factory=list)

    def add(self, parts: Part | Iterable[Part], color: Color) -> None:
        """Add one part or several of the same colour."""
        added = [parts] if isinstance(parts, Part) else parts
        self.parts.extend(ColoredPart(part, color) for part in added)


def loft(rings: ArrayLike, *, closed: bool = False) -> Part:
    """Join successive rings of points by side faces.

    Args:
        rings: ``(R, N, 3)``; each ring runs counter-clockwise about the direction in which the rings advance.
            They may turn back inside themselves: outside up, then inside down, makes a vessel.
        closed: join the last ring to the first (a hollow shade or hoop) instead of capping both ends.
    """
    points = np.asarray(rings, dtype=np.float64)
    count, size, _ = points.shape
    index = np.arange(count * size).reshape(count, size)
    lower = index if closed else index[:-1]
    upper = np.roll(index, -1, axis=0) if closed else index[1:]
    a, d = lower.ravel(), upper.ravel()
    b, c = np.roll(lower, -1, axis=1).ravel(), np.roll(upper, -1, axis=1).ravel()
    faces = [np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)]
    vertices = [points.reshape(-1, 3)]
    if not closed:
        first, last = index[0], index[-1]
        hubs = np.array([index.size, index.size + 1])
        vertices.append(np.stack([points[0].mean(axis=0), points[-1].mean(axis=0)]))
        faces.append(np.stack([np.full(size, hubs[0]), np.roll(first, -1), first], axis=1))
        faces.append(np.stack([np.full(size, hubs[1]), last, np.roll(last, -1)], axis=1))
    return Part(np.concatenate(vertices), np.concatenate(faces))


def circle(radius: float, segments: int = 32) -> Vertices:
    """Outline ``(segments, 2)`` of a circle; a multiple of 4 segments keeps quarter turns exact."""
    angle = 2 * np.pi * np.arange(segments) / segments
    return radius * np.stack([np.cos(angle), -np.sin(angle)], axis=1)


def ellipse(width: float, depth: float, segments: int = 40) -> Vertices:
    """Outline ``(segments, 2)`` of an ellipse with the given full axes."""
    return circle(0.5, segments) * np.array([width, depth])


def rectangle(width: float, depth: float, radius: float = 0.0, steps: int = 3) -> Vertices:
    """Outline of a rectangle about the origin, corners rounded by ``radius`` in ``steps`` segments each."""
    radius = min(radius, 0.499 * width, 0.499 * depth)
    angle = np.linspace(0.0, np.pi / 2, steps + 1) if radius > 0 else np.zeros(1)
    corners = []
    for quarter, (side_x, side_z) in enumerate([(1, -1), (-1, -1), (-1, 1), (1, 1)]):
        turned = angle + quarter * np.pi / 2
        x = side_x * (width / 2 - radius) + radius * np.cos(turned)
        z = side_z * (depth / 2 - radius) - radius * np.sin(turned)
        corners.append(np.stack([x, z], axis=1))
    return np.concatenate(corners)


def stack(outlines: Sequence[Vertices], heights: Sequence[float], *, closed: bool = False) -> Part:
    """Loft through horizontal outlines of equal length placed at the given heights."""
    rings = [
        np.stack([outline[:, 0], np.full(len(outline), height), outline[:, 1]], axis=1)
        for outline, height in zip(outlines, heights, strict=True)
    ]
    return loft(rings, closed=closed)


def prism(outline: Vertices, low: float, high: float) -> Part:
    """Extrude a (star-shaped) outline from height ``low`` to ``high``."""
    return stack([outline, outline], [low, high])


def box(center: ArrayLike, size: ArrayLike) -> Part:
    """Axis-aligned box."""
    width, height, depth = np.asarray(size, dtype=np.float64)
    return moved(prism(rectangle(width, depth), -height / 2, height / 2), center)


def cushion(center: ArrayLike, size: ArrayLike, *, corner: float = 0.05, edge: float = 0.03) -> Part:
    """Box with corners rounded in plan by ``corner`` and its upper and lower edges rounded by ``edge``."""
    width, height, depth = np.asarray(size, dtype=np.float64)
    edge = min(edge, 0.499 * height, 0.4 * width, 0.4 * depth)
    angle = np.linspace(0.0, np.pi / 2, 3)
    inset = edge * (1 - np.sin(angle))
    rise = edge * (1 - np.cos(angle))
    outlines = [rectangle(width - 2 * i, depth - 2 * i, max(corner - i, 0.3 * corner), 2) for i in inset]
    heights = [-height / 2 + r for r in rise]
    return moved(stack(outlines + outlines[::-1], heights + [-h for h in heights[::-1]]), center)


def lathe(profile: Sequence[tuple[float, float]], segments: int = 32, *, closed: bool = False) -> Part:
    """Body of revolution about +Y through (radius > 0, height) pairs, from the bottom of its outside on."""
    radii, heights = zip(*profile, strict=True)
    return stack([circle(radius, segments) for radius in radii], heights, closed=closed)


def tube(path: ArrayLike, radius: float | Sequence[float], segments: int = 8) -> Part:
    """Round bar along a path ``(R, 3)`` of gentle bends, with one radius or one per point."""
    points = np.asarray(path, dtype=np.float64)
    radii = np.broadcast_to(np.asarray(radius, dtype=np.float64), len(points))
    along = np.gradient(points, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    spread = np.abs(along).max(axis=0)
    reference = np.eye(3)[int(np.argmin(spread))]
    right = reference - along * (along @ reference)[:, None]
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    back = np.cross(right, along)
    ring = circle(1.0, segments)
    rings = points[:, None] + radii[:, None, None] * (
        ring[None, :, :1] * right[:, None] + ring[None, :, 1:] * back[:, None]
    )
    return loft(rings)


def moved(part: Part, offset: ArrayLike) -> Part:
    """Shift a part by ``offset`` metres."""
    return Part(part.vertices + np.asarray(offset, dtype=np.float64), part.faces)


def turned(part: Part, degrees: float) -> Part:
    """Turn a part about +Y through the origin, counter-clockwise seen from above; quarter turns are exact."""
    cos, sin = _cos_sin(degrees)
    return Part(part.vertices @ np.array([[cos, 0, -sin], [0, 1, 0], [sin, 0, cos]]), part.faces)


def tilted(part: Part, degrees: float, pivot: ArrayLike = (0.0, 0.0, 0.0)) -> Part:
    """Turn a part about the X axis through ``pivot``; positive degrees lean its top backwards (+Z)."""
    cos, sin = _cos_sin(degrees)
    matrix = np.array([[1, 0, 0], [0, cos, sin], [0, -sin, cos]])
    origin = np.asarray(pivot, dtype=np.float64)
    return Part((part.vertices - origin) @ matrix + origin, part.faces)


def mirrored(part: Part, axis: int = 0) -> Part:
    """Reflect a part in the plane through the origin across ``axis`` (0: left-right, 2: front-back)."""
    sign = np.ones(3)
    sign[axis] = -1.0
    return Part(part.vertices * sign, part.faces[:, ::-1])


def both_sides(part: Part) -> list[Part]:
    """The part and its left-right mirror image."""
    return [part, mirrored(part)]


def corners(part: Part) -> list[Part]:
    """The part mirrored into all four corners: symmetric under half a turn."""
    return [copy for half in both_sides(part) for copy in (half, mirrored(half, axis=2))]


def spokes(part: Part, count: int) -> list[Part]:
    """``count`` copies of the part evenly turned about +Y."""
    return [turned(part, 360.0 * i / count) for i in range(count)]


def _cos_sin(degrees: float) -> tuple[float, float]:
    quarter, rest = divmod(degrees, 90.0)
    if rest == 0:
        return [(1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0)][int(quarter) % 4]
    return float(np.cos(np.radians(degrees))), float(np.sin(np.radians(degrees)))
