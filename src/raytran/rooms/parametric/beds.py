# SPDX-License-Identifier: Apache-2.0
"""Beds with their head at the back (+Z), and loose pillows to lie on them."""

from __future__ import annotations

import numpy as np

from raytran.rooms.parametric import palette, parts
from raytran.rooms.parametric.design import Color, Design


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
