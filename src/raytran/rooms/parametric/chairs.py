# SPDX-License-Identifier: Apache-2.0
"""Chairs: wooden and metal ones on four legs, cantilevers, armchairs, office chairs and stools."""

from __future__ import annotations

import numpy as np

from raytran.rooms.parametric import palette, parts
from raytran.rooms.parametric.parts import Color, Design


def four_legged_chair(rng: np.random.Generator) -> Design:
    """Dining chair: four legs, one of four backs, sometimes arms."""
    arms = rng.random() < 0.35
    design = Design("armed chair" if arms else "dining chair")
    width, depth, seat = rng.uniform(0.40, 0.50), rng.uniform(0.40, 0.48), rng.uniform(0.43, 0.48)
    rise, lean = rng.uniform(0.36, 0.52), rng.uniform(4, 12)
    frame = palette.pick(rng, palette.WOODS + palette.METALS)
    cover = palette.pick(rng, palette.FABRICS) if rng.random() < 0.6 else palette.shade(frame, 1.1)
    design.add(parts.cushion((0, seat - 0.025, 0), (width, 0.05, depth), corner=0.05, edge=0.018), cover)
    _legs(design, rng, width, depth, seat - 0.03, frame)
    back = _back(rng, width, rise, depth, frame, cover)
    for part, color in back.parts:
        placed = parts.moved(part, (0, seat - 0.03, depth / 2 - 0.03))
        design.add(parts.tilted(placed, lean, (0, seat, depth / 2)), color)
    if arms:
        _bar_arms(design, width, depth, seat, frame)
    return design


def cantilever_chair(rng: np.random.Generator) -> Design:
    """A bent steel tube on each side carries the seat and the back; there are no rear legs."""
    arms = rng.random() < 0.4
    design = Design("armed chair" if arms else "dining chair")
    width, depth, seat, top = rng.uniform(0.45, 0.54), rng.uniform(0.44, 0.52), 0.45, rng.uniform(0.8, 0.92)
    steel, cover = palette.pick(rng, palette.METALS), palette.pick(rng, palette.FABRICS)
    x, front, rear = width / 2, -depth / 2, depth / 2
    # (height, z) along the tube: on the floor, up in front, under the seat, up the back.
    bends = [(0.012, rear), (0.012, front + 0.06), (0.03, front + 0.015), (0.07, front), (seat - 0.06, front)]
    bends += [(seat - 0.02, front + 0.015), (seat, front + 0.06), (seat, rear - 0.06)]
    bends += [(seat + 0.02, rear - 0.015), (seat + 0.06, rear), (top, rear + 0.07)]
    design.add(parts.both_sides(parts.tube([(x, y, z) for y, z in bends], 0.012)), steel)
    design.add(parts.tube([(-x, 0.012, rear), (x, 0.012, rear)], 0.012), steel)
    pad = (0, seat + 0.015, 0), (width - 0.01, 0.045, depth - 0.03)
    design.add(parts.cushion(*pad, corner=0.04, edge=0.018), cover)
    height, pivot = top - seat - 0.14, (0, top, rear + 0.03)
    panel = (0, top - height / 2, rear + 0.03), (width - 0.01, height, 0.04)
    design.add(parts.tilted(parts.cushion(*panel, corner=0.015, edge=0.015), 9, pivot), cover)
    if arms:
        rest = [(x, seat, front + 0.07), (x, seat + 0.2, front + 0.1), (x, seat + 0.21, rear + 0.02)]
        design.add(parts.both_sides(parts.tube(rest, 0.014)), steel)
    return design


def armchair(rng: np.random.Generator) -> Design:
    """Upholstered chair for one with broad arms."""
    design = Design("armchair")
    width, depth, seat = rng.uniform(0.5, 0.6), rng.uniform(0.62, 0.75), rng.uniform(0.38, 0.44)
    arm, top = rng.uniform(0.1, 0.17), rng.uniform(0.78, 1.0)
    cover = palette.pick(rng, palette.FABRICS)
    foot, base, high = 0.1, seat - 0.14, seat + rng.uniform(0.14, 0.22)
    x, z = width / 2 + arm - 0.07, depth / 2 - 0.08
    leg = parts.tube([(x, 0, z), (x - 0.02, foot + 0.02, z - 0.02)], [0.014, 0.024])
    design.add(parts.corners(leg), palette.pick(rng, palette.WOODS))
    frame = (0, (foot + base) / 2, 0), (width + 2 * arm - 0.03, base - foot, depth - 0.02)
    design.add(parts.cushion(*frame, corner=0.05, edge=0.02), palette.shade(cover, 0.9))
    pillow = (0, seat - 0.07, -0.05), (width - 0.01, 0.15, depth - 0.14)
    design.add(parts.cushion(*pillow, corner=0.05, edge=0.045), palette.shade(cover, 1.06))
    side = (width / 2 + arm / 2, (foot + high) / 2, -0.01), (arm, high - foot, depth - 0.03)
    design.add(parts.both_sides(parts.cushion(*side, corner=0.05, edge=0.05)), cover)
    back = (0, (foot + top) / 2, depth / 2 - 0.06), (width + 0.04, top - foot, 0.15)
    lean, pivot = rng.uniform(3, 9), (0, foot, depth / 2)
    design.add(parts.tilted(parts.cushion(*back, corner=0.05, edge=0.06), lean, pivot), cover)
    return design


def _legs(
    design: Design, rng: np.random.Generator, width: float, depth: float, top: float, color: Color
) -> None:
    """Square, round or splayed legs, sometimes with rungs."""
    style = rng.integers(3)
    x, z = width / 2 - 0.03, depth / 2 - 0.03
    if style == 0:
        leg = parts.box((x, top / 2, z), (0.04, top, 0.04))
    else:
        splay = 0.0 if style == 1 else rng.uniform(0.02, 0.06)
        leg = parts.tube([(x + splay, 0, z + splay), (x - splay, top, z - splay)], [0.012, 0.019])
    design.add(parts.corners(leg), color)
    if rng.random() < 0.5:
        y = rng.uniform(0.3, 0.5) * top
        design.add(parts.both_sides(parts.tube([(x, y, -z), (x, y, z)], 0.01)), color)
        design.add(parts.tube([(-x, y, 0), (x, y, 0)], 0.01), color)


def _back(
    rng: np.random.Generator, width: float, rise: float, depth: float, frame: Color, cover: Color
) -> Design:
    """A back standing upright at the origin: padded panel, vertical slats, cross rails or a curved band."""
    design = Design("back")
    style = rng.integers(4)
    x = width / 2 - 0.025
    if style == 0:
        panel = parts.cushion((0, rise / 2, 0), (width - 0.01, rise, 0.05), corner=0.02, edge=0.025)
        design.add(panel, cover)
        return design
    design.add(parts.both_sides(parts.tube([(x, 0, 0), (x, rise, 0)], [0.02, 0.016])), frame)
    if style == 1:
        count = int(rng.integers(3, 7))
        slats = [
            parts.box((s, rise / 2, 0), (0.025, rise, 0.012)) for s in np.linspace(-0.75, 0.75, count) * x
        ]
        design.add(
            [*slats, parts.cushion((0, rise, 0), (width, 0.06, 0.03), corner=0.012, edge=0.012)], frame
        )
    elif style == 2:
        count = int(rng.integers(2, 5))
        heights = np.linspace(0.35 if count < 4 else 0.25, 0.95, count) * rise
        rails = [parts.cushion((0, y, 0), (2 * x, 0.055, 0.022), corner=0.01, edge=0.01) for y in heights]
        design.add(rails, frame)
    else:
        design.add(_band(x, 0.55 * rise, 0.725 * rise), cover)
    return design


def _band(reach: float, height: float, middle: float) -> parts.Part:
    """Board across the back from -``reach`` to ``reach``, bent backwards in the middle."""
    outline = parts.rectangle(0.024, height, 0.008, 2)
    share = np.linspace(-1.0, 1.0, 9)
    rings = np.empty((len(share), len(outline), 3))
    rings[..., 0] = reach * share[:, None]
    rings[..., 1] = middle + outline[:, 1]
    rings[..., 2] = 0.05 * (1 - share[:, None] ** 2) - 0.01 + outline[:, 0]
    return parts.loft(rings)


def _bar_arms(design: Design, width: float, depth: float, seat: float, color: Color) -> None:
    """Arm rests on front posts, reaching back to the back rest."""
    x, high, front = width / 2 + 0.01, seat + 0.21, -depth / 2 + 0.07
    post = parts.tube([(x - 0.02, seat - 0.04, front), (x, high, front)], 0.014)
    rest = parts.cushion(
        (x, high, front / 2 + depth / 4 + 0.01),
        (0.05, 0.025, depth / 2 - front + 0.02),
        corner=0.02,
        edge=0.008,
    )
    design.add([*parts.both_sides(post), *parts.both_sides(rest)], color)


def office_chair(rng: np.random.Generator) -> Design:
    """Five-star base, gas column, cushions, mostly with arms, some with a head rest."""
    design = Design("office chair")
    width, depth, seat = rng.uniform(0.46, 0.54), rng.uniform(0.44, 0.52), rng.uniform(0.44, 0.54)
    frame, cover = palette.pick(rng, palette.METALS), palette.pick(rng, palette.FABRICS)
    _star_base(design, rng.uniform(0.27, 0.33), seat - 0.08, frame)
    design.add(parts.box((0, seat - 0.09, 0), (0.22, 0.04, 0.26)), frame)
    design.add(parts.cushion((0, seat - 0.035, 0), (width, 0.08, depth), corner=0.09, edge=0.035), cover)
    back = _swivel_back(rng, width, frame, cover)
    for part, color in back.parts:
        design.add(parts.moved(part, (0, seat, depth / 2)), color)
    if rng.random() < 0.75:
        _loop_arms(design, width / 2 + 0.03, seat, seat + rng.uniform(0.17, 0.23), frame)
    return design


def _star_base(design: Design, radius: float, top: float, color: Color) -> None:
    """Five arms with castors and the gas column."""
    arm = parts.tube([(0, 0.10, 0), (0, 0.075, -radius)], [0.026, 0.016])
    wheel = parts.tube([(-0.025, 0.028, -radius), (0.025, 0.028, -radius)], 0.028, 12)
    fork = parts.tube([(0, 0.03, -radius), (0, 0.085, -radius)], 0.01)
    design.add(parts.spokes(arm, 5) + parts.spokes(fork, 5), color)
    design.add(parts.spokes(wheel, 5), palette.RUBBER)
    design.add(parts.lathe([(0.035, 0.06), (0.035, 0.25), (0.022, 0.26), (0.022, top)], 16), color)


def _swivel_back(rng: np.random.Generator, width: float, frame: Color, cover: Color) -> Design:
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


def _loop_arms(design: Design, x: float, seat: float, high: float, color: Color) -> None:
    """Padded arm rests on posts that come out from under the seat."""
    under = seat - 0.09
    post = [(0.1, under, 0.02), (x - 0.03, under, 0.02), (x, under + 0.04, 0.02), (x, high, 0.02)]
    design.add(parts.both_sides(parts.tube(post, 0.016)), color)
    pad = parts.cushion((x, high, 0), (0.075, 0.035, 0.26), corner=0.03, edge=0.012)
    design.add(parts.both_sides(pad), palette.RUBBER)


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
