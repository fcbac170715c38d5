# SPDX-License-Identifier: Apache-2.0
"""Sofas: straight ones for two to four, with or without arms, and L-shaped ones."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from raytran.rooms.parametric import palette, parts
from raytran.rooms.parametric.parts import Color, Design

FOOT = 0.08
"""Height of a sofa's feet, metres."""


def straight_sofa(rng: np.random.Generator) -> Design:
    """Sofa of two to four seats, mostly with arms."""
    design = Design("sofa", support="wall")
    seats, share = int(rng.integers(2, 5)), rng.uniform(0.55, 0.7)
    arm = rng.uniform(0.12, 0.24) if rng.random() < 0.85 else 0.0
    depth, seat, top = rng.uniform(0.8, 0.98), rng.uniform(0.4, 0.46), rng.uniform(0.74, 0.92)
    width = min(seats * share + 2 * arm, 2.7)
    cover = palette.pick(rng, palette.FABRICS)
    _frame(design, rng, width, depth, seat, cover)
    edges = np.linspace(-width / 2 + arm, width / 2 - arm, seats + 1)
    _cushions(design, edges, depth, seat, top, cover)
    if arm:
        _arms(design, [-1.0, 1.0], width, arm, depth, seat + rng.uniform(0.12, 0.22), cover)
    _throw_pillows(design, rng, width / 2 - arm - 0.25, depth, seat)
    return design


def corner_sofa(rng: np.random.Generator) -> Design:
    """L-shaped sofa: a long seat at the back and a chaise forward on one side."""
    design = Design("corner sofa", support="wall")
    side = float(rng.choice([-1.0, 1.0]))
    depth, seat, top = rng.uniform(0.85, 0.98), rng.uniform(0.4, 0.46), rng.uniform(0.74, 0.88)
    width, reach, chaise = rng.uniform(2.1, 2.8), rng.uniform(0.55, 0.9), rng.uniform(0.75, 0.95)
    arm = rng.uniform(0.12, 0.2)
    cover = palette.pick(rng, palette.FABRICS)
    _frame(design, rng, width, depth, seat, cover)
    wing, front = side * (width / 2 - chaise / 2), -depth / 2 - reach / 2
    base = (wing, (FOOT + seat - 0.13) / 2, front), (chaise, seat - 0.13 - FOOT, reach + 0.1)
    design.add(parts.cushion(*base, corner=0.04, edge=0.02), palette.shade(cover, 0.85))
    feet = [
        parts.tube(
            [(wing + x, 0, -depth / 2 - reach + 0.08), (wing + x, FOOT + 0.03, -depth / 2 - reach + 0.08)],
            0.022,
        )
        for x in (0.08 - chaise / 2, chaise / 2 - 0.08)
    ]
    design.add(feet, palette.RUBBER)
    inner = [-width / 2 + arm, width / 2 - chaise] if side > 0 else [-width / 2 + chaise, width / 2 - arm]
    seats = max(1, round((inner[1] - inner[0]) / 0.7))
    _cushions(design, np.linspace(inner[0], inner[1], seats + 1), depth, seat, top, cover)
    _cushions(
        design, np.array([wing - chaise / 2, wing + chaise / 2]), depth, seat, top, cover, forward=reach
    )
    high = seat + rng.uniform(0.12, 0.2)
    _arms(design, [-side], width, arm, depth, high, cover)
    _throw_pillows(design, rng, width / 2 - arm - 0.3, depth, seat)
    return design


def _frame(
    design: Design, rng: np.random.Generator, width: float, depth: float, seat: float, color: Color
) -> None:
    """Feet and the upholstered base below the cushions."""
    foot = parts.tube(
        [(width / 2 - 0.1, 0, depth / 2 - 0.08), (width / 2 - 0.1, FOOT + 0.03, depth / 2 - 0.08)], 0.022
    )
    design.add(parts.corners(foot), palette.pick(rng, palette.WOODS))
    base = (0, (FOOT + seat - 0.13) / 2, 0), (width - 0.02, seat - 0.13 - FOOT, depth - 0.02)
    design.add(parts.cushion(*base, corner=0.04, edge=0.02), palette.shade(color, 0.85))


def _cushions(
    design: Design,
    edges: np.ndarray,
    depth: float,
    seat: float,
    top: float,
    color: Color,
    forward: float = 0.0,
) -> None:
    """Seat and back cushions between the given x ``edges``; seats reach ``forward`` beyond the base."""
    for left, right in pairwise(edges):
        x, width = (left + right) / 2, right - left - 0.008
        length = depth - 0.2 + forward
        seat_box = (x, seat - 0.07, depth / 2 - 0.2 - length / 2), (width, 0.15, length)
        design.add(parts.cushion(*seat_box, corner=0.05, edge=0.04), palette.shade(color, 1.05))
        back = parts.cushion(
            (x, (seat + top) / 2 - 0.02, depth / 2 - 0.17), (width, top - seat, 0.17), corner=0.05, edge=0.06
        )
        design.add(parts.tilted(back, 6, (x, seat, depth / 2 - 0.17)), color)
    middle, span = (edges[0] + edges[-1]) / 2, edges[-1] - edges[0]
    rest = (middle, (FOOT + top - 0.08) / 2, depth / 2 - 0.06), (span, top - 0.08 - FOOT, 0.12)
    design.add(parts.cushion(*rest, corner=0.03, edge=0.04), palette.shade(color, 0.92))


def _arms(
    design: Design, sides: list[float], width: float, arm: float, depth: float, high: float, color: Color
) -> None:
    """Upholstered arm rests on the given sides."""
    rest = (width / 2 - arm / 2, (FOOT + high) / 2, 0), (arm, high - FOOT, depth)
    part = parts.cushion(*rest, corner=0.05, edge=0.05)
    design.add([part if side > 0 else parts.mirrored(part) for side in sides], color)


def _throw_pillows(design: Design, rng: np.random.Generator, reach: float, depth: float, seat: float) -> None:
    """Up to two loose pillows leaning on the back."""
    for side in rng.permutation([-1.0, 1.0])[: rng.integers(0, 3)]:
        pillow = parts.cushion((0, 0, 0), (0.4, 0.4, 0.14), corner=0.05, edge=0.07)
        placed = parts.moved(parts.tilted(pillow, 22), (side * reach, seat + 0.18, depth / 2 - 0.32))
        design.add(placed, palette.pick(rng, palette.FABRICS + palette.LINENS))
