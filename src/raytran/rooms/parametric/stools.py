# SPDX-License-Identifier: Apache-2.0
"""Stools: round and square seats on four legs, on a pedestal, or upholstered down to the floor."""

from __future__ import annotations

import numpy as np

from raytran.rooms.parametric import palette, parts
from raytran.rooms.parametric.design import Design


def pedestal_stool(rng: np.random.Generator) -> Design:
    """Bar stool: round seat, column and foot disc, with a plate for the feet if it is high."""
    design = Design("stool", symmetry=0)
    height, radius = rng.uniform(0.45, 0.78), rng.uniform(0.16, 0.21)
    metal = palette.pick(rng, palette.METALS)
    foot = 1.1 * radius
    design.add(parts.lathe([(foot, 0.0), (foot, 0.012), (0.03, 0.04), (0.03, height - 0.06)]), metal)
    if height > 0.6:
        rest = [(0.04, 0.25), (0.15, 0.255), (0.17, 0.265), (0.15, 0.275)]
        design.add(parts.lathe([*rest, (0.04, 0.28)]), metal)
    seat = [
        (0.9 * radius, height - 0.07),
        (radius, height - 0.05),
        (radius, height - 0.02),
        (0.9 * radius, height),
    ]
    design.add(parts.lathe(seat), palette.pick(rng, palette.FABRICS))
    return design


def legged_stool(rng: np.random.Generator) -> Design:
    """Four splayed legs with rungs under a round or square wooden seat."""
    design = Design("stool", symmetry=4)
    height, width = rng.uniform(0.42, 0.7), rng.uniform(0.3, 0.38)
    wood = palette.pick(rng, palette.WOODS)
    if rng.random() < 0.5:
        seat = parts.lathe(
            [(0.46 * width, height - 0.035), (0.5 * width, height - 0.02), (0.5 * width, height)]
        )
    else:
        seat = parts.cushion((0, height - 0.02, 0), (width, 0.04, width), corner=0.04, edge=0.01)
    design.add(seat, palette.pick(rng, palette.WOODS))
    top, floor = 0.26 * width, rng.uniform(0.36, 0.5) * width
    leg = parts.tube([(floor, 0.0, floor), (top, height - 0.02, top)], 0.016)
    design.add(parts.spokes(leg, 4), wood)
    share = rng.uniform(0.3, 0.5)
    reach = floor + share * (top - floor)
    rung = parts.tube([(-reach, share * height, reach), (reach, share * height, reach)], 0.01)
    design.add(parts.spokes(rung, 4), wood)
    return design


def pouffe(rng: np.random.Generator) -> Design:
    """Upholstered cylinder on the floor."""
    height, radius = rng.uniform(0.36, 0.46), rng.uniform(0.2, 0.27)
    design = Design("stool", symmetry=0)
    profile = [(0.92 * radius, 0.0), (radius, 0.05), (radius, height - 0.06), (0.93 * radius, height - 0.01)]
    design.add(parts.lathe([*profile, (0.7 * radius, height)]), palette.pick(rng, palette.FABRICS))
    return design
