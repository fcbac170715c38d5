# SPDX-License-Identifier: Apache-2.0
"""Lamps: floor lamps on a pole or an arc, table lamps with a shade, jointed desk lamps."""

from __future__ import annotations

import numpy as np

from raytran.rooms.parametric import palette, parts
from raytran.rooms.parametric.design import Color, Design

SHADES: tuple[Color, ...] = ((0.95, 0.91, 0.80), (0.90, 0.84, 0.72), (0.80, 0.35, 0.25), (0.35, 0.45, 0.50))
"""Colours of lamp shades."""


def floor_lamp(rng: np.random.Generator) -> Design:
    """Round foot, pole and a drum, cone or bowl of a shade: a body of revolution."""
    design = Design("floor lamp", symmetry=0)
    height, radius = rng.uniform(1.35, 1.75), rng.uniform(0.16, 0.25)
    metal = palette.pick(rng, palette.METALS)
    foot = rng.uniform(0.12, 0.16)
    pole = [(foot, 0.0), (foot, 0.015), (0.025, 0.03), (0.012, 0.06), (0.012, height - 0.06)]
    design.add(parts.lathe(pole), metal)
    drop, upper = rng.uniform(0.2, 0.32), rng.uniform(0.5, 1.0) * radius
    design.add(_round_shade(radius, upper, height - drop, height), palette.pick(rng, SHADES))
    return design


def arc_lamp(rng: np.random.Generator) -> Design:
    """Heavy foot, an arm that bends over sideways, and a hanging bowl."""
    design = Design("floor lamp")
    height, reach = rng.uniform(1.55, 1.85), rng.uniform(0.55, 0.9)
    side = float(rng.choice([-1.0, 1.0]))
    metal = palette.pick(rng, palette.METALS)
    foot = -side * reach / 2
    design.add(parts.moved(parts.lathe([(0.15, 0.0), (0.15, 0.04), (0.03, 0.05)]), (foot, 0, 0)), metal)
    angle = np.linspace(0.0, 0.9 * np.pi, 14)
    bend = np.stack(
        [
            foot + side * reach / 2 * (1 - np.cos(angle)),
            0.5 * height + 0.5 * height * np.sin(angle),
            0 * angle,
        ],
        axis=1,
    )
    design.add(parts.tube(np.concatenate([[(foot, 0.03, 0.0)], bend]), 0.012), metal)
    x, y, _ = bend[-1]
    design.add(
        parts.moved(_round_shade(0.15, 0.06, -0.14, 0.0), (x, y, 0)),
        palette.pick(rng, SHADES + palette.METALS),
    )
    return design


def table_lamp(rng: np.random.Generator) -> Design:
    """Turned body with a round shade, or a square block with a square shade."""
    square = bool(rng.random() < 0.3)
    design = Design("table lamp", support="table", symmetry=4 if square else 0)
    height, radius = rng.uniform(0.36, 0.58), rng.uniform(0.11, 0.17)
    body, color = rng.uniform(0.05, 0.09), palette.pick(rng, palette.WOODS + palette.METALS + palette.PAINTS)
    waist = 0.5 * height
    upper, drop = rng.uniform(0.55, 0.95) * radius, 0.42 * height
    if square:
        design.add(
            parts.cushion((0, waist / 2, 0), (1.3 * body, waist, 1.3 * body), corner=0.01, edge=0.01), color
        )
        design.add(parts.prism(parts.circle(0.009, 16), 0.5 * waist, height - 0.04), color)
        walls = [parts.rectangle(2 * w, 2 * w, 0.01) for w in (radius, upper, upper - 0.006, radius - 0.006)]
        shade = parts.stack(walls, [height - drop, height, height, height - drop], closed=True)
        design.add(shade, palette.pick(rng, SHADES))
        design.add(parts.spokes(parts.box((upper / 2, height - 0.045, 0), (upper, 0.008, 0.008)), 4), color)
        return design
    neck = [(0.4 * body, 0.85 * waist), (0.011, waist), (0.009, height - 0.03)]
    profile = [
        (body, 0.0),
        (body, 0.02),
        (0.6 * body, 0.05),
        (body * rng.uniform(0.7, 1.2), 0.5 * waist),
        *neck,
    ]
    design.add(parts.lathe(profile), color)
    design.add(_round_shade(radius, upper, height - drop, height), palette.pick(rng, SHADES))
    return design


def desk_lamp(rng: np.random.Generator) -> Design:
    """Two straight arms with a joint and a tilted reflector that points forwards."""
    design = Design("table lamp", support="table")
    color, height = palette.pick(rng, palette.PLASTICS + palette.METALS), rng.uniform(0.38, 0.52)
    back = rng.uniform(0.06, 0.12)
    design.add(parts.lathe([(0.09, 0.0), (0.09, 0.015), (0.02, 0.03)], 24), color)
    elbow, head = (0, 0.6 * height, back), (0, height, -0.12)
    design.add(
        [parts.tube([(0, 0.02, 0), elbow], 0.009), parts.tube([elbow, head], 0.009)],
        palette.pick(rng, palette.METALS),
    )
    design.add(parts.tube([(-0.02, 0.6 * height, back), (0.02, 0.6 * height, back)], 0.018, 12), color)
    reflector = parts.lathe([(0.075, -0.1), (0.06, -0.05), (0.025, 0.0), (0.025, 0.03)], 24)
    design.add(parts.moved(parts.tilted(reflector, 25), head), color)
    return design


def _round_shade(lower: float, upper: float, bottom: float, top: float) -> parts.Part:
    """Round shade, hollow and open below, whose top is a thin disc that holds it to the pole."""
    wall = 0.006
    inside = [(upper - wall, top - wall), (lower - wall, bottom)]
    return parts.lathe([*inside, (lower, bottom), (upper, top)])
