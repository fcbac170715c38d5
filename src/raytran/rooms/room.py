# SPDX-License-Identifier: Apache-2.0
"""The empty room: walls, floor, ceiling, doors, windows and lights.

The room's frame has its origin in a corner of the floor, x and y along the walls and z up.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from raytran.rooms.materials import (
    Paint,
    Surfaces,
    box_triangles,
    floor_paint,
    quad_triangles,
    texture_index,
    tinted,
    wall_paint,
)
from raytran.rooms.objects import Boxes

_WHITE = Paint(dark=(0.86, 0.86, 0.85), light=(0.93, 0.93, 0.92))


@dataclass(frozen=True)
class Wall:
    """One wall, with coordinates (s along, d inward, z up).

    Attributes:
        origin: ``(2,)`` floor point where s is 0, metres.
        along: ``(2,)`` unit vector of growing s; the room lies to its left.
        inward: ``(2,)`` unit vector into the room.
        length: metres.
    """

    origin: NDArray[np.float64]
    along: NDArray[np.float64]
    inward: NDArray[np.float64]
    length: float

    def point(self, s: float, d: float, z: float = 0.0) -> NDArray[np.float64]:
        """Return the room point ``(3,)`` at wall coordinates."""
        return np.append(self.origin + s * self.along + d * self.inward, z)

    def box(
        self, s: tuple[float, float], d: tuple[float, float], z: tuple[float, float]
    ) -> NDArray[np.float64]:
        """Return the two opposite corners ``(2, 3)`` of a box given by its ranges in wall coordinates."""
        ends = np.stack([self.point(s[0], d[0], z[0]), self.point(s[1], d[1], z[1])])
        return np.stack([ends.min(axis=0), ends.max(axis=0)])

    def oriented(self, s: tuple[float, float], d: tuple[float, float], z: tuple[float, float]) -> Boxes:
        """Return the box of these ranges in wall coordinates, turned as the wall is."""
        if np.abs(self.along).max() == 1.0:
            return Boxes.aligned(self.box(s, d, z)[None])
        axes = np.zeros((3, 3))
        axes[:2, 0], axes[:2, 1], axes[2, 2] = self.along, self.inward, 1.0
        ranges = np.array([s, d, z])
        middle = ranges.mean(axis=1)
        return Boxes(self.point(*middle)[None], axes[None], np.ptp(ranges, axis=1)[None] / 2)

    def solid(
        self, s: tuple[float, float], d: tuple[float, float], z: tuple[float, float]
    ) -> NDArray[np.float64]:
        """Return the triangles ``(12, 3, 3)`` of the box of these ranges in wall coordinates."""
        local = box_triangles((s[0], d[0], z[0]), (s[1], d[1], z[1]))
        plan = self.origin + local[..., :1] * self.along + local[..., 1:2] * self.inward
        return np.concatenate([plan, local[..., 2:]], axis=-1)


@dataclass(frozen=True)
class Opening:
    """A door or a window.

    Attributes:
        kind: ``"door"`` or ``"window"``.
        wall: index into ``Room.walls``.
        s: its range along the wall, metres.
        z: its range of heights, metres.
    """

    kind: str
    wall: int
    s: tuple[float, float]
    z: tuple[float, float]


@dataclass(frozen=True)
class Light:
    """A small square lamp, or a window that lets daylight in.

    Attributes:
        position: ``(3,)`` centre, metres.
        direction: ``(3,)`` unit vector of its strongest light; it falls off with the cosine to it.
        color: ``(3,)`` linear RGB at 1 m.
        half_side: half the side of the square that shadows come from, metres.
        shadows: whether shadow rays are cast to it.
    """

    position: NDArray[np.float64]
    direction: NDArray[np.float64]
    color: NDArray[np.float64]
    half_side: float
    shadows: bool


@dataclass(frozen=True)
class Sun:
    """Sunlight through a window.

    Attributes:
        toward: ``(3,)`` unit vector to the sun.
        color: ``(3,)`` linear RGB of its light.
        wall: the wall with the window.
        s: range of the window along the wall, metres.
        z: range of its heights, metres.
    """

    toward: NDArray[np.float64]
    color: NDArray[np.float64]
    wall: Wall
    s: tuple[float, float]
    z: tuple[float, float]


@dataclass(frozen=True)
class Room:
    """An empty room.

    Attributes:
        kind: what the room is used for, e.g. ``"office"``.
        size: ``(x, y, z)`` metres.
        walls: the four walls.
        openings: doors and windows.
        lights: lamps and daylight.
        surfaces: what is seen of the room.
        built_in: what stands in it and belongs to it, such as columns; no furniture may be there.
        sun: sunlight that falls in.
        ambient: ``(3,)`` linear RGB of light from everywhere.
    """

    kind: str
    size: tuple[float, float, float]
    walls: tuple[Wall, ...]
    openings: tuple[Opening, ...]
    lights: tuple[Light, ...]
    surfaces: Surfaces
    built_in: Boxes | None = None
    sun: Sun | None = None
    ambient: tuple[float, float, float] = (0.28, 0.28, 0.28)

    def keep_free(self) -> Boxes:
        """Return boxes where no furniture may stand: at doors and windows, and what is built in."""
        boxes = []
        for opening in self.openings:
            depth = 0.85 if opening.kind == "door" else 0.12
            boxes.append(self.walls[opening.wall].oriented(opening.s, (0.0, depth), opening.z))
        if self.built_in is not None:
            boxes.append(self.built_in)
        return Boxes.joined(boxes) if boxes else Boxes.aligned(np.zeros((0, 2, 3)))

    def holds(self, corners: NDArray[np.float64]) -> bool:
        """Say whether points ``(n, 3)`` all lie in the room, 2 cm from walls and ceiling at least."""
        if (corners[:, :2] < 0.02).any() or (corners > np.array(self.size) - 0.02).any():
            return False
        return all(((corners[:, :2] - wall.origin) @ wall.inward >= 0.02).all() for wall in self.skewed)

    @property
    def skewed(self) -> list[Wall]:
        """The walls that are not parallel to an axis."""
        return [wall for wall in self.walls if np.abs(wall.along).max() < 1.0]


def make_room(kind: str, size: tuple[float, float, float], rng: np.random.Generator) -> Room:
    """Draw a room of the given ``kind`` and ``size`` (x, y, z in metres)."""
    walls = _walls(size)
    openings = _draw_openings(walls, size[2], rng)
    lights = _draw_lights(size, walls, openings, rng)
    parts = [_shell(size, kind, rng), _rug(size, rng)] if rng.random() < 0.4 else [_shell(size, kind, rng)]
    trim = (
        _WHITE
        if rng.random() < 0.6
        else tinted(rng.uniform(0.05, 0.1), 0.5, rng.uniform(0.4, 0.7), 0.3, "wood")
    )
    parts += [_painted_box(wall.box((0, wall.length), (0, 0.015), (0, 0.08)), trim) for wall in walls]
    for opening in openings:
        draw = _door if opening.kind == "door" else _window
        parts.extend(draw(walls[opening.wall], opening, trim, rng))
    parts.extend(_pictures(walls, openings, rng))
    lamp = Paint(dark=(1.0, 0.98, 0.92), light=(1.0, 0.98, 0.92), emissive=True)
    half = lights[0].half_side
    x, y = lights[0].position[:2]
    lamp_box = np.array([[x - half, y - half, size[2] - 0.06], [x + half, y + half, size[2]]])
    parts.append(_painted_box(lamp_box, lamp))
    return Room(kind, size, walls, openings, lights, Surfaces.joined(parts))


def _walls(size: tuple[float, float, float]) -> tuple[Wall, ...]:
    x, y, _ = size
    corners = np.array([[0.0, 0.0], [x, 0.0], [x, y], [0.0, y]])
    directions = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])
    return tuple(
        Wall(corner, along, np.array([-along[1], along[0]]), length)
        for corner, along, length in zip(corners, directions, (x, y, x, y), strict=True)
    )


def _draw_openings(walls: tuple[Wall, ...], height: float, rng: np.random.Generator) -> tuple[Opening, ...]:
    order = rng.permutation(4)
    width = rng.uniform(0.8, 0.95)
    start = rng.uniform(0.15, walls[order[0]].length - width - 0.15)
    openings = [Opening("door", int(order[0]), (start, start + width), (0.0, min(2.05, height - 0.2)))]
    for index in order[1 : 1 + int(rng.integers(1, 3))]:
        length = walls[index].length
        width = min(rng.uniform(0.9, 2.2), length - 0.8)
        start = rng.uniform(0.3, length - width - 0.3)
        z = (rng.uniform(0.85, 1.1), rng.uniform(2.0, height - 0.2))
        openings.append(Opening("window", int(index), (start, start + width), z))
    return tuple(openings)


def _draw_lights(
    size: tuple[float, float, float],
    walls: tuple[Wall, ...],
    openings: tuple[Opening, ...],
    rng: np.random.Generator,
) -> tuple[Light, ...]:
    warm = rng.uniform(0.0, 0.25)
    lamp_xy = np.array(size[:2]) * rng.uniform(0.35, 0.65, size=2)
    lamp_color = rng.uniform(1.6, 2.4) * np.array([1.0, 1.0 - 0.4 * warm, 1.0 - warm])
    down = np.array([0.0, 0.0, -1.0])
    lights = [Light(np.append(lamp_xy, size[2] - 0.08), down, lamp_color, rng.uniform(0.12, 0.3), True)]
    daylight = rng.uniform(0.3, 1.2) * np.array([0.92, 0.97, 1.0])
    for opening in openings:
        if opening.kind == "window":
            wall = walls[opening.wall]
            area = (opening.s[1] - opening.s[0]) * (opening.z[1] - opening.z[0])
            middle = wall.point(sum(opening.s) / 2, -0.3, sum(opening.z) / 2)
            lights.append(Light(middle, np.append(wall.inward, 0.0), daylight * area, 0.0, False))
    return tuple(lights)


def _painted_box(corners: NDArray[np.float64], paint: Paint) -> Surfaces:
    return Surfaces.painted(box_triangles(corners[0], corners[1]), paint)


def _shell(size: tuple[float, float, float], kind: str, rng: np.random.Generator) -> Surfaces:
    """Return floor, ceiling and the four walls, one of which may have another colour."""
    x, y, z = size
    base = np.array([[0.0, 0.0, 0.0], [x, 0.0, 0.0], [x, y, 0.0], [0.0, y, 0.0]])
    top = base + np.array([0.0, 0.0, z])
    parts = [Surfaces.painted(quad_triangles(base), floor_paint(rng, wet=kind == "bathroom"))]
    parts.append(Surfaces.painted(quad_triangles(top[::-1]), tinted(0.1, 0.03, 0.94, 0.04, "plaster")))
    paint = wall_paint(rng)
    accent = wall_paint(rng) if rng.random() < 0.35 else paint
    for i in range(4):
        j = (i + 1) % 4
        corners = np.stack([base[i], base[j], top[j], top[i]])
        parts.append(Surfaces.painted(quad_triangles(corners), accent if i == 0 else paint))
    return Surfaces.joined(parts)


def _rug(size: tuple[float, float, float], rng: np.random.Generator) -> Surfaces:
    half = np.array(size[:2]) * rng.uniform(0.18, 0.32, size=2)
    middle = np.array(size[:2]) * rng.uniform(0.4, 0.6, size=2)
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * half + middle
    quad = np.column_stack([corners, np.full(4, 0.003)])
    paint = tinted(rng.random(), rng.uniform(0.1, 0.6), rng.uniform(0.3, 0.8), 0.4, "carpet")
    return Surfaces.painted(quad_triangles(quad), paint)


def _frame(wall: Wall, opening: Opening, depth: float, trim: Paint) -> list[Surfaces]:
    (s0, s1), (z0, z1), width = opening.s, opening.z, 0.06
    ranges = [
        ((s0 - width, s0), (z0, z1)),
        ((s1, s1 + width), (z0, z1)),
        ((s0 - width, s1 + width), (z1, z1 + width)),
    ]
    return [_painted_box(wall.box(s, (0, depth), z), trim) for s, z in ranges]


def _door(wall: Wall, opening: Opening, trim: Paint, rng: np.random.Generator) -> list[Surfaces]:
    leaf = tinted(rng.uniform(0.04, 0.12), rng.uniform(0.0, 0.55), rng.uniform(0.45, 0.9), 0.25, "wood")
    metal = Paint(dark=(0.55, 0.55, 0.55), light=(0.6, 0.6, 0.6))
    handle = opening.s[0] + 0.07
    return [
        *_frame(wall, opening, 0.05, trim),
        _painted_box(wall.box(opening.s, (0, 0.03), opening.z), leaf),
        _painted_box(wall.box((handle, handle + 0.12), (0.03, 0.08), (1.0, 1.03)), metal),
    ]


def _window(wall: Wall, opening: Opening, trim: Paint, rng: np.random.Generator) -> list[Surfaces]:
    (s0, s1), (z0, z1) = opening.s, opening.z
    sky = Paint((0.62, 0.74, 0.9), (0.97, 0.98, 1.0), texture_index("sky"), emissive=True)
    bars = int(rng.integers(1, 4))
    parts = [
        *_frame(wall, opening, 0.04, trim),
        _painted_box(wall.box(opening.s, (0, 0.01), opening.z), sky),
        _painted_box(wall.box((s0 - 0.08, s1 + 0.08), (0, 0.14), (z0 - 0.04, z0)), trim),
    ]
    middles = np.linspace(s0, s1, bars + 1)[1:-1]
    mullions = [wall.box((middle - 0.025, middle + 0.025), (0, 0.035), (z0, z1)) for middle in middles]
    return parts + [_painted_box(mullion, trim) for mullion in mullions]


def _pictures(
    walls: tuple[Wall, ...], openings: tuple[Opening, ...], rng: np.random.Generator
) -> list[Surfaces]:
    """Return up to three framed pictures, where neither door nor window is."""
    parts: list[Surfaces] = []
    for _ in range(int(rng.integers(0, 4))):
        index = int(rng.integers(4))
        wall, width, height = walls[index], rng.uniform(0.3, 0.9), rng.uniform(0.3, 0.6)
        s, z = rng.uniform(0.2, wall.length - width - 0.2), rng.uniform(1.4, 1.6)
        rim = tinted(rng.random(), 0.4, rng.uniform(0.1, 0.9), 0.2, "wood")
        inside = tinted(rng.random(), rng.uniform(0.2, 0.8), 0.9, 0.7, "picture")
        if any(o.wall == index and o.s[0] - 0.1 < s + width and s < o.s[1] + 0.1 for o in openings):
            continue
        parts.append(_painted_box(wall.box((s, s + width), (0, 0.02), (z, z + height)), rim))
        inner = wall.box((s + 0.03, s + width - 0.03), (0, 0.022), (z + 0.03, z + height - 0.03))
        parts.append(_painted_box(inner, inside))
    return parts
