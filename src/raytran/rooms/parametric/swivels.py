# SPDX-License-Identifier: Apache-2.0
"""Office chairs: a seat that swivels on a five-star base with castors."""

from __future__ import annotations

import numpy as np

from raytran.rooms.parametric import palette, parts
from raytran.rooms.parametric.design import Color, Design


def office_chair(rng: np.random.Generator) -> Design:
    """Five-star base, gas column, cushions, mostly with arms, some with a head rest."""
    design = Design("office chair")
    width, depth, seat = rng.uniform(0.46, 0.54), rng.uniform(0.44, 0.52), rng.uniform(0.44, 0.54)
    frame, cover = palette.pick(rng, palette.METALS), palette.pick(rng, palette.FABRICS)
    _star_base(design, rng.uniform(0.27, 0.33), seat - 0.08, frame)
    design.add(parts.box((0, seat - 0.09, 0), (0.22, 0.04, 0.26)), frame)
    design.add(parts.cushion((0, seat - 0.035, 0), (width, 0.08, depth), corner=0.09, edge=0.035), cover)
    back = _back(rng, width, frame, cover)
    for part, color in back.parts:
        design.add(parts.moved(part, (0, seat, depth / 2)), color)
    if rng.random() < 0.75:
        _arms(design, width / 2 + 0.03, seat, seat + rng.uniform(0.17, 0.23), frame)
    return design


def _star_base(design: Design, radius: float, top: float, color: Color) -> None:
    """Five arms with castors and the gas column."""
    arm = parts.tube([(0, 0.10, 0), (0, 0.075, -radius)], [0.026, 0.016])
    wheel = parts.tube([(-0.025, 0.028, -radius), (0.025, 0.028, -radius)], 0.028, 12)
    fork = parts.tube([(0, 0.03, -radius), (0, 0.085, -radius)], 0.01)
    design.add(parts.spokes(arm, 5) + parts.spokes(fork, 5), color)
    design.add(parts.spokes(wheel, 5), palette.RUBBER)
    design.add(parts.lathe([(0.035, 0.06), (0.035, 0.25), (0.022, 0.26), (0.022, top)], 16), color)


def _back(rng: np.random.Generator, width: float, frame: Color, cover: Color) -> Design:
    """Leaning cushion on a spine, maybe with a head rest; about the middle of the seat's rear edge."""
    design = Design("back")
    rise, lean, low = rng.uniform(0.42, 0.72), rng.uniform(5, 14), rng.uniform(0.04, 0.12)
    cushion = (0, low + rise / 2, 0.02), (0.92 * width, rise, 0.07)
    design.add(parts.tilted(parts.cushion(*cushion, corner=0.03, edge=0.05), lean), cover)
    spine = parts.tube([(0, -0.09, -0.15), (0, -0.08, 0), (0, 0, 0.05), (0, low + 0.2, 0.05)], 0.022)
    design.add(parts.tilted(spine, 0.6 * lean), frame)
    if rise > 0.55 and rng.random() < 0.6:
        rest = (0, low + rise + 0.08, 0.01), (0.5 * width, 0.14, 0.06)
        design.add(parts.tilted(parts.cushion(*rest, corner=0.03, edge=0.04), lean), cover)
        stem = parts.box((0, low + rise, 0.03), (0.05, 0.14, 0.02))
        design.add(parts.tilted(stem, lean), frame)
    return design


def _arms(design: Design, x: float, seat: float, high: float, color: Color) -> None:
    """Padded arm rests on posts that come out from under the seat."""
    under = seat - 0.09
    post = [(0.1, under, 0.02), (x - 0.03, under, 0.02), (x, under + 0.04, 0.02), (x, high, 0.02)]
    design.add(parts.both_sides(parts.tube(post, 0.016)), color)
    pad = parts.cushion((x, high, 0), (0.075, 0.035, 0.26), corner=0.03, edge=0.012)
    design.add(parts.both_sides(pad), palette.RUBBER)
