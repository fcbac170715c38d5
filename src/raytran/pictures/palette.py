# SPDX-License-Identifier: Apache-2.0
"""Colours and lettering shared by all pictures."""

from __future__ import annotations

from functools import cache

from PIL import ImageFont

INK = "#1d2530"
"""Axes, text and truth outlines on white paper."""

FAINT = "#8a94a3"
"""Ticks, grids and the camera path."""


def ink_on(color: tuple[int, int, int]) -> tuple[int, int, int]:
    """Return black or white, whichever is easier to read on ``color``.

    Relative luminance after WCAG 2.1, without its gamma, which does not change the choice for our palette.
    """
    red, green, blue = color
    return (0, 0, 0) if 0.2126 * red + 0.7152 * green + 0.0722 * blue > 140 else (255, 255, 255)


@cache
def font(size: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    """Return Pillow's built-in typeface, ``size`` pixels high."""
    return ImageFont.load_default(size)
