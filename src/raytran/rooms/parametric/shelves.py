# SPDX-License-Identifier: Apache-2.0
"""Bookshelves: upright and low ones with or without a back, cube grids, steps, ladders; some hold books."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from raytran.rooms.parametric import palette, parts
from raytran.rooms.parametric.parts import Color, Design

BOARD = 0.022
"""Thickness of the boards, metres."""


def bookcase(rng: np.random.Generator) -> Design:
    """Side panels, boards and a back, open to the front, often with books."""
    design = Design("bookshelf", support="wall")
    width, depth = rng.uniform(0.6, 1.2), rng.uniform(0.26, 0.38)
    height = rng.uniform(0.8, 1.2) if rng.random() < 0.3 else rng.uniform(1.6, 2.1)
    wood = palette.pick(rng, palette.WOODS + palette.PAINTS)
    _upright_panels(design, [-width / 2 + BOARD / 2, width / 2 - BOARD / 2], height, depth, wood)
    levels = np.linspace(0.07, height - BOARD / 2, round(height / rng.uniform(0.3, 0.4)) + 1)
    _boards(design, levels, width - BOARD, depth - 0.01, wood)
    back = parts.box((0, height / 2 + 0.03, depth / 2 - 0.006), (width - 0.01, height - 0.07, 0.01))
    design.add(back, palette.shade(wood, 0.8))
    if rng.random() < 0.6:
        for low, high in pairwise(levels):
            _books(design, rng, width - 2 * BOARD, depth, low + BOARD / 2, high - low - BOARD)
    return design


def open_rack(rng: np.random.Generator) -> Design:
    """Shelves on four posts without a back: the same from front and rear."""
    design = Design("open shelf", support="wall", symmetry=2)
    width, depth, height = rng.uniform(0.6, 1.1), rng.uniform(0.3, 0.42), rng.uniform(1.2, 2.0)
    metal = palette.pick(rng, palette.METALS)
    board = palette.pick(rng, palette.WOODS) if rng.random() < 0.6 else metal
    post = parts.box((width / 2 - 0.015, height / 2, depth / 2 - 0.015), (0.03, height, 0.03))
    design.add(parts.corners(post), metal)
    levels = np.linspace(0.12, height - 0.05, int(rng.integers(4, 6)))
    _boards(design, levels, width - 0.01, depth - 0.01, board)
    return design


def cube_shelf(rng: np.random.Generator) -> Design:
    """Grid of square compartments, open on both sides, some of them filled with boxes."""
    columns, rows = int(rng.integers(2, 5)), int(rng.integers(2, 5))
    cell, depth = rng.uniform(0.33, 0.38), rng.uniform(0.34, 0.4)
    design = Design("cube shelf", support="wall", symmetry=2)
    width, height = columns * cell + BOARD, rows * cell + BOARD
    color = palette.pick(rng, palette.PAINTS + palette.WOODS)
    sides = np.linspace(-width / 2 + BOARD / 2, width / 2 - BOARD / 2, columns + 1)
    _upright_panels(design, sides, height, depth, color)
    levels = np.linspace(BOARD / 2, height - BOARD / 2, rows + 1)
    _boards(design, levels, width - BOARD, depth - 0.004, color)
    if rng.random() < 0.6:
        design.symmetry = 1
        fabric = palette.pick(rng, palette.FABRICS)
        bin_size = (cell - BOARD - 0.02, 0.85 * cell - BOARD, 0.75 * depth)
        back = parts.box((0, height / 2, depth / 2 - 0.01), (width - 0.01, height - 0.01, 0.012))
        design.add(back, palette.shade(color, 0.85))
        for column in range(columns):
            for row in range(rows):
                if rng.random() < 0.5:
                    y = levels[row] + BOARD / 2 + bin_size[1] / 2
                    design.add(parts.box((sides[column] + cell / 2, y, -0.1 * depth), bin_size), fabric)
    return design


def step_shelf(rng: np.random.Generator) -> Design:
    """Columns of compartments that descend to one side like stairs."""
    design = Design("step shelf", support="wall")
    columns, cell, depth = int(rng.integers(3, 5)), rng.uniform(0.33, 0.4), rng.uniform(0.28, 0.36)
    side = float(rng.choice([-1.0, 1.0]))
    wood = palette.pick(rng, palette.WOODS + palette.PAINTS)
    left, shelf = -columns * cell / 2, Design("steps")
    for column in range(columns + 1):
        # A panel between two columns is as tall as the taller one.
        rows = columns - max(0, column - 1)
        _upright_panels(shelf, [left + column * cell], rows * cell + BOARD, depth, wood)
    for column in range(columns):
        middle = left + (column + 0.5) * cell
        for level in range(columns - column + 1):
            board = (middle, level * cell + BOARD / 2, 0), (cell + BOARD - 0.002, BOARD, depth - 0.004)
            shelf.add(parts.box(*board), wood)
    for part, color in shelf.parts:
        design.add(part if side > 0 else parts.mirrored(part), color)
    return design


def ladder_shelf(rng: np.random.Generator) -> Design:
    """Two leaning rails against the wall with boards that get deeper downwards."""
    design = Design("ladder shelf", support="wall")
    width, depth, height = rng.uniform(0.5, 0.75), rng.uniform(0.4, 0.5), rng.uniform(1.5, 1.9)
    wood = palette.pick(rng, palette.WOODS)
    rail = parts.tube([(width / 2, 0, -depth / 2), (width / 2, height, depth / 2 - 0.02)], 0.017)
    design.add(parts.both_sides(rail), wood)
    design.add(
        parts.both_sides(
            parts.tube([(width / 2, 0, depth / 2 - 0.02), (width / 2, height, depth / 2 - 0.02)], 0.014)
        ),
        wood,
    )
    for share in np.linspace(0.12, 0.9, int(rng.integers(4, 6))):
        front = -depth / 2 + share * depth
        board = (0, share * height, (front + depth / 2) / 2), (width, BOARD, depth / 2 - front)
        design.add(parts.box(*board), palette.shade(wood, 1.1))
        lip = (0, share * height + 0.02, front + 0.005), (width, 0.05, 0.014)
        design.add(parts.box(*lip), wood)
    return design


def _upright_panels(
    design: Design, positions: list[float] | np.ndarray, height: float, depth: float, color: Color
) -> None:
    """Vertical boards at the given x positions."""
    design.add([parts.box((x, height / 2, 0), (BOARD, height, depth)) for x in positions], color)


def _boards(design: Design, levels: np.ndarray, width: float, depth: float, color: Color) -> None:
    """Horizontal boards centred at the given heights."""
    design.add([parts.box((0, y, 0), (width, BOARD, depth)) for y in levels], color)


def _books(
    design: Design, rng: np.random.Generator, width: float, depth: float, floor: float, room: float
) -> None:
    """A run of books on a shelf of clear ``width``, standing at ``floor`` with ``room`` above it."""
    spines = [palette.pick(rng, palette.FABRICS + palette.PLASTICS) for _ in range(3)]
    left = -width / 2 + rng.uniform(0.0, 0.4) * width
    right = left + rng.uniform(0.25, 0.9) * (width / 2 - left)
    while left < right:
        thickness = rng.uniform(0.03, 0.07)
        tall, deep = rng.uniform(0.6, 0.92) * room, rng.uniform(0.55, 0.8) * depth
        book = (
            (left + thickness / 2, floor + tall / 2, depth / 2 - 0.012 - deep / 2),
            (thickness - 0.003, tall, deep),
        )
        design.add(parts.box(*book), spines[int(rng.integers(3))])
        left += thickness
