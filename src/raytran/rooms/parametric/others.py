# SPDX-License-Identifier: Apache-2.0
"""Furniture of the class "other": beds and pillows, lamps, printers and copiers."""

from __future__ import annotations

import numpy as np

from raytran.rooms.parametric import palette, parts
from raytran.rooms.parametric.parts import Color, Design

SHADES: tuple[Color, ...] = ((0.95, 0.91, 0.80), (0.90, 0.84, 0.72), (0.80, 0.35, 0.25), (0.35, 0.45, 0.50))
"""Colours of lamp shades."""

PAPER: Color = (0.97, 0.97, 0.96)
"""Colour of the sheets."""


def bed(rng: np.random.Generator) -> Design:
    """Single or double bed: frame, headboard, sometimes a footboard, mattress, blanket and fixed pillows."""
    design = Design("bed", support="wall")
    width = rng.uniform(0.9, 1.1) if rng.random() < 0.45 else rng.uniform(1.4, 1.8)
    length, rail = rng.uniform(1.95, 2.1), rng.uniform(0.24, 0.34)
    wood = palette.pick(rng, palette.WOODS + palette.FABRICS[:3])
    frame = (0, (rail + 0.1) / 2, 0), (width, rail - 0.1, length)
    design.add(parts.cushion(*frame, corner=0.03, edge=0.01), wood)
    foot = parts.box((width / 2 - 0.06, 0.06, length / 2 - 0.06), (0.07, 0.12, 0.07))
    design.add(parts.corners(foot), palette.shade(wood, 0.7))
    head = rng.uniform(0.85, 1.2)
    board = (0, head / 2, length / 2 + 0.02), (width + 0.04, head, 0.06)
    design.add(parts.cushion(*board, corner=0.02, edge=0.04), palette.shade(wood, 0.9))
    if rng.random() < 0.4:
        board = (0, (rail + 0.2) / 2, -length / 2 - 0.015), (width + 0.02, rail + 0.2, 0.04)
        design.add(parts.cushion(*board, corner=0.015, edge=0.02), palette.shade(wood, 0.9))
    _bedding(design, rng, width, length, rail)
    return design


def _bedding(design: Design, rng: np.random.Generator, width: float, length: float, rail: float) -> None:
    """Mattress, blanket over its lower two thirds, and one pillow a sleeper."""
    thick = rng.uniform(0.16, 0.24)
    top = rail + thick - 0.04
    mattress = (0, top - thick / 2, 0), (width - 0.05, thick, length - 0.06)
    design.add(parts.cushion(*mattress, corner=0.06, edge=0.05), palette.WHITE)
    cover = length * rng.uniform(0.6, 0.72)
    blanket = (0, top - 0.06, -length / 2 + cover / 2 + 0.02), (width - 0.02, 0.16, cover)
    design.add(
        parts.cushion(*blanket, corner=0.06, edge=0.05), palette.pick(rng, palette.LINENS + palette.FABRICS)
    )
    count = 1 if width < 1.2 else 2
    color = palette.pick(rng, palette.LINENS)
    for i in range(count):
        x = (i - (count - 1) / 2) * width / 2
        part = _puff((0.62 * width / count + 0.1, 0.14, 0.4))
        design.add(parts.moved(part, (x, top + 0.04, length / 2 - 0.3)), color)


def pillow(rng: np.random.Generator) -> Design:
    """Loose pillow lying flat, square or oblong."""
    square = bool(rng.random() < 0.5)
    design = Design("pillow", support="bed", symmetry=4 if square else 2)
    width = rng.uniform(0.38, 0.5) if square else rng.uniform(0.55, 0.75)
    depth = width if square else width / rng.uniform(1.4, 1.7)
    color: Color = palette.pick(rng, palette.LINENS + palette.FABRICS)
    design.add(_puff((width, rng.uniform(0.11, 0.17), depth)), color)
    return design


def _puff(size: tuple[float, float, float]) -> parts.Part:
    """Pillow about the origin: thick in the middle, pinched at its seam, corners drawn out."""
    width, height, depth = size
    share = np.linspace(0.0, 1.0, 7)[1:]
    outlines = [_pinched(width * s, depth * s) for s in share]
    heights = [float(0.5 * height * np.sqrt(1 - s**2.4) + 0.004) for s in share]
    below, above = [-h for h in heights], heights[::-1]
    return parts.stack(outlines + outlines[::-1], below + above)


def _pinched(width: float, depth: float) -> parts.Vertices:
    """Rectangle whose sides curve inwards between the corners."""
    angle = 2 * np.pi * (np.arange(32) + 0.5) / 32
    ring = np.stack([np.cos(angle), -np.sin(angle)], axis=1)
    shaped = np.sign(ring) * np.abs(ring) ** 0.45
    shaped /= np.abs(shaped).max()
    return shaped * np.array([width / 2, depth / 2])


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


def printer(rng: np.random.Generator) -> Design:
    """Desk printer: body, scanner lid, control panel, paper coming out in front, a feeder behind."""
    design = Design("printer", support="table")
    width, depth, height = rng.uniform(0.38, 0.5), rng.uniform(0.32, 0.42), rng.uniform(0.16, 0.28)
    body = palette.pick(rng, palette.PLASTICS[:3])
    dark = palette.shade(body, 0.6)
    design.add(parts.cushion((0, height / 2, 0), (width, height, depth), corner=0.03, edge=0.012), body)
    design.add(
        parts.cushion((0, height + 0.012, 0.02), (width - 0.02, 0.035, depth - 0.06), corner=0.02, edge=0.01),
        dark,
    )
    panel = parts.box((0, height - 0.03, -depth / 2 - 0.005), (0.5 * width, 0.06, 0.02))
    design.add(parts.tilted(panel, 25, (0, height - 0.03, -depth / 2)), palette.SCREEN)
    tray = (0, 0.25 * height, -depth / 2 - 0.06), (0.62 * width, 0.015, 0.18)
    design.add(parts.box(*tray), dark)
    design.add(parts.box((0, 0.25 * height + 0.012, -depth / 2 - 0.05), (0.5 * width, 0.01, 0.18)), PAPER)
    if rng.random() < 0.6:
        feeder = parts.box((0, 0.12, 0.0), (0.55 * width, 0.26, 0.012))
        sheets = parts.box((0, 0.13, -0.012), (0.48 * width, 0.26, 0.012))
        place = (0, height - 0.04, depth / 2 - 0.03)
        design.add(parts.moved(parts.tilted(feeder, 25), place), dark)
        design.add(parts.moved(parts.tilted(sheets, 25), place), PAPER)
    return design


def copier(rng: np.random.Generator) -> Design:
    """Office copier: cassettes below, a slot for the output, scanner with lid above."""
    design = Design("copier", support="wall")
    width, depth, height = rng.uniform(0.55, 0.68), rng.uniform(0.55, 0.66), rng.uniform(0.9, 1.1)
    body = palette.pick(rng, palette.PAINTS[:3])
    dark = palette.shade(body, 0.5)
    base = 0.62 * height
    design.add(parts.box((0, base / 2 + 0.02, 0), (width, base - 0.04, depth)), body)
    design.add(
        parts.corners(parts.box((width / 2 - 0.06, 0.02, depth / 2 - 0.06), (0.06, 0.04, 0.04))),
        palette.RUBBER,
    )
    for level in np.linspace(0.14, 0.7, 4):
        front = (0, level * base, -depth / 2 - 0.005), (width - 0.04, 0.17 * base, 0.016)
        design.add(parts.box(*front), palette.shade(body, 0.93))
        design.add(parts.box((0, level * base, -depth / 2 - 0.016), (0.16, 0.03, 0.012)), dark)
    column = (
        (0.12 * width, (base + 0.85 * height) / 2, 0.2 * depth),
        (0.76 * width, 0.85 * height - base + 0.02, 0.6 * depth),
    )
    design.add(parts.box(*column), palette.shade(body, 0.8))
    design.add(parts.box((0, 0.87 * height, 0.02), (width, 0.1 * height, depth - 0.04)), body)
    lid = (0, 0.95 * height, 0.04), (width - 0.03, 0.08 * height, depth - 0.12)
    design.add(parts.cushion(*lid, corner=0.03, edge=0.015), palette.shade(body, 0.7))
    panel = parts.cushion((-0.1 * width, 0, 0), (0.5 * width, 0.02, 0.14), corner=0.02, edge=0.006)
    design.add(parts.moved(parts.tilted(panel, -20), (0, 0.9 * height, -depth / 2 - 0.03)), dark)
    design.add(
        parts.box((-width / 2 - 0.12, 0.55 * height, 0.1), (0.26, 0.02, 0.32)), palette.shade(body, 0.8)
    )
    return design
