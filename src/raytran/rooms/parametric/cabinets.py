# SPDX-License-Identifier: Apache-2.0
"""Cabinets: chests of drawers, wardrobes, sideboards, night stands and low television cabinets."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from raytran.rooms.parametric import palette, parts
from raytran.rooms.parametric.parts import Color, Design

GAP = 0.006
"""Gap between neighbouring fronts, metres."""


class Carcass:
    """The closed case of a cabinet on feet or a plinth, onto whose front (-Z) doors and drawers are put.

    Args:
        design: the design that receives the parts.
        rng: draws feet, colours and the form of the handles.
        size: width, height and depth of the whole in metres, without handles.
    """

    def __init__(self, design: Design, rng: np.random.Generator, size: tuple[float, float, float]) -> None:
        self.design = design
        self.width, self.height, self.depth = size
        self.color = palette.pick(rng, palette.WOODS + palette.PAINTS)
        self.front_color = (
            palette.pick(rng, palette.PAINTS) if rng.random() < 0.3 else palette.shade(self.color, 1.12)
        )
        self.metal = palette.pick(rng, palette.METALS)
        self.knobs = bool(rng.random() < 0.4)
        self.foot = self._add_base(rng)
        body = self.height - self.foot
        case = (0, self.foot + body / 2, 0.01), (self.width, body, self.depth - 0.02)
        design.add(parts.box(*case), palette.shade(self.color, 0.9))
        lid = parts.cushion(
            (0, self.height + 0.008, 0),
            (self.width + 0.02, 0.024, self.depth + 0.01),
            corner=0.01,
            edge=0.006,
        )
        design.add(lid, self.color)

    def _add_base(self, rng: np.random.Generator) -> float:
        """Add legs or a recessed plinth and return its height."""
        x, z = self.width / 2 - 0.06, self.depth / 2 - 0.06
        if self.height < 1.3 and rng.random() < 0.5:
            foot = float(rng.uniform(0.1, 0.18))
            leg = parts.tube([(x + 0.02, 0, z + 0.02), (x, foot + 0.02, z)], [0.012, 0.022])
            self.design.add(parts.corners(leg), self.color)
            return foot
        self.design.add(
            parts.box((0, 0.03, 0.02), (self.width - 0.04, 0.06, self.depth - 0.06)),
            palette.shade(self.color, 0.6),
        )
        return 0.05

    def add_front(self, left: float, right: float, low: float, high: float, handle: str) -> None:
        """Add a front over a rectangle of the face.

        Args:
            left: x of its left edge, metres from the middle.
            right: x of its right edge.
            low: height of its lower edge above the floor.
            high: height of its upper edge.
            handle: ``drawer`` (across the middle), ``left`` or ``right`` (upright, near that edge).
        """
        x, y, z = (left + right) / 2, (low + high) / 2, -self.depth / 2 + 0.012
        panel = parts.box((x, y, z), (right - left - GAP, high - low - GAP, 0.024))
        self.design.add(panel, self.front_color)
        grip = z - 0.034
        hand = {"drawer": x, "left": left + 0.045, "right": right - 0.045}[handle]
        if self.knobs:
            knob = parts.lathe([(0.007, 0.0), (0.007, 0.015), (0.015, 0.02), (0.013, 0.03)], 12)
            turned = parts.tilted(knob, -90)
            self.design.add(parts.moved(turned, (hand, y, z - 0.01)), self.metal)
            return
        reach = 0.3 * min(right - left, 0.5) if handle == "drawer" else 0.09
        step = np.array([reach, 0, 0]) if handle == "drawer" else np.array([0, reach, 0])
        middle = np.array([hand, y, grip])
        stems = [middle + 0.85 * side * step for side in (-1, 1)]
        bars = [parts.tube([stem, stem + np.array([0, 0, 0.034])], 0.005) for stem in stems]
        self.design.add([parts.tube([middle - step, middle + step], 0.007), *bars], self.metal)

    def add_drawers(self, left: float, right: float, low: float, high: float, count: int) -> None:
        """Fill a rectangle of the face with ``count`` drawers on top of each other."""
        levels = np.linspace(low, high, count + 1)
        for below, above in pairwise(levels):
            self.add_front(left, right, below, above, "drawer")

    def add_doors(self, left: float, right: float, low: float, high: float, count: int) -> None:
        """Fill a rectangle of the face with ``count`` doors side by side that open in pairs."""
        edges = np.linspace(left, right, count + 1)
        for i in range(count):
            self.add_front(edges[i], edges[i + 1], low, high, "right" if i % 2 == 0 else "left")


def chest_of_drawers(rng: np.random.Generator) -> Design:
    """One to three columns of drawers."""
    design = Design("chest of drawers", support="wall")
    size = rng.uniform(0.45, 1.4), rng.uniform(0.7, 1.25), rng.uniform(0.4, 0.52)
    case = Carcass(design, rng, size)
    columns, rows = max(1, round(size[0] / 0.6)), int(rng.integers(3, 6))
    edges = np.linspace(-size[0] / 2, size[0] / 2, columns + 1)
    for left, right in pairwise(edges):
        case.add_drawers(left, right, case.foot, size[1], rows)
    return design


def wardrobe(rng: np.random.Generator) -> Design:
    """Tall cabinet with two to four doors, sometimes with drawers below."""
    design = Design("wardrobe", support="wall")
    doors = int(rng.integers(2, 5))
    size = doors * rng.uniform(0.42, 0.52), rng.uniform(1.75, 2.15), rng.uniform(0.52, 0.62)
    case = Carcass(design, rng, size)
    half, low = size[0] / 2, case.foot
    if rng.random() < 0.4:
        low = 0.45
        case.add_drawers(-half, half, case.foot, low, 1)
    case.add_doors(-half, half, low, size[1], doors)
    return design


def sideboard(rng: np.random.Generator) -> Design:
    """Wide, waist-high cabinet with doors beside or below drawers."""
    design = Design("sideboard", support="wall")
    size = rng.uniform(1.0, 1.7), rng.uniform(0.7, 0.92), rng.uniform(0.38, 0.48)
    case = Carcass(design, rng, size)
    half, low, high = size[0] / 2, case.foot, size[1]
    if rng.random() < 0.5:
        split = high - 0.2
        case.add_doors(-half, half, low, split, 2 if size[0] < 1.2 else 4)
        case.add_drawers(-half, 0.0, split, high, 1)
        case.add_drawers(0.0, half, split, high, 1)
    else:
        middle = half / 3
        case.add_doors(-half, -middle, low, high, 1)
        case.add_drawers(-middle, middle, low, high, 3)
        case.add_front(middle, half, low, high, "left")
    return design


def night_stand(rng: np.random.Generator) -> Design:
    """Small cabinet beside a bed: drawers, or a drawer over a door."""
    design = Design("night stand", support="wall")
    size = rng.uniform(0.4, 0.55), rng.uniform(0.45, 0.62), rng.uniform(0.36, 0.44)
    case = Carcass(design, rng, size)
    half = size[0] / 2
    if rng.random() < 0.6:
        case.add_drawers(-half, half, case.foot, size[1], int(rng.integers(2, 4)))
    else:
        case.add_doors(-half, half, case.foot, size[1] - 0.15, 1)
        case.add_drawers(-half, half, size[1] - 0.15, size[1], 1)
    return design


def tv_cabinet(rng: np.random.Generator) -> Design:
    """Low, wide cabinet: an open compartment between doors or drawers."""
    design = Design("tv cabinet", support="wall")
    width, height, depth = rng.uniform(1.1, 1.8), rng.uniform(0.38, 0.55), rng.uniform(0.38, 0.46)
    color = palette.pick(rng, palette.WOODS + palette.PAINTS)
    metal = palette.pick(rng, palette.METALS)
    foot, wing = rng.uniform(0.04, 0.12), rng.uniform(0.27, 0.33) * width
    design.add(
        parts.corners(parts.box((width / 2 - 0.06, foot / 2, depth / 2 - 0.06), (0.04, foot + 0.02, 0.04))),
        metal,
    )
    boards = [foot + 0.012, height - 0.012]
    design.add([parts.box((0, y, 0), (width, 0.024, depth)) for y in boards], color)
    back = parts.box((0, (foot + height) / 2, depth / 2 - 0.008), (width - 0.01, height - foot - 0.01, 0.012))
    design.add(back, palette.shade(color, 0.7))
    _wings(design, (width, height, depth), foot, wing, color, metal)
    if rng.random() < 0.6:
        design.add(parts.box((0, (foot + height) / 2, 0.01), (width - 2 * wing, 0.018, depth - 0.05)), color)
    return design


def _wings(
    design: Design, size: tuple[float, float, float], foot: float, wing: float, color: Color, metal: Color
) -> None:
    """Closed boxes with a front and a handle at both ends of a low cabinet."""
    width, height, depth = size
    x, y, tall = width / 2 - wing / 2, (foot + height) / 2, height - foot - 0.03
    design.add(
        parts.both_sides(parts.box((x, y, 0.012), (wing - 0.004, tall, depth - 0.026))),
        palette.shade(color, 0.9),
    )
    front = parts.box((x, y, -depth / 2 + 0.004), (wing - 0.012, tall - 0.012, 0.02))
    design.add(parts.both_sides(front), palette.shade(color, 1.12))
    grip = parts.tube(
        [(x - 0.08, y + 0.3 * tall, -depth / 2 - 0.022), (x + 0.08, y + 0.3 * tall, -depth / 2 - 0.022)],
        0.008,
    )
    stem = parts.tube([(x, y + 0.3 * tall, -depth / 2 - 0.022), (x, y + 0.3 * tall, -depth / 2)], 0.006)
    design.add(parts.both_sides(grip) + parts.both_sides(stem), metal)
