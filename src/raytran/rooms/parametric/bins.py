# SPDX-License-Identifier: Apache-2.0
"""Waste bins: open round, square and oblong ones, with swing or dome lids, with a pedal, on wheels."""

from __future__ import annotations

import numpy as np

from raytran.rooms.parametric import palette, parts
from raytran.rooms.parametric.parts import Design

COLORS = palette.PLASTICS + palette.METALS


def round_bin(rng: np.random.Generator) -> Design:
    """Open, tapered round basket."""
    design = Design("round bin", symmetry=0)
    top, height = rng.uniform(0.12, 0.2), rng.uniform(0.26, 0.45)
    foot, wall = rng.uniform(0.68, 1.0) * top, 0.01
    rim = [(top, height - 0.02), (top + 0.01, height - 0.02), (top + 0.01, height), (top - wall, height)]
    inside = [(top - wall, height - 0.02), (foot - wall, 0.015)]
    design.add(parts.lathe([(foot, 0.0), *rim, *inside]), palette.pick(rng, COLORS))
    return design


def dome_bin(rng: np.random.Generator) -> Design:
    """Closed steel cylinder with a dome on top."""
    design = Design("dome bin", symmetry=0)
    radius, height = rng.uniform(0.14, 0.2), rng.uniform(0.42, 0.7)
    color = palette.pick(rng, COLORS)
    body = height - 0.7 * radius
    design.add(parts.lathe([(radius, 0.0), (radius, body)]), color)
    angle = np.linspace(0, 0.45 * np.pi, 6)
    dome = [(float(0.99 * radius * np.cos(a)), float(body + 0.7 * radius * np.sin(a))) for a in angle]
    design.add(
        parts.lathe([(1.03 * radius, body - 0.03), (1.03 * radius, body - 0.005), *dome]),
        palette.shade(color, 0.75),
    )
    return design


def angular_bin(rng: np.random.Generator) -> Design:
    """Open, tapered bin, square or oblong in plan."""
    square = bool(rng.random() < 0.45)
    design = Design("square bin" if square else "oblong bin", symmetry=4 if square else 2)
    width, height = rng.uniform(0.24, 0.42), rng.uniform(0.28, 0.5)
    depth = width if square else width / rng.uniform(1.35, 2.0)
    taper, corner = rng.uniform(0.75, 1.0), rng.uniform(0.02, 0.06)

    def outline(share: float, wall: float) -> parts.Vertices:
        return parts.rectangle(share * width - 2 * wall, share * depth - 2 * wall, corner, 4)

    outlines = [outline(taper, 0), outline(1, 0), outline(1, -0.008), outline(1, -0.008), outline(1, 0.01)]
    heights = [0.0, height - 0.025, height - 0.025, height, height, 0.015]
    design.add(parts.stack([*outlines, outline(taper, 0.01)], heights), palette.pick(rng, COLORS))
    return design


def pedal_bin(rng: np.random.Generator) -> Design:
    """Round or square closed bin with a lid hinged at the back and a pedal in front."""
    design = Design("pedal bin")
    width, height = rng.uniform(0.25, 0.38), rng.uniform(0.38, 0.68)
    color = palette.pick(rng, COLORS)
    dark = palette.shade(color, 0.55)
    outline = parts.circle(width / 2) if rng.random() < 0.6 else parts.rectangle(width, width, 0.05)
    design.add(parts.prism(1.02 * outline, 0.0, 0.05), dark)
    design.add(parts.prism(outline, 0.03, height), color)
    lids = [1.03 * outline, 1.03 * outline, 0.75 * outline]
    design.add(parts.stack(lids, [height - 0.01, height + 0.02, height + 0.06]), dark)
    design.add(
        parts.cushion((0, 0.025, -width / 2 - 0.03), (0.11, 0.02, 0.09), corner=0.02, edge=0.006), dark
    )
    design.add(parts.box((0, height, width / 2 + 0.005), (0.12, 0.05, 0.04)), dark)
    return design


def wheeled_bin(rng: np.random.Generator) -> Design:
    """Tall bin with a sloping lid, a grip bar and two wheels at the back."""
    design = Design("wheeled bin")
    width, depth, height = rng.uniform(0.44, 0.5), rng.uniform(0.5, 0.56), rng.uniform(0.8, 0.95)
    color = palette.pick(rng, palette.PLASTICS)
    dark = palette.shade(color, 0.7)
    low, high = parts.rectangle(0.78 * width, 0.74 * depth, 0.04), parts.rectangle(width, 0.92 * depth, 0.04)
    design.add(parts.stack([low, high], [0.03, height]), color)
    lid = parts.cushion((0, height + 0.02, 0), (1.05 * width, 0.06, depth), corner=0.05, edge=0.025)
    design.add(parts.tilted(lid, -4, (0, height, 0)), dark)
    rear = 0.37 * depth
    wheel = parts.tube([(0.36 * width, 0.1, rear + 0.02), (0.46 * width, 0.1, rear + 0.02)], 0.1, 20)
    design.add(parts.both_sides(wheel), palette.RUBBER)
    design.add(parts.tube([(-0.4 * width, 0.1, rear + 0.02), (0.4 * width, 0.1, rear + 0.02)], 0.015), dark)
    grip = [(-0.4 * width, height, 0.46 * depth), (-0.36 * width, height, 0.55 * depth)]
    grip += [(-x, y, z) for x, y, z in grip[::-1]]
    design.add(parts.tube(grip, 0.016), dark)
    return design
