# SPDX-License-Identifier: Apache-2.0
"""Bathtubs, hollow: built-in ones with a straight apron, and free-standing oval ones."""

from __future__ import annotations

import numpy as np

from raytran.rooms.parametric import palette, parts
from raytran.rooms.parametric.parts import Design

WHITES = (palette.WHITE, (0.90, 0.88, 0.83), (0.82, 0.88, 0.90))
"""Enamel colours."""


def built_in_bathtub(rng: np.random.Generator) -> Design:
    """Rectangular outside, rounded basin inside, tap over one end."""
    design = Design("bathtub", support="wall")
    width, depth, height = rng.uniform(1.45, 1.75), rng.uniform(0.68, 0.82), rng.uniform(0.48, 0.58)
    enamel = palette.pick(rng, WHITES)
    end = float(rng.choice([-1.0, 1.0]))
    rim, floor = rng.uniform(0.05, 0.08), 0.1
    outside = parts.rectangle(width, depth, 0.02, 6)
    inner = [parts.rectangle(width - 2 * rim, depth - 2 * rim, 0.18, 6)]
    for shrink, slide in ((0.06, 0.02), (0.16, 0.05), (0.3, 0.06)):
        inner.append(
            parts.rectangle(width - 2 * rim - shrink, depth - 2 * rim - 0.5 * shrink, 0.16, 6)
            + np.array([end * slide, 0])
        )
    heights = [0.0, height, height, 0.7 * height, 0.35 * height, floor]
    design.add(parts.stack([outside, outside, *inner], heights), enamel)
    _tap(design, rng, end * (width / 2 - 0.5 * rim), end, height - 0.01)
    return design


def oval_bathtub(rng: np.random.Generator) -> Design:
    """Free-standing oval shell, alike at both ends or with one raised head end."""
    width, depth, height = rng.uniform(1.45, 1.8), rng.uniform(0.72, 0.85), rng.uniform(0.55, 0.64)
    raised = bool(rng.random() < 0.5)
    design = Design("bathtub", symmetry=1 if raised else 2)
    wall, floor = rng.uniform(0.03, 0.05), rng.uniform(0.1, 0.14)
    shares = [(0.66, 0.0), (0.82, 0.3), (0.93, 0.65), (1.0, 1.0)]
    outer = [parts.ellipse(share * width, share * depth, 48) for share, _ in shares]
    inner = [
        parts.ellipse(share * width - 2 * wall, share * depth - 2 * wall, 48) for share, _ in shares[::-1]
    ]
    heights = [rise * height for _, rise in shares]
    inside = [floor + (height - floor) * rise for _, rise in shares[::-1]]
    shell = parts.stack(outer + inner, heights + inside)
    if raised:
        vertices = shell.vertices.copy()
        end = float(rng.choice([-1.0, 1.0]))
        lift = np.clip(end * vertices[:, 0] / (width / 2), 0.0, 1.0) ** 2
        vertices[:, 1] += 0.16 * lift * vertices[:, 1] / height
        shell = parts.Part(vertices, shell.faces)
    color = palette.pick(rng, WHITES + palette.PAINTS[2:4])
    design.add(shell, color)
    design.add(parts.prism(parts.ellipse(0.6 * width, 0.6 * depth, 48), 0.0, 0.03), palette.shade(color, 0.7))
    return design


def _tap(design: Design, rng: np.random.Generator, x: float, end: float, top: float) -> None:
    """Spout over the end of the tub with two handles."""
    metal = palette.pick(rng, palette.METALS)
    path = [(x, top, 0), (x, top + 0.12, 0), (x - end * 0.03, top + 0.16, 0), (x - end * 0.14, top + 0.15, 0)]
    design.add(parts.tube(path, 0.014), metal)
    knob = parts.lathe([(0.012, top), (0.012, top + 0.04), (0.026, top + 0.05), (0.022, top + 0.075)], 12)
    design.add([parts.moved(knob, (x, 0, z)) for z in (-0.1, 0.1)], metal)
