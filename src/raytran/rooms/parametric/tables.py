# SPDX-License-Identifier: Apache-2.0
"""Tables: round, oval, square and rectangular ones, coffee tables, desks with drawers, corner desks."""

from __future__ import annotations

import numpy as np

from raytran.rooms.parametric import palette, parts
from raytran.rooms.parametric.parts import Color, Design


def round_table(rng: np.random.Generator) -> Design:
    """Round top on a turned pedestal (a body of revolution) or on four legs."""
    radius = rng.uniform(0.35, 0.65)
    height = rng.uniform(0.42, 0.5) if radius < 0.42 and rng.random() < 0.5 else rng.uniform(0.7, 0.76)
    design = Design("coffee table" if height < 0.6 else "dining table")
    wood = palette.pick(rng, palette.WOODS + palette.PAINTS[:1])
    rim = [(radius - 0.015, height - 0.035), (radius, height - 0.025), (radius, height - 0.008)]
    design.add(parts.lathe([*rim, (radius - 0.008, height)], 40), wood)
    if rng.random() < 0.5:
        design.symmetry = 0
        foot, stem = 0.6 * radius, rng.uniform(0.035, 0.06)
        profile = [
            (foot, 0.0),
            (foot, 0.02),
            (1.3 * stem, 0.07),
            (stem, 0.4 * height),
            (1.6 * stem, height - 0.02),
        ]
        design.add(parts.lathe(profile), palette.pick(rng, palette.METALS + palette.WOODS))
    else:
        design.symmetry = 4
        top, floor = 0.52 * radius, rng.uniform(0.52, 0.68) * radius
        leg = parts.tube([(floor, 0, floor), (top, height - 0.02, top)], [0.015, 0.026])
        design.add(parts.spokes(leg, 4), palette.pick(rng, palette.WOODS))
    return design


def square_table(rng: np.random.Generator) -> Design:
    """Square top, apron and four square legs."""
    width = rng.uniform(0.55, 0.95)
    height = rng.uniform(0.4, 0.5) if width < 0.75 else rng.uniform(0.7, 0.76)
    design = Design("coffee table" if height < 0.6 else "dining table", symmetry=4)
    wood = palette.pick(rng, palette.WOODS)
    top = parts.cushion((0, height - 0.015, 0), (width, 0.03, width), corner=0.02, edge=0.006)
    design.add(top, palette.pick(rng, palette.WOODS))
    thickness, reach = rng.uniform(0.04, 0.07), width / 2 - 0.06
    leg = parts.box((reach, (height - 0.02) / 2, reach), (thickness, height - 0.02, thickness))
    apron = parts.box((0, height - 0.07, reach), (2 * reach, 0.09, 0.02))
    design.add(parts.spokes(leg, 4) + parts.spokes(apron, 4), wood)
    return design


def dining_table(rng: np.random.Generator) -> Design:
    """Long table: rectangular on four legs, or oval on two pedestals."""
    width = rng.uniform(1.2, 2.0)
    depth, height = min(rng.uniform(0.75, 1.0), width / 1.35), rng.uniform(0.71, 0.77)
    design = Design("dining table", symmetry=2)
    wood = palette.pick(rng, palette.WOODS)
    if rng.random() < 0.35:
        design.add(parts.prism(parts.ellipse(width, depth), height - 0.035, height), wood)
        _pedestals(design, width, depth, height, palette.shade(wood, 0.8))
        return design
    design.add(parts.cushion((0, height - 0.018, 0), (width, 0.036, depth), corner=0.03, edge=0.008), wood)
    _four_legs(design, rng, width, depth, height, palette.shade(wood, 0.85))
    return design


def coffee_table(rng: np.random.Generator) -> Design:
    """Low rectangular table, often with a lower shelf."""
    width = rng.uniform(0.85, 1.25)
    depth, height = rng.uniform(0.48, 0.62), rng.uniform(0.36, 0.48)
    design = Design("coffee table", symmetry=2)
    wood = palette.pick(rng, palette.WOODS + palette.PAINTS)
    design.add(parts.cushion((0, height - 0.015, 0), (width, 0.03, depth), corner=0.02, edge=0.006), wood)
    _four_legs(design, rng, width, depth, height, palette.pick(rng, palette.WOODS + palette.METALS))
    if rng.random() < 0.6:
        shelf = parts.box((0, 0.3 * height, 0), (width - 0.12, 0.018, depth - 0.12))
        design.add(shelf, palette.shade(wood, 0.9))
    return design


def drawer_desk(rng: np.random.Generator) -> Design:
    """Desk with a pedestal of drawers on one side, or on both."""
    width, depth, height = rng.uniform(1.1, 1.7), rng.uniform(0.6, 0.8), rng.uniform(0.71, 0.76)
    design = Design("desk")
    wood = palette.pick(rng, palette.WOODS + palette.PAINTS[:2])
    front = palette.shade(wood, rng.uniform(0.8, 0.95))
    design.add(parts.box((0, height - 0.015, 0), (width, 0.03, depth)), wood)
    sides = [-1.0, 1.0] if width > 1.4 and rng.random() < 0.5 else [float(rng.choice([-1.0, 1.0]))]
    metal = palette.pick(rng, palette.METALS)
    for side in sides:
        _drawer_pedestal(design, side * (width / 2 - 0.24), depth, height, front, metal)
    if len(sides) == 1:
        design.add(
            parts.box(
                (-sides[0] * (width / 2 - 0.03), height / 2 - 0.015, 0), (0.03, height - 0.03, depth - 0.06)
            ),
            wood,
        )
    design.add(parts.box((0, height - 0.2, depth / 2 - 0.06), (width - 0.08, 0.35, 0.018)), wood)
    return design


def corner_desk(rng: np.random.Generator) -> Design:
    """L-shaped worktop on metal legs with a panel below its back edge."""
    width, depth, height = rng.uniform(1.4, 1.8), rng.uniform(1.1, 1.4), rng.uniform(0.71, 0.76)
    bench = rng.uniform(0.55, 0.65)
    side = float(rng.choice([-1.0, 1.0]))
    design = Design("desk")
    wood, metal = palette.pick(rng, palette.WOODS + palette.PAINTS[:2]), palette.pick(rng, palette.METALS)
    back, wing = depth / 2 - bench / 2, side * (width / 2 - bench / 2)
    design.add(parts.box((0, height - 0.015, back), (width, 0.03, bench)), wood)
    design.add(parts.box((wing, height - 0.015, -bench / 2), (bench, 0.03, depth - bench)), wood)
    inner, outer = side * (width / 2 - bench + 0.05), side * (width / 2 - 0.05)
    low, high = -depth / 2 + 0.05, depth / 2 - 0.05
    feet = [(-outer, high), (-outer, high - bench + 0.1), (outer, high), (outer, low), (inner, low)]
    design.add([parts.tube([(x, 0, z), (x, height - 0.02, z)], 0.025, 12) for x, z in feet], metal)
    design.add(parts.box((0, height - 0.2, high), (width - 0.14, 0.32, 0.018)), palette.shade(wood, 0.9))
    return design


def _four_legs(
    design: Design, rng: np.random.Generator, width: float, depth: float, height: float, color: Color
) -> None:
    """Straight, tapered or panel legs in the four corners."""
    style = rng.integers(3)
    x, z, top = width / 2 - 0.07, depth / 2 - 0.07, height - 0.02
    if style == 0:
        design.add(parts.corners(parts.box((x, top / 2, z), (0.055, top, 0.055))), color)
        rail = parts.box((0, height - 0.06, z), (2 * x, 0.07, 0.02))
        design.add([rail, parts.mirrored(rail, axis=2)], color)
    elif style == 1:
        design.add(
            parts.corners(parts.tube([(x + 0.03, 0, z + 0.02), (x - 0.03, top, z - 0.03)], [0.014, 0.026])),
            color,
        )
    else:
        design.add(parts.both_sides(parts.box((x, top / 2, 0), (0.04, top, depth - 0.08))), color)
        design.add(parts.box((0, 0.45 * height, 0), (2 * x, 0.08, 0.025)), color)


def _pedestals(design: Design, width: float, depth: float, height: float, color: Color) -> None:
    """Two columns with cross feet and a stretcher between them."""
    x = 0.26 * width
    column = parts.moved(parts.lathe([(0.06, 0.05), (0.04, 0.3), (0.07, height - 0.03)], 16), (x, 0, 0))
    foot = parts.cushion((x, 0.035, 0), (0.09, 0.07, 0.7 * depth), corner=0.02, edge=0.02)
    stretcher = parts.box((0, 0.3 * height, 0), (2 * x, 0.08, 0.03))
    design.add([*parts.spokes(column, 2), *parts.spokes(foot, 2), stretcher], color)


def _drawer_pedestal(
    design: Design, x: float, depth: float, height: float, color: Color, metal: Color
) -> None:
    """Case of three drawers under a worktop, fronts at -Z with bar handles."""
    case_height, case_depth = height - 0.05, depth - 0.06
    design.add(
        parts.box((x, 0.02 + case_height / 2, 0), (0.42, case_height, case_depth)), palette.shade(color, 0.9)
    )
    share = (case_height - 0.02) / 3
    for level in range(3):
        y = 0.03 + share * (level + 0.5)
        design.add(parts.box((x, y, -case_depth / 2 - 0.006), (0.4, share - 0.015, 0.018)), color)
        design.add(
            parts.tube([(x - 0.07, y, -case_depth / 2 - 0.03), (x + 0.07, y, -case_depth / 2 - 0.03)], 0.008),
            metal,
        )
