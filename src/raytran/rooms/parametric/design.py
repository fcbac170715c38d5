# SPDX-License-Identifier: Apache-2.0
"""A piece of furniture while it is being put together: coloured parts in metres and what they amount to."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import NamedTuple

from raytran.rooms.parametric.parts import Part

Color = tuple[float, float, float]


class ColoredPart(NamedTuple):
    """A part and its RGB colour in [0, 1]."""

    part: Part
    color: Color


@dataclass
class Design:
    """Coloured parts with the facts a layout needs.

    Attributes:
        kind: what a person would call it, e.g. ``office chair``.
        support: where it stands (see ``CadModel.support``).
        symmetry: equal turns about +Y through the origin: 1, 2, 4, or 0 for a body of revolution.
        parts: everything added so far.
    """

    kind: str
    support: str = "floor"
    symmetry: int = 1
    parts: list[ColoredPart] = field(default_factory=list)

    def add(self, parts: Part | Iterable[Part], color: Color) -> None:
        """Add one part or several of the same colour."""
        several = [parts] if isinstance(parts, Part) else parts
        self.parts.extend(ColoredPart(part, color) for part in several)
