# SPDX-License-Identifier: Apache-2.0
"""Colours of furniture: a named list per material, each draw a little different."""

from __future__ import annotations

import numpy as np

from raytran.rooms.parametric.parts import Color

WOODS: tuple[Color, ...] = (
    (0.80, 0.64, 0.44),
    (0.63, 0.43, 0.26),
    (0.45, 0.28, 0.17),
    (0.30, 0.19, 0.13),
    (0.87, 0.77, 0.60),
    (0.55, 0.30, 0.18),
)
FABRICS: tuple[Color, ...] = (
    (0.42, 0.45, 0.50),
    (0.20, 0.28, 0.42),
    (0.62, 0.56, 0.47),
    (0.45, 0.16, 0.16),
    (0.25, 0.38, 0.30),
    (0.78, 0.73, 0.65),
    (0.72, 0.50, 0.25),
    (0.18, 0.18, 0.20),
    (0.30, 0.45, 0.55),
)
METALS: tuple[Color, ...] = ((0.72, 0.73, 0.75), (0.40, 0.41, 0.43), (0.14, 0.14, 0.15), (0.78, 0.68, 0.45))
PLASTICS: tuple[Color, ...] = (
    (0.12, 0.12, 0.13),
    (0.85, 0.85, 0.83),
    (0.30, 0.32, 0.35),
    (0.70, 0.15, 0.13),
    (0.15, 0.35, 0.55),
    (0.20, 0.45, 0.28),
)
PAINTS: tuple[Color, ...] = (
    (0.93, 0.92, 0.89),
    (0.86, 0.83, 0.76),
    (0.60, 0.66, 0.68),
    (0.35, 0.40, 0.44),
    (0.55, 0.62, 0.53),
)
LINENS: tuple[Color, ...] = (
    (0.93, 0.92, 0.90),
    (0.75, 0.80, 0.87),
    (0.85, 0.75, 0.70),
    (0.55, 0.60, 0.66),
    (0.70, 0.75, 0.62),
)
WHITE: Color = (0.94, 0.94, 0.93)
SCREEN: Color = (0.03, 0.03, 0.04)
RUBBER: Color = (0.08, 0.08, 0.08)


def pick(rng: np.random.Generator, colors: tuple[Color, ...]) -> Color:
    """Draw one of ``colors`` and vary it slightly."""
    return shade(colors[int(rng.integers(len(colors)))], float(rng.uniform(0.85, 1.1)))


def shade(color: Color, factor: float) -> Color:
    """Lighten (above 1) or darken (below 1) a colour."""
    red, green, blue = (min(1.0, channel * factor) for channel in color)
    return red, green, blue
