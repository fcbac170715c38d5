# SPDX-License-Identifier: Apache-2.0
"""Printers for a desk and copiers that stand on the floor."""

from __future__ import annotations

import numpy as np

from raytran.rooms.parametric import palette, parts
from raytran.rooms.parametric.design import Color, Design

PAPER: Color = (0.97, 0.97, 0.96)
"""Colour of the sheets."""


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
