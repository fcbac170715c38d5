# SPDX-License-Identifier: Apache-2.0
"""Empty rooms as the world has them: walls askew, columns, kitchens, steps, curtains, radiators, many lights.

All of it belongs to the room: it is seen, hides furniture and keeps it away, and is annotated as nothing.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from raytran.rooms.finishes import (
    board_finish,
    cloth_finish,
    finish,
    floor_finish,
    hsv,
    picture_finish,
    rug_finish,
    tone,
    trim_finish,
    wall_finish,
)
from raytran.rooms.materials import Paint, Surfaces, box_triangles, quad_triangles
from raytran.rooms.objects import Boxes
from raytran.rooms.parametric import parts
from raytran.rooms.room import Light, Opening, Room, Sun, Wall

Range = tuple[float, float]


@dataclass
class _Site:
    """A room while it is built.

    Attributes:
        kind: what it is used for.
        size: of the box around it, metres.
        walls: the four walls.
        rng: source of all choices.
        trim: paint of skirtings and frames.
        parts: surfaces so far.
        blocks: boxes of what is built in.
        openings: doors and windows.
        lights: lamps and windows.
        taken: stretches of each wall that are covered, whole heights.
        sky: linear brightness of what is outside.
    """

    kind: str
    size: tuple[float, float, float]
    walls: tuple[Wall, ...]
    rng: np.random.Generator
    trim: Paint
    parts: list[Surfaces] = field(default_factory=list)
    blocks: list[Boxes] = field(default_factory=list)
    openings: list[Opening] = field(default_factory=list)
    lights: list[Light] = field(default_factory=list)
    taken: list[list[Range]] = field(default_factory=lambda: [[], [], [], []])
    sky: float = 1.0

    def paint(self, triangles: NDArray[np.floating], paint: Paint) -> None:
        """Add triangles of the room."""
        self.parts.append(Surfaces.painted(triangles, paint))

    def solid(self, wall: int, s: Range, d: Range, z: Range, paint: Paint) -> None:
        """Add a box in the coordinates of a wall."""
        self.paint(self.walls[wall].solid(s, d, z), paint)

    def block(self, wall: int, s: Range, d: Range, z: Range) -> None:
        """Keep furniture out of a box in the coordinates of a wall."""
        self.blocks.append(self.walls[wall].oriented(s, d, z))

    def place(self, wall: int, width: float, *, margin: float = 0.12) -> Range | None:
        """Find a free stretch of a wall and take it; None if there is none."""
        length = self.walls[wall].length
        if length < width + 2 * margin:
            return None
        for _ in range(8):
            start = float(self.rng.uniform(margin, length - width - margin))
            if all(start + width < a or start > b for a, b in self.taken[wall]):
                self.taken[wall].append((start - 0.05, start + width + 0.05))
                return start, start + width
        return None

    def any_wall(self, width: float) -> tuple[int, Range] | None:
        """Find a free stretch of any wall and take it."""
        for wall in self.rng.permutation(4):
            found = self.place(int(wall), width)
            if found is not None:
                return int(wall), found
        return None


def build_room(kind: str, size: tuple[float, float, float], rng: np.random.Generator) -> Room:
    """Draw a room of the given ``kind`` and ``size`` (x, y, z in metres) with all that belongs to it."""
    site = _Site(kind, size, _walls(size, rng), rng, trim_finish(rng))
    site.sky = float(rng.choice([0.02, 0.8, 2.5, 6.0, 14.0], p=[0.12, 0.18, 0.3, 0.25, 0.15]))
    _shell(site)
    _doors(site)
    if kind in ("dining", "living", "meeting", "office") and rng.random() < {"dining": 0.6}.get(kind, 0.18):
        _kitchen(site)
    sun = _windows(site)
    for share, draw in (
        (0.3, _column),
        (0.2, _corner_block),
        (0.12, _steps),
        (0.35, _rugs),
        (0.85, _wall_things),
        (0.5, _small_things),
        (0.15, _beams),
        (0.15, _pipes),
    ):
        if rng.random() < share:
            draw(site)
    ambient = _lamps(site)
    built_in = Boxes.joined(site.blocks) if site.blocks else None
    return Room(
        kind=kind,
        size=size,
        walls=site.walls,
        openings=tuple(site.openings),
        lights=tuple(site.lights),
        surfaces=Surfaces.joined(site.parts),
        built_in=built_in,
        sun=sun,
        ambient=ambient,
    )


def _walls(size: tuple[float, float, float], rng: np.random.Generator) -> tuple[Wall, ...]:
    """Return four walls; in a third of the rooms corners are pulled in, so that angles are not right ones."""
    x, y, _ = size
    corners = np.array([[0.0, 0.0], [x, 0.0], [x, y], [0.0, y]])
    if rng.random() < 0.35:
        inward = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]])
        for corner in rng.choice(4, size=int(rng.integers(1, 3)), replace=False):
            axis = int(rng.integers(2))
            corners[corner, axis] += inward[corner, axis] * rng.uniform(0.05, 0.2) * min(x, y)
    walls = []
    for i in range(4):
        step = corners[(i + 1) % 4] - corners[i]
        length = float(np.linalg.norm(step))
        along = step / length
        walls.append(Wall(corners[i], along, np.array([-along[1], along[0]]), length))
    return tuple(walls)


def _shell(site: _Site) -> None:
    """Floor, ceiling, walls with their lower part, skirtings."""
    rng, z = site.rng, site.size[2]
    base = np.array([np.append(wall.origin, 0.0) for wall in site.walls])
    top = base + np.array([0.0, 0.0, z])
    site.paint(quad_triangles(base), floor_finish(rng, wet=site.kind == "bathroom"))
    ceiling = finish(rng, "plain", tone(rng, colorful=0.03, value=(0.8, 0.97)), 0.08)
    if rng.random() < 0.15:
        ceiling = finish(rng, "tiles", tone(rng, colorful=0.0, value=(0.8, 0.95)), 0.25, scale=1.5)
    if rng.random() < 0.06:
        ceiling = board_finish(rng)
    site.paint(quad_triangles(top[::-1]), ceiling)
    usual = wall_finish(rng)
    lower = rng.random() < 0.12 or site.kind == "bathroom"
    split = float(rng.uniform(0.8, 2.1))
    below = (
        finish(
            rng, "tiles", tone(rng, colorful=0.3, value=(0.5, 0.97)), 0.3, scale=float(rng.uniform(0.4, 1.2))
        )
        if site.kind == "bathroom" or rng.random() < 0.3
        else board_finish(rng)
    )
    accent = wall_finish(rng) if rng.random() < 0.4 else usual
    skirting = float(rng.uniform(0.05, 0.16)) if rng.random() < 0.85 else 0.0
    for i in range(4):
        j = (i + 1) % 4
        paint = accent if i == 0 else wall_finish(rng) if rng.random() < 0.06 else usual
        site.paint(quad_triangles(np.stack([base[i], base[j], top[j], top[i]])), paint)
        whole = (0.0, site.walls[i].length)
        if lower:
            site.solid(i, whole, (0.0, 0.008), (0.0, split), below)
        if skirting:
            site.solid(i, whole, (0.0, 0.018), (0.0, skirting), site.trim)


def _frame(site: _Site, wall: int, s: Range, z: Range, *, depth: float, width: float) -> None:
    for part_s, part_z in (
        ((s[0] - width, s[0]), z),
        ((s[1], s[1] + width), z),
        ((s[0] - width, s[1] + width), (z[1], z[1] + width)),
    ):
        site.solid(wall, part_s, (0.0, depth), part_z, site.trim)


def _doors(site: _Site) -> None:
    """One to three doors: closed, standing open, of glass, or openings into a corridor."""
    rng = site.rng
    leaf = board_finish(rng)
    metal = finish(rng, "brushed", tone(rng, colorful=0.0, value=(0.1, 0.8)), 0.2)
    for number in range(int(rng.choice([1, 2, 3], p=[0.6, 0.3, 0.1]))):
        width = float(rng.uniform(0.75, 1.0))
        found = site.any_wall(width)
        if found is None:
            return
        wall, s = found
        z = (0.0, float(min(rng.uniform(1.95, 2.15), site.size[2] - 0.12)))
        site.openings.append(Opening("door", wall, s, z))
        _frame(site, wall, s, z, depth=0.05, width=float(rng.uniform(0.04, 0.1)))
        drawn = rng.random()
        if drawn < 0.25:
            dim = float(np.sqrt(rng.uniform(0.02, 0.6)))
            ground = finish(rng, "plaster", np.array([1.0, 0.97, 0.92]) * dim, 0.3, emissive=True)
            site.solid(wall, s, (0.0, 0.006), z, ground)
            floor = finish(rng, "planks", np.array([0.8, 0.6, 0.45]) * dim, 0.5, emissive=True)
            site.solid(wall, s, (0.0, 0.008), (0.0, float(rng.uniform(0.2, 0.6))), floor)
            if rng.random() < 0.6:
                _open_leaf(site, wall, s, z, leaf)
            continue
        site.solid(wall, s, (0.0, 0.03), z, leaf)
        if drawn < 0.45:
            pane = finish(rng, "photo", (0.75,) * 3, 1.0, turned=False)
            inner = (s[0] + 0.12, s[1] - 0.12)
            site.solid(wall, inner, (0.0, 0.033), (float(rng.uniform(0.2, 1.2)), z[1] - 0.15), pane)
        handle = s[0] + 0.07 if number % 2 else s[1] - 0.19
        site.solid(wall, (handle, handle + 0.12), (0.03, 0.09), (1.0, 1.03), metal)


def _open_leaf(site: _Site, wall: int, s: Range, z: Range, leaf: Paint) -> None:
    """A door's leaf that stands open into the room."""
    side = site.walls[wall]
    angle = float(site.rng.uniform(0.6, 1.7))
    width = s[1] - s[0]
    local = box_triangles((0.0, 0.0, 0.01), (width, 0.04, z[1]))
    x = local[..., 0] * np.cos(angle) - local[..., 1] * np.sin(angle)
    y = local[..., 0] * np.sin(angle) + local[..., 1] * np.cos(angle)
    plan = side.origin + (s[0] + x)[..., None] * side.along + y[..., None] * side.inward
    site.paint(np.concatenate([plan, local[..., 2:]], axis=-1), leaf)
    site.block(wall, (s[0] - width * 0.2, s[1]), (0.0, width), (0.0, z[1]))


def _windows(site: _Site) -> Sun | None:
    """Up to three windows with what is outside, bars, blinds, curtains and radiators; perhaps the sun."""
    rng, height = site.rng, site.size[2]
    sun = None
    count = int(rng.choice([0, 1, 2, 3], p=[0.15, 0.4, 0.3, 0.15]))
    view = str(rng.choice(["street", "photo", "photo 2", "plain"], p=[0.35, 0.2, 0.15, 0.3]))
    outside = float(np.sqrt(site.sky))
    low = float(rng.choice([0.05, rng.uniform(0.6, 1.1)], p=[0.2, 0.8]))
    high = float(rng.uniform(min(1.9, height - 0.25), height - 0.12))
    blinds = rng.random() < 0.3
    curtain = cloth_finish(rng) if rng.random() < 0.45 else None
    width = float(rng.uniform(0.7, 2.6))
    for _ in range(count):
        found = site.any_wall(width) or site.any_wall(0.8)
        if found is None:
            return sun
        wall, s = found
        z = (low, high)
        site.openings.append(Opening("window", wall, s, z))
        tint = np.array(hsv(rng.uniform(0.5, 0.65), rng.uniform(0.0, 0.25), outside))
        seen = finish(rng, view, tint, 0.3, emissive=True, turned=False)
        site.solid(wall, s, (0.0, 0.01), z, seen)
        _frame(site, wall, s, z, depth=0.05, width=0.06)
        for middle in np.linspace(s[0], s[1], int(rng.integers(2, 5)))[1:-1]:
            site.solid(wall, (middle - 0.03, middle + 0.03), (0.0, 0.04), z, site.trim)
        if rng.random() < 0.3:
            cross = z[1] - 0.3 * (z[1] - z[0])
            site.solid(wall, s, (0.0, 0.035), (cross - 0.025, cross + 0.025), site.trim)
        site.solid(
            wall,
            (s[0] - 0.08, s[1] + 0.08),
            (0.0, float(rng.uniform(0.05, 0.2))),
            (z[0] - 0.04, z[0]),
            site.trim,
        )
        if blinds:
            down = z[1] - float(rng.uniform(0.1, 1.0)) * (z[1] - z[0])
            slats = finish(rng, "blinds", tone(rng, colorful=0.1, value=(0.6, 0.95)), 0.5, turned=False)
            site.solid(wall, s, (0.045, 0.06), (down, z[1]), slats)
        if curtain is not None:
            _curtains(site, wall, s, z, curtain)
        if z[0] > 0.5 and rng.random() < 0.6:
            _radiator(site, wall, s, z[0])
        area = (s[1] - s[0]) * (z[1] - z[0])
        day = np.array(hsv(rng.uniform(0.55, 0.62), rng.uniform(0.0, 0.3), 1.0)) * min(site.sky, 4.0)
        middle = site.walls[wall].point(sum(s) / 2, -0.3, sum(z) / 2)
        inward = np.append(site.walls[wall].inward, 0.0)
        site.lights.append(Light(middle, inward, day * area * 0.7 * (0.4 if blinds else 1.0), 0.0, False))
        if sun is None and site.sky > 2.0 and rng.random() < 0.4:
            sun = _sun(site, wall, s, z)
    return sun


def _sun(site: _Site, wall: int, s: Range, z: Range) -> Sun:
    """Sunlight that comes in by a window."""
    rng, side = site.rng, site.walls[wall]
    rise, aside = rng.uniform(0.4, 1.3), rng.normal(0, 0.5)
    toward = np.append(-side.inward + aside * side.along, rise)
    color = np.array([1.0, 0.94, 0.82]) * site.sky * rng.uniform(0.3, 1.0)
    return Sun(toward / np.linalg.norm(toward), color, side, s, z)


def _curtains(site: _Site, wall: int, s: Range, z: Range, cloth: Paint) -> None:
    """Cloth in folds on both sides of a window."""
    rng, side = site.rng, site.walls[wall]
    low = 0.03 if rng.random() < 0.6 else max(z[0] - 0.1, 0.03)
    high = min(z[1] + 0.12, site.size[2] - 0.02)
    width = float(rng.uniform(0.15, 0.45)) * (s[1] - s[0])
    for start, stop in ((s[0] - 0.12, s[0] + width), (s[1] - width, s[1] + 0.12)):
        along = np.linspace(max(start, 0.02), min(stop, side.length - 0.02), 24)
        deep = 0.1 + 0.035 * np.sin(np.linspace(0, rng.uniform(15, 40), 24))
        plan = side.origin + along[:, None] * side.along + deep[:, None] * side.inward
        foot = np.column_stack([plan, np.full(24, low)])
        head = np.column_stack([plan, np.full(24, high)])
        for i in range(23):
            site.paint(quad_triangles(np.stack([foot[i], foot[i + 1], head[i + 1], head[i]])), cloth)
        site.block(wall, (float(along[0]), float(along[-1])), (0.0, 0.14), (0.0, high))
    rod = finish(rng, "brushed", tone(rng, colorful=0.0), 0.2)
    site.solid(
        wall,
        (max(s[0] - 0.2, 0.0), min(s[1] + 0.2, side.length)),
        (0.08, 0.11),
        (high - 0.02, high + 0.01),
        rod,
    )


def _radiator(site: _Site, wall: int, s: Range, below: float) -> None:
    rng = site.rng
    top = float(rng.uniform(0.45, min(0.65, below - 0.02))) if below > 0.5 else 0.45
    inner = (s[0] + 0.08, s[1] - 0.08)
    paint = finish(rng, "grooves", tone(rng, colorful=0.05, value=(0.7, 0.95)), 0.4, scale=0.6, turned=False)
    site.solid(wall, inner, (0.03, 0.11), (0.12, top), paint)
    site.block(wall, inner, (0.0, 0.12), (0.0, top))


def _kitchen(site: _Site) -> None:
    """Counter with worktop, doors, sink and oven, cupboards above, perhaps a fridge beside it."""
    rng, height = site.rng, site.size[2]
    length = float(rng.uniform(1.6, 3.4))
    found = site.any_wall(length) or site.any_wall(1.6)
    if found is None:
        return
    wall, s = found
    front, top = (
        board_finish(rng),
        finish(rng, str(rng.choice(["granite", "marble", "oak", "plain"])), tone(rng), 0.4),
    )
    upper_front = front if rng.random() < 0.7 else board_finish(rng)
    dark, metal = finish(rng, "plain", (0.05,) * 3, 0.3), finish(rng, "brushed", (0.7,) * 3, 0.3)
    deep, level = 0.6, float(rng.uniform(0.86, 0.94))
    site.solid(wall, s, (0.0, deep - 0.04), (0.1, level - 0.04), front)
    site.solid(wall, s, (0.0, deep - 0.1), (0.0, 0.1), dark)
    site.solid(wall, s, (0.0, deep), (level - 0.04, level), top)
    backsplash = finish(
        rng,
        str(rng.choice(["subway tiles", "tiles", "plain", "mosaic"])),
        tone(rng, colorful=0.5),
        0.3,
        scale=0.6,
    )
    low, high = float(rng.uniform(1.35, 1.5)), float(min(rng.uniform(2.0, 2.3), height - 0.05))
    site.solid(wall, s, (0.0, 0.012), (level, low), backsplash)
    uppers = rng.random() < 0.8
    if uppers:
        site.solid(wall, s, (0.0, 0.34), (low, high), upper_front)
        site.block(wall, s, (0.0, 0.35), (low, high))
    handles = rng.random() < 0.7
    doors = max(2, int((s[1] - s[0]) / 0.55))
    for edge in np.linspace(s[0], s[1], doors + 1)[1:]:
        a, b = float(edge) - 0.006, float(edge)
        site.solid(wall, (a, b), (0.0, deep - 0.036), (0.1, level - 0.05), dark)
        if uppers:
            site.solid(wall, (a, b), (0.0, 0.344), (low, high), dark)
        if handles:
            site.solid(wall, (a - 0.06, a - 0.04), (0.0, deep - 0.01), (0.6, 0.75), metal)
            if uppers:
                site.solid(wall, (a - 0.06, a - 0.04), (0.0, 0.37), (low + 0.06, low + 0.2), metal)
    bay = (s[1] - s[0]) / doors
    if rng.random() < 0.7:
        start = s[0] + bay * int(rng.integers(doors))
        site.solid(wall, (start + 0.02, start + bay - 0.02), (0.0, deep - 0.03), (0.2, level - 0.12), dark)
        site.solid(
            wall, (start + 0.02, start + bay - 0.02), (0.08, deep - 0.05), (level, level + 0.006), dark
        )
    start = s[0] + bay * int(rng.integers(doors))
    site.solid(wall, (start + 0.05, start + bay - 0.05), (0.12, deep - 0.12), (level, level + 0.004), metal)
    tap = start + bay / 2
    site.solid(wall, (tap - 0.015, tap + 0.015), (0.07, 0.1), (level, level + 0.25), metal)
    site.solid(wall, (tap - 0.015, tap + 0.015), (0.07, 0.25), (level + 0.23, level + 0.26), metal)
    for _ in range(int(rng.integers(0, 6))):
        a = float(rng.uniform(s[0] + 0.05, s[1] - 0.35))
        wide, tall = float(rng.uniform(0.05, 0.3)), float(rng.uniform(0.06, 0.35))
        site.solid(
            wall,
            (a, a + wide),
            (0.05, 0.05 + min(wide, 0.25)),
            (level, level + tall),
            finish(rng, "plain", tone(rng, colorful=0.5), 0.2),
        )
    site.block(wall, s, (0.0, deep + 0.02), (0.0, level + 0.3))


def _column(site: _Site) -> None:
    """A pillar in the room or a pier at a wall."""
    rng = site.rng
    x, y, z = site.size
    paint = wall_finish(rng)
    if rng.random() < 0.6:
        width = float(rng.uniform(0.2, 0.9))
        found = site.any_wall(width)
        if found is not None:
            wall, s = found
            deep = float(rng.uniform(0.1, 0.4))
            site.solid(wall, s, (0.0, deep), (0.0, z), paint)
            site.block(wall, s, (0.0, deep), (0.0, z))
        return
    if min(x, y) < 3.6:
        return
    middle, half = np.array([x, y]) * rng.uniform(0.3, 0.7, size=2), float(rng.uniform(0.1, 0.25))
    if rng.random() < 0.5:
        lathed = parts.lathe([(half, 0.0), (half, z)], 20)
        points = lathed.vertices[:, [0, 2, 1]] + np.append(middle, 0.0)
        site.paint(points[lathed.faces], paint)
    else:
        site.paint(box_triangles([*(middle - half), 0.0], [*(middle + half), z]), paint)
    site.blocks.append(Boxes.aligned(np.array([[[*(middle - half), 0.0], [*(middle + half), z]]])))


def _corner_block(site: _Site) -> None:
    """A corner that belongs to another room: the floor is an L."""
    rng = site.rng
    if min(site.size[:2]) < 3.4:
        return
    wall = int(rng.integers(4))
    length = site.walls[wall].length
    a, deep = float(rng.uniform(0.5, 0.38 * length)), float(rng.uniform(0.5, 1.4))
    s = (-0.3, a) if rng.random() < 0.5 else (length - a, length + 0.3)
    if any(s[0] < stop and start < s[1] for start, stop in site.taken[wall]):
        return
    other = (wall + 3) % 4 if s[0] < 0 else (wall + 1) % 4
    near = site.walls[other].length
    reach = (near - deep - 0.3, near + 0.3) if s[0] < 0 else (-0.3, deep + 0.3)
    if any(reach[0] < stop and start < reach[1] for start, stop in site.taken[other]):
        return
    site.taken[wall].append(s)
    site.taken[other].append(reach)
    site.solid(wall, s, (-0.3, deep), (0.0, site.size[2]), wall_finish(rng))
    site.solid(wall, s, (-0.3, deep + 0.018), (0.0, 0.08), site.trim)
    site.block(wall, s, (-0.3, deep), (0.0, site.size[2]))


def _steps(site: _Site) -> None:
    """A stair along a wall, or a low platform."""
    rng = site.rng
    paint = board_finish(rng)
    if rng.random() < 0.4:
        found = site.any_wall(1.4)
        if found is not None:
            wall, s = found
            tall = float(rng.uniform(0.12, 0.4))
            site.solid(wall, s, (0.0, 0.7), (0.0, tall), paint)
            site.block(wall, s, (0.0, 0.75), (0.0, tall))
        return
    count = int(rng.integers(5, 11))
    found = site.any_wall(count * 0.26)
    if found is None:
        return
    wall, s = found
    width = float(rng.uniform(0.7, 0.95))
    for i in range(count):
        site.solid(
            wall, (s[0] + 0.26 * i, s[1]), (0.0, width), (0.18 * i, min(0.18 * (i + 1), site.size[2])), paint
        )
    site.block(wall, s, (0.0, width), (0.0, min(0.18 * count, site.size[2])))


def _rugs(site: _Site) -> None:
    """One or two rugs, turned a little, some of them round."""
    rng = site.rng
    for number in range(int(rng.integers(1, 3))):
        half = np.array(site.size[:2]) * rng.uniform(0.1, 0.3, size=2)
        middle = np.array(site.size[:2]) * rng.uniform(0.3, 0.7, size=2)
        angle = rng.normal(0, 0.15)
        if rng.random() < 0.2:
            ring = parts.circle(1.0, 32)[::-1] * half.min()
        else:
            ring = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * half
        sin, cos = np.sin(angle), np.cos(angle)
        ring = ring @ np.array([[cos, sin], [-sin, cos]]) + middle
        flat = np.column_stack([ring, np.full(len(ring), 0.004 + 0.003 * number)])
        fan = np.array([[0, i, i + 1] for i in range(1, len(flat) - 1)])
        site.paint(flat[fan], rug_finish(rng))


def _framed(site: _Site, wall: int, s: Range, z: Range, inside: Paint, depth: float = 0.02) -> None:
    """A panel with a rim on a wall."""
    rng = site.rng
    rim = float(rng.uniform(0.0, 0.05))
    if rim > 0.01:
        site.solid(wall, s, (0.0, depth), z, finish(rng, "plain", tone(rng, colorful=0.2), 0.2))
    inner = (s[0] + rim, s[1] - rim)
    site.solid(wall, inner, (0.0, depth + 0.003), (z[0] + rim, z[1] - rim), inside)


def _wall_things(site: _Site) -> None:
    """Pictures, posters, boards, mirrors, shelves with things, jackets, towels and clocks on walls."""
    rng = site.rng
    for _ in range(int(rng.integers(1, 8))):
        drawn = rng.random()
        if drawn < 0.5:
            width = float(rng.uniform(0.2, 1.1))
            found = site.any_wall(width)
            if found is None:
                return
            low = float(rng.uniform(0.9, 1.5))
            z = (low, min(low + float(rng.uniform(0.2, 1.1)), site.size[2] - 0.1))
            _framed(site, found[0], found[1], z, picture_finish(rng))
        elif drawn < 0.62:
            found = site.any_wall(float(rng.uniform(0.9, 2.2)))
            if found is None:
                continue
            bright = float(rng.uniform(0.85, 0.98)) if rng.random() < 0.7 else 0.1
            board = finish(rng, "text" if rng.random() < 0.3 else "plain", (bright,) * 3, 0.1, scale=2.0)
            _framed(site, found[0], found[1], (0.9, min(2.1, site.size[2] - 0.1)), board)
        elif drawn < 0.72:
            found = site.any_wall(float(rng.uniform(0.4, 0.9)))
            if found is not None:
                mirror = finish(rng, "photo", np.array([0.75, 0.78, 0.8]), 1.0, scale=4.0, turned=False)
                _framed(site, found[0], found[1], (float(rng.uniform(0.2, 1.1)), 1.9), mirror)
        elif drawn < 0.86:
            _wall_shelf(site)
        else:
            _hung(site)


def _wall_shelf(site: _Site) -> None:
    """A board on a wall with books and jars."""
    rng = site.rng
    found = site.any_wall(float(rng.uniform(0.5, 1.2)))
    if found is None:
        return
    wall, s = found
    board = board_finish(rng)
    for level in np.arange(rng.uniform(1.3, 1.6), site.size[2] - 0.4, 0.35)[: int(rng.integers(1, 3))]:
        z = float(level)
        site.solid(wall, s, (0.0, 0.22), (z, z + 0.025), board)
        start = s[0]
        while start < s[1] - 0.1:
            wide, tall = float(rng.uniform(0.05, 0.4)), float(rng.uniform(0.1, 0.28))
            stop = min(start + wide, s[1])
            white = (0.9, 0.9, 0.9)
            paint = (
                finish(rng, "books", white, 1.0, turned=False)
                if wide > 0.15
                else finish(rng, "plain", tone(rng, colorful=0.6), 0.2)
            )
            if rng.random() < 0.75:
                site.solid(wall, (start, stop), (0.02, 0.18), (z + 0.025, z + 0.025 + tall), paint)
            start = stop + float(rng.uniform(0.0, 0.1))
    site.block(wall, s, (0.0, 0.24), (1.25, site.size[2] - 0.05))


def _hung(site: _Site) -> None:
    """Jackets or towels on hooks."""
    rng = site.rng
    found = site.any_wall(float(rng.uniform(0.4, 1.0)))
    if found is None:
        return
    wall, s = found
    start = s[0]
    while start < s[1] - 0.2:
        wide, tall, high = (
            float(rng.uniform(0.2, 0.45)),
            float(rng.uniform(0.4, 1.0)),
            float(rng.uniform(1.5, 1.8)),
        )
        site.solid(
            wall,
            (start, start + wide),
            (0.02, float(rng.uniform(0.05, 0.16))),
            (high - tall, high),
            cloth_finish(rng),
        )
        start += wide + float(rng.uniform(0.02, 0.15))
    site.block(wall, s, (0.0, 0.16), (0.5, 1.8))


def _small_things(site: _Site) -> None:
    """Switches, sockets, thermostats, an air conditioner, a clock."""
    rng = site.rng
    white = finish(rng, "plain", (0.9, 0.9, 0.88), 0.1)
    for _ in range(int(rng.integers(2, 9))):
        found = site.any_wall(0.09)
        if found is not None:
            z = float(rng.choice([0.3, 1.1, 1.5]))
            site.solid(found[0], found[1], (0.0, 0.015), (z, z + 0.09), white)
    if rng.random() < 0.25:
        found = site.any_wall(0.8)
        if found is not None:
            high = site.size[2] - 0.1
            site.solid(found[0], found[1], (0.0, 0.2), (high - 0.28, high), white)
            site.block(found[0], found[1], (0.0, 0.2), (high - 0.28, high))


def _beams(site: _Site) -> None:
    """Beams or ducts below the ceiling."""
    rng = site.rng
    x, y, z = site.size
    paint = board_finish(rng)
    wide, tall = float(rng.uniform(0.08, 0.3)), float(rng.uniform(0.08, 0.25))
    for at in np.linspace(0, x, int(rng.integers(3, 7)))[1:-1]:
        site.paint(box_triangles([at - wide / 2, 0.0, z - tall], [at + wide / 2, y, z]), paint)


def _pipes(site: _Site) -> None:
    """Pipes upright in a corner or along the skirting."""
    rng = site.rng
    paint = finish(rng, "brushed", tone(rng, colorful=0.3), 0.3)
    wall = int(rng.integers(4))
    radius = float(rng.uniform(0.02, 0.06))
    at = float(rng.uniform(0.05, 0.3))
    site.solid(wall, (at, at + 2 * radius), (0.02, 0.02 + 2 * radius), (0.0, site.size[2]), paint)
    site.block(wall, (at, at + 2 * radius), (0.0, 0.03 + 2 * radius), (0.0, site.size[2]))


def _lamps(site: _Site) -> tuple[float, float, float]:
    """Hang one to six lamps, of which two cast shadows; return the light from everywhere."""
    rng = site.rng
    x, y, _ = site.size
    daylit = bool(site.lights) and site.sky > 0.5
    lit = not daylit or rng.random() < 0.6
    warmth = rng.uniform(-0.1, 0.5)
    hue = np.array([1.0, 1.0 - 0.35 * max(warmth, 0.0), 1.0 - 0.8 * max(warmth, 0.0)])
    if warmth < 0:
        hue = np.array([0.9, 0.97, 1.0])
    power = rng.uniform(1.0, 2.6)
    count = int(rng.choice([1, 2, 4, 6], p=[0.45, 0.25, 0.2, 0.1]))
    columns = 1 if count == 1 else 2
    rows = count // columns
    draw = _SHAPES[int(rng.integers(len(_SHAPES)))]
    glow = float(np.sqrt(rng.uniform(1.5, 8.0))) if lit else 0.75
    paint = finish(rng, "plain", hue * glow, 0.05, emissive=lit)
    casting = rng.permutation(count)[:2]
    for number in range(count):
        at = np.array([(number % columns + 0.5) / columns, (number // columns + 0.5) / rows])
        at = np.clip(at + rng.normal(0, 0.08 if count == 1 else 0.02, size=2), 0.12, 0.88) * [x, y]
        low = draw(site, at, paint)
        if lit:
            color = power * hue / np.sqrt(count) * rng.uniform(0.7, 1.2)
            half = float(rng.uniform(0.1, 0.35))
            down = np.array([0.0, 0.0, -1.0])
            shadows = number in casting
            if shadows:
                color = color * count / len(casting) * 0.8
            elif count > 2:
                continue
            site.lights.append(Light(np.append(at, low - 0.02), down, color, half, shadows))
    level = rng.uniform(0.12, 0.4) * (1.0 if lit else min(0.25 + 0.25 * site.sky, 1.2))
    mixed = (hue if lit else np.array([0.9, 0.96, 1.0])) * level
    return float(mixed[0]), float(mixed[1]), float(mixed[2])


def _panel(site: _Site, at: NDArray[np.float64], paint: Paint) -> float:
    z = site.size[2]
    half = np.array([0.3, 0.3]) if site.rng.random() < 0.5 else np.array([0.08, 0.6])
    site.paint(box_triangles([*(at - half), z - 0.05], [*(at + half), z - 0.001]), paint)
    return z - 0.05


def _spot(site: _Site, at: NDArray[np.float64], paint: Paint) -> float:
    z = site.size[2]
    site.paint(box_triangles([*(at - 0.06), z - 0.02], [*(at + 0.06), z - 0.001]), paint)
    return z - 0.03


def _pendant(site: _Site, at: NDArray[np.float64], paint: Paint) -> float:
    """A ball, cone or drum on a cord."""
    rng, z = site.rng, site.size[2]
    drop = float(rng.uniform(0.3, max(0.31, min(0.9, z - 1.9))))
    r, h = float(rng.uniform(0.1, 0.25)), float(rng.uniform(0.1, 0.3))
    shade = parts.lathe([(r * 0.4, 0.0), (r, h * 0.3), (r * rng.uniform(0.3, 1.0), h * 0.9), (0.03, h)], 16)
    points = shade.vertices[:, [0, 2, 1]] + np.append(at, z - drop)
    site.paint(points[shade.faces], paint)
    cord = finish(rng, "plain", (0.1,) * 3, 0.1)
    site.paint(box_triangles([*(at - 0.006), z - drop + h], [*(at + 0.006), z]), cord)
    return z - drop


_SHAPES: tuple[Callable[[_Site, NDArray[np.float64], Paint], float], ...] = (
    _panel,
    _panel,
    _spot,
    _pendant,
    _pendant,
)
