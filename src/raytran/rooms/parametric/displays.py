# SPDX-License-Identifier: Apache-2.0
"""Displays: computer monitors, flat televisions on feet or a plate, and deep old tubes. Screens face -Z."""

from __future__ import annotations

import numpy as np

from raytran.rooms.parametric import palette, parts
from raytran.rooms.parametric.parts import Color, Design


def monitor(rng: np.random.Generator) -> Design:
    """Monitor on a neck and a foot plate, leaning back a little."""
    design = Design("monitor", support="table")
    width = rng.uniform(0.42, 0.68)
    height, lift = width / rng.uniform(1.55, 1.85), rng.uniform(0.08, 0.16)
    color = palette.pick(rng, palette.PLASTICS[:3])
    _panel(design, width, height, lift, float(rng.uniform(0, 6)), color)
    neck = parts.tube([(0, 0.01, 0.06), (0, lift + 0.3 * height, 0.055)], [0.022, 0.018], 12)
    design.add(neck, palette.shade(color, 0.9))
    if rng.random() < 0.5:
        foot = parts.moved(parts.prism(parts.ellipse(0.5 * width, 0.2), 0.0, 0.012), (0, 0, 0.02))
    else:
        foot = parts.cushion((0, 0.006, 0.02), (0.45 * width, 0.012, 0.19), corner=0.02, edge=0.003)
    design.add(foot, color)
    return design


def television(rng: np.random.Generator) -> Design:
    """Wide flat television on two feet near its ends or on one plate."""
    design = Design("television", support="table")
    width = rng.uniform(0.8, 1.35)
    height, lift = width / 1.72, rng.uniform(0.05, 0.09)
    color = palette.pick(rng, palette.PLASTICS[:1] + palette.METALS[:2])
    _panel(design, width, height, lift, 0.0, color)
    if rng.random() < 0.5:
        x = rng.uniform(0.3, 0.42) * width
        for reach in (-0.1, 0.14):
            foot = parts.tube([(x, 0.008, reach), (x, lift + 0.05, 0.03)], 0.01)
            design.add(parts.both_sides(foot), color)
    else:
        design.add(parts.box((0, (lift + 0.06) / 2, 0.04), (0.18, lift + 0.06, 0.03)), color)
        design.add(
            parts.cushion((0, 0.008, 0.03), (0.42 * width, 0.016, 0.26), corner=0.03, edge=0.004), color
        )
    return design


def tube_television(rng: np.random.Generator) -> Design:
    """Old television or monitor: a deep housing that narrows to the back."""
    design = Design("tube television", support="table")
    width = rng.uniform(0.38, 0.65)
    height, depth = 0.8 * width, 0.85 * width
    color = palette.pick(rng, palette.PLASTICS[:3])
    sections = [(1.0, -0.5), (1.0, -0.1), (0.9, 0.05), (0.55, 0.42), (0.5, 0.5)]
    outlines = [parts.rectangle(share * width, share * height, 0.03) for share, _ in sections]
    housing = parts.stack(outlines, [place * depth for _, place in sections])
    design.add(parts.moved(parts.tilted(housing, 90), (0, height / 2 + 0.03, 0)), color)
    screen = parts.cushion((0, 0, 0), (0.86 * width, 0.03, 0.78 * height), corner=0.04, edge=0.012)
    design.add(parts.moved(parts.tilted(screen, 90), (0, height / 2 + 0.045, -depth / 2)), palette.SCREEN)
    design.add(
        parts.box((0, 0.02, -0.1 * depth), (0.7 * width, 0.04, 0.6 * depth)), palette.shade(color, 0.8)
    )
    return design


def _panel(design: Design, width: float, height: float, lift: float, lean: float, color: Color) -> None:
    """Thin housing with a screen in front and a narrower bulge behind, its lower edge at ``lift``."""
    middle, pivot = lift + height / 2, (0, lift, 0)
    housing = parts.box((0, middle, 0.0), (width, height, 0.03))
    bulge = parts.cushion(
        (0, middle - 0.06 * height, 0.032), (0.6 * width, 0.6 * height, 0.045), corner=0.02, edge=0.02
    )
    screen = parts.box((0, middle + 0.006, -0.016), (width - 0.03, height - 0.042, 0.004))
    design.add([parts.tilted(housing, lean, pivot), parts.tilted(bulge, lean, pivot)], color)
    design.add(parts.tilted(screen, lean, pivot), palette.SCREEN)
