# SPDX-License-Identifier: Apache-2.0
"""Things that lie and stand about in rooms and that nobody annotates: bags, boxes, plants, people."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from raytran.rooms.parametric import palette, parts
from raytran.rooms.parametric.parts import Color, Design, Part

SKINS: tuple[Color, ...] = ((0.87, 0.68, 0.56), (0.72, 0.52, 0.4), (0.45, 0.3, 0.22))
CLOTHES = palette.FABRICS + palette.PLASTICS + palette.PAINTS
LEAF: Color = (0.16, 0.34, 0.1)
CARDBOARD: Color = (0.66, 0.5, 0.33)

Thing = Callable[[np.random.Generator], Design]


def _any(rng: np.random.Generator) -> Color:
    """Draw any colour, most often of something that one buys."""
    if rng.random() < 0.5:
        return palette.pick(rng, CLOTHES)
    red, green, blue = rng.uniform(0.02, 0.95, size=3).tolist()
    return red, green, blue


def _lump(rng: np.random.Generator, size: tuple[float, float, float], roughness: float = 0.2) -> Part:
    """Return something soft that stands on the floor: a flattened ball with dents."""
    width, height, depth = size
    share = np.linspace(0.0, 1.0, 8)
    rings = []
    dents = rng.uniform(1 - roughness, 1 + roughness, size=(8, 14))
    for i, level in enumerate(share):
        radius = 0.5 * (1 - abs(2 * level - 0.9) ** 2.5 * 0.65)
        ring = parts.circle(1.0, 14) * radius * (dents[i] * 0.5 + dents[max(i - 1, 0)] * 0.5)[:, None]
        rings.append(ring * np.array([width, depth]))
    return parts.stack(rings, [float(level * height) for level in share])


def _leaves(
    rng: np.random.Generator, count: int, low: float, high: float, radius: float, length: float
) -> Part:
    """Return leaves about an upright stem: four triangles each, seen from both sides."""
    angle, height = rng.uniform(0, 2 * np.pi, count), rng.uniform(low, high, count)
    reach = radius * np.sqrt(rng.random(count)) * np.sin(np.pi * (0.15 + 0.8 * (height - low) / (high - low)))
    start = np.stack([reach * np.cos(angle), height, reach * np.sin(angle)], axis=1)
    turn = angle + rng.normal(0, 0.6, count)
    along = np.stack([np.cos(turn), rng.uniform(-0.7, 0.7, count), np.sin(turn)], axis=1)
    side = np.stack([-np.sin(turn), rng.uniform(-0.3, 0.3, count), np.cos(turn)], axis=1)
    long = (length * rng.uniform(0.6, 1.3, count))[:, None]
    wide = long * rng.uniform(0.15, 0.4)
    middle = start + along * long * 0.5 + [0, 0.03, 0]
    points = np.stack([start, middle + side * wide, start + along * long, middle - side * wide], axis=1)
    first = 4 * np.arange(count)[:, None]
    faces = np.concatenate([first + np.array([0, 1, 2]), first + np.array([0, 2, 3])])
    return Part(points.reshape(-1, 3), faces)


def tall_plant(rng: np.random.Generator) -> Design:
    """Plant as high as a person, with so many leaves that the pot is the smaller part."""
    design = Design("tall plant")
    height, radius = rng.uniform(0.9, 1.9), rng.uniform(0.22, 0.4)
    pot, tall = rng.uniform(0.12, 0.2), rng.uniform(0.2, 0.4)
    design.add(parts.lathe([(pot * 0.75, 0.0), (pot, tall), (pot * 0.85, tall - 0.02)], 16), _any(rng))
    for _ in range(int(rng.integers(1, 4))):
        lean = rng.normal(0, 0.08, size=2)
        stem = [
            (0, tall * 0.8, 0),
            (lean[0], 0.5 * height, lean[1]),
            (2 * lean[0], 0.85 * height, 2 * lean[1]),
        ]
        design.add(parts.tube(stem, 0.012, 6), palette.shade((0.3, 0.22, 0.12), rng.uniform(0.7, 1.2)))
    green = palette.shade(LEAF, rng.uniform(0.6, 1.7))
    low = tall + rng.uniform(0.0, 0.35) * (height - tall)
    leaf = rng.uniform(0.1, 0.3)
    for shade in (0.7, 1.0, 1.3):
        count = int(rng.integers(40, 110) * 0.15 / leaf) + 8
        design.add(_leaves(rng, count, low, height, radius, leaf), palette.shade(green, shade))
    return design


def small_plant(rng: np.random.Generator) -> Design:
    """Plant of a hand's height."""
    design = Design("small plant", support="table")
    pot, tall = rng.uniform(0.03, 0.06), rng.uniform(0.06, 0.1)
    design.add(parts.lathe([(pot * 0.7, 0.0), (pot, tall), (pot * 0.85, tall - 0.01)], 12), _any(rng))
    green, top = palette.shade(LEAF, rng.uniform(0.7, 2.0)), tall + rng.uniform(0.05, 0.13)
    for shade in (0.8, 1.2):
        design.add(_leaves(rng, 22, tall, top, pot * 1.4, 0.06), palette.shade(green, shade))
    return design


def backpack(rng: np.random.Generator) -> Design:
    """Bag with a pocket and straps, standing."""
    design = Design("backpack", support="floor")
    width, height, depth = rng.uniform(0.26, 0.36), rng.uniform(0.34, 0.5), rng.uniform(0.14, 0.24)
    color = _any(rng)
    design.add(_lump(rng, (width, height, depth), 0.12), color)
    pocket = parts.moved(_lump(rng, (width * 0.75, height * 0.5, depth * 0.6), 0.1), (0, 0.02, -depth * 0.4))
    design.add(pocket, palette.shade(color, rng.uniform(0.4, 1.6)))
    angle = np.linspace(0, np.pi, 8)
    for side in (-1, 1):
        strap = np.stack(
            [
                np.full(8, side * width * 0.25),
                height * (0.15 + 0.8 * angle / np.pi),
                depth * (0.4 + 0.3 * np.sin(angle)),
            ],
            axis=1,
        )
        design.add(parts.tube(strap, 0.014, 5), palette.shade(color, 0.5))
    return design


def carrier_bag(rng: np.random.Generator) -> Design:
    """Bag of paper or plastic, open above, with handles."""
    design = Design("carrier bag")
    width, height, depth = rng.uniform(0.2, 0.4), rng.uniform(0.22, 0.42), rng.uniform(0.08, 0.18)
    sides = [parts.rectangle(width * share, depth * share) for share in (0.9, 1.0, 0.97, 0.9)]
    color = _any(rng)
    design.add(parts.stack(sides, [0.0, height, height - 0.002, 0.02]), color)
    angle = np.linspace(0, np.pi, 7)
    for z in (-depth / 2, depth / 2):
        loop = np.stack([0.25 * width * np.cos(angle), height + 0.12 * np.sin(angle), np.full(7, z)], axis=1)
        design.add(parts.tube(loop, 0.006, 5), palette.shade(color, 0.6))
    return design


def cardboard_box(rng: np.random.Generator) -> Design:
    """Box, closed or with its flaps up, sometimes several on one another."""
    design = Design("cardboard box")
    color = palette.shade(CARDBOARD, rng.uniform(0.7, 1.2)) if rng.random() < 0.7 else _any(rng)
    width, depth = rng.uniform(0.2, 0.6), rng.uniform(0.2, 0.5)
    base = 0.0
    for _ in range(int(rng.choice([1, 1, 1, 2, 3]))):
        height = rng.uniform(0.12, 0.45)
        part = parts.turned(parts.box((0, height / 2, 0), (width, height, depth)), float(rng.uniform(-8, 8)))
        design.add(parts.moved(part, (0, base, 0)), palette.shade(color, rng.uniform(0.8, 1.15)))
        tape = parts.box((0, base + height, 0), (0.05, 0.004, depth))
        design.add(tape, (0.8, 0.72, 0.5))
        base += height
        width, depth = width * rng.uniform(0.7, 1.0), depth * rng.uniform(0.7, 1.0)
    if rng.random() < 0.4:
        for side in (-1, 1):
            flap = parts.tilted(
                parts.box((0, 0.07, 0), (width, 0.14, 0.006)), side * float(rng.uniform(10, 70))
            )
            design.add(parts.moved(flap, (0, base, side * depth / 2)), color)
    return design


def crate(rng: np.random.Generator) -> Design:
    """Open crate or laundry tub with things in it."""
    design = Design("crate")
    width, height, depth = rng.uniform(0.3, 0.55), rng.uniform(0.15, 0.32), rng.uniform(0.25, 0.4)
    outlines = [parts.rectangle(width * k, depth * k, 0.03) for k in (0.9, 1.0, 0.95, 0.85)]
    design.add(parts.stack(outlines, [0.0, height, height, 0.02]), _any(rng))
    for _ in range(int(rng.integers(2, 7))):
        thing = parts.lathe([(0.02, 0.0), (rng.uniform(0.04, 0.09), 0.06), (0.03, 0.12)], 10)
        at = rng.uniform(-0.32, 0.32, 2) * [width, depth]
        design.add(parts.moved(thing, (at[0], height - rng.uniform(0.05, 0.12), at[1])), _any(rng))
    return design


def books(rng: np.random.Generator) -> Design:
    """Pile of books or magazines, each turned a little."""
    design = Design("books", support="table")
    base = 0.0
    for _ in range(int(rng.integers(1, 8))):
        size = rng.uniform(0.13, 0.22), rng.uniform(0.008, 0.04), rng.uniform(0.18, 0.3)
        part = parts.turned(parts.box((0, size[1] / 2, 0), size), float(rng.normal(0, 12)))
        design.add(parts.moved(part, (0, base, 0)), _any(rng))
        base += size[1]
    return design


def standing_books(rng: np.random.Generator) -> Design:
    """Row of books or folders, spines to the front."""
    design = Design("standing books", support="table")
    x, count = 0.0, int(rng.integers(3, 16))
    tall = rng.uniform(0.18, 0.3)
    alike = _any(rng) if rng.random() < 0.3 else None
    for _ in range(count):
        thick = rng.uniform(0.015, 0.05) if alike is None else 0.06
        size = thick * 0.94, tall * rng.uniform(0.8, 1.05), rng.uniform(0.14, 0.2)
        design.add(parts.box((x + thick / 2, size[1] / 2, 0), size), alike or _any(rng))
        x += thick
    return design


def bottle(rng: np.random.Generator) -> Design:
    """One or several bottles, cans or jars."""
    design = Design("bottle", support="table")
    for i in range(int(rng.choice([1, 1, 2, 3]))):
        r, h = rng.uniform(0.025, 0.05), rng.uniform(0.1, 0.32)
        neck = r * rng.uniform(0.3, 1.0)
        body = parts.lathe([(r, 0.0), (r, h * 0.6), (neck, h * 0.75), (neck, h)], 14)
        design.add(parts.moved(body, (0.11 * i, 0, rng.normal(0, 0.03))), _any(rng))
    return design


def cups(rng: np.random.Generator) -> Design:
    """Cups, glasses or a plate with something on it."""
    design = Design("cups", support="table")
    if rng.random() < 0.4:
        r = rng.uniform(0.08, 0.14)
        design.add(
            parts.lathe([(r * 0.6, 0.0), (r, 0.02), (r * 0.6, 0.008)], 20), palette.pick(rng, palette.PAINTS)
        )
        design.add(parts.moved(_lump(rng, (r, 0.05, r)), (0, 0.01, 0)), _any(rng))
        return design
    for i in range(int(rng.integers(1, 4))):
        r, h = rng.uniform(0.03, 0.045), rng.uniform(0.07, 0.12)
        cup = parts.lathe([(r * 0.8, 0.0), (r, h), (r * 0.85, h), (r * 0.7, 0.01)], 14)
        design.add(parts.moved(cup, (0.12 * i, 0, rng.normal(0, 0.04))), _any(rng))
    return design


def fruit_bowl(rng: np.random.Generator) -> Design:
    """Bowl or low basket with fruits."""
    design = Design("fruit bowl", support="table")
    r, h = rng.uniform(0.1, 0.2), rng.uniform(0.05, 0.1)
    design.add(parts.lathe([(r * 0.6, 0.0), (r, h), (r * 0.93, h), (r * 0.5, 0.01)], 20), _any(rng))
    for _ in range(int(rng.integers(4, 14))):
        size = rng.uniform(0.06, 0.09)
        at = rng.uniform(-0.6, 0.6, 2) * r
        color = [(0.85, 0.7, 0.1), (0.75, 0.15, 0.1), (0.45, 0.65, 0.15), (0.9, 0.5, 0.1)][
            int(rng.integers(4))
        ]
        ball = _lump(rng, (size, size, size), 0.05)
        design.add(
            parts.moved(ball, (at[0], rng.uniform(0.3, 0.9) * h, at[1])),
            palette.shade(color, rng.uniform(0.7, 1.1)),
        )
    return design


def papers(rng: np.random.Generator) -> Design:
    """Sheets, a notebook, a folder, a telephone or tablet."""
    design = Design("papers", support="table")
    for _ in range(int(rng.integers(1, 6))):
        size = rng.uniform(0.08, 0.24), rng.uniform(0.002, 0.012), rng.uniform(0.14, 0.3)
        part = parts.turned(parts.box((0, size[1] / 2, 0), size), float(rng.uniform(-40, 40)))
        color = (0.96, 0.96, 0.94) if rng.random() < 0.6 else _any(rng)
        at = rng.normal(0, 0.06, 2)
        design.add(parts.moved(part, (at[0], 0.003 * rng.integers(0, 4), at[1])), color)
    return design


def keyboard(rng: np.random.Generator) -> Design:
    """Keyboard and mouse."""
    design = Design("keyboard", support="table")
    color = palette.pick(rng, palette.PLASTICS[:3])
    wide = rng.uniform(0.3, 0.46)
    design.add(parts.box((0, 0.012, 0), (wide, 0.02, 0.14)), color)
    for row in range(5):
        keys = parts.box((0, 0.024, 0.05 - row * 0.026), (wide - 0.03, 0.006, 0.02))
        design.add(keys, palette.shade(color, 1.4 if color[0] > 0.5 else 2.2))
    mouse = parts.moved(parts.cushion((0, 0.02, 0), (0.06, 0.035, 0.1)), (wide / 2 + 0.1, 0, 0))
    design.add(mouse, palette.shade(color, rng.uniform(0.6, 1.5)))
    return design


def toys(rng: np.random.Generator) -> Design:
    """Building blocks, a ball or a stuffed animal."""
    design = Design("toys")
    if rng.random() < 0.4:
        color = _any(rng)
        s = rng.uniform(0.12, 0.3)
        for offset, size in (
            ((0, 0, 0), (s, s * 1.1, s * 0.8)),
            ((0, s, 0), (s * 0.75, s * 0.7, s * 0.7)),
            ((-s * 0.3, s * 1.6, 0), (s * 0.25, s * 0.25, s * 0.2)),
            ((s * 0.3, s * 1.6, 0), (s * 0.25, s * 0.25, s * 0.2)),
            ((-s * 0.4, 0, -s * 0.4), (s * 0.35, s * 0.35, s * 0.6)),
            ((s * 0.4, 0, -s * 0.4), (s * 0.35, s * 0.35, s * 0.6)),
        ):
            design.add(parts.moved(_lump(rng, size, 0.08), offset), color)
        return design
    for _ in range(int(rng.integers(3, 9))):
        at, side = rng.normal(0, 0.22, 2), rng.uniform(0.03, 0.14)
        thing = (
            parts.box((0, side / 2, 0), (side, side, side))
            if rng.random() < 0.6
            else _lump(rng, (side,) * 3, 0.03)
        )
        design.add(parts.moved(parts.turned(thing, float(rng.uniform(0, 90))), (at[0], 0, at[1])), _any(rng))
    return design


def shoes(rng: np.random.Generator) -> Design:
    """Some pairs of shoes side by side."""
    design = Design("shoes")
    x = 0.0
    for _ in range(int(rng.integers(1, 4))):
        color, length = _any(rng), rng.uniform(0.2, 0.3)
        for _ in range(2):
            shoe = parts.cushion((x, 0.035, 0), (0.09, 0.07, length), corner=0.04, edge=0.03)
            shaft = parts.cushion((x, 0.08, length * 0.25), (0.08, 0.09, length * 0.4), corner=0.03)
            design.add([shoe, shaft], color)
            x += rng.uniform(0.1, 0.16)
    return design


def cable(rng: np.random.Generator) -> Design:
    """Cable that winds over the floor, with a socket strip."""
    design = Design("cable")
    steps = np.cumsum(np.full(14, 0.1))
    path = np.stack([steps - 0.7, np.full(14, 0.006), np.cumsum(rng.normal(0, 0.06, 14))], axis=1)
    color = palette.pick(rng, palette.PLASTICS[:3])
    design.add(parts.tube(path, 0.006, 5), color)
    design.add(parts.moved(parts.box((0, 0.02, 0), (0.3, 0.04, 0.06)), tuple(path[-1])), color)
    return design


def clothes(rng: np.random.Generator) -> Design:
    """Heap of clothes, a blanket or a crumpled bag."""
    design = Design("clothes", support="bed")
    for _ in range(int(rng.integers(1, 4))):
        size = rng.uniform(0.2, 0.5), rng.uniform(0.06, 0.2), rng.uniform(0.2, 0.45)
        at = rng.normal(0, 0.08, 2)
        design.add(parts.moved(_lump(rng, size, 0.35), (at[0], 0, at[1])), _any(rng))
    return design


def person(rng: np.random.Generator) -> Design:
    """Somebody standing: legs, trunk, arms, head and hair."""
    design = Design("person")
    tall = rng.uniform(1.45, 1.9) if rng.random() < 0.85 else rng.uniform(0.95, 1.3)
    k = tall / 1.75
    skin, hair = palette.pick(rng, SKINS), palette.shade((0.25, 0.16, 0.1), rng.uniform(0.2, 2.5))
    shirt, trousers = _any(rng), _any(rng)
    stride = rng.uniform(0.0, 0.12)
    for side in (-1, 1):
        foot = side * stride
        leg = [(side * 0.1, 0.04, foot), (side * 0.1, 0.48, foot * 0.4), (side * 0.09, 0.86, 0)]
        design.add(parts.tube(np.array(leg) * k, [0.055 * k, 0.065 * k, 0.09 * k], 10), trousers)
        shoe = parts.cushion((side * 0.1 * k, 0.04, (foot - 0.06) * k), (0.1, 0.08, 0.27), corner=0.04)
        design.add(shoe, _any(rng))
        reach = rng.uniform(-0.3, 0.05)
        arm = [(side * 0.2, 1.42, 0), (side * 0.26, 1.15, 0.02), (side * 0.24, 0.92, reach)]
        design.add(parts.tube(np.array(arm) * k, [0.055 * k, 0.045 * k, 0.035 * k], 8), shirt)
        hand = parts.moved(_lump(rng, (0.08, 0.1, 0.08), 0.05), np.array([side * 0.24, 0.84, reach]) * k)
        design.add(hand, skin)
    trunk = [
        parts.ellipse(w * k, d * k, 16)
        for w, d in ((0.34, 0.24), (0.3, 0.21), (0.4, 0.23), (0.38, 0.2), (0.14, 0.12))
    ]
    design.add(parts.stack(trunk, [h * k for h in (0.82, 1.05, 1.3, 1.42, 1.5)]), shirt)
    head = [
        parts.ellipse(w * k, d * k, 14)
        for w, d in ((0.1, 0.1), (0.14, 0.17), (0.16, 0.2), (0.13, 0.17), (0.05, 0.06))
    ]
    design.add(parts.stack(head, [h * k for h in (1.46, 1.54, 1.63, 1.71, 1.75)]), skin)
    cap = [
        parts.ellipse(w * k, d * k, 14) for w, d in ((0.15, 0.12), (0.18, 0.2), (0.15, 0.19), (0.06, 0.08))
    ]
    design.add(
        parts.moved(parts.stack(cap, [h * k for h in (1.55, 1.65, 1.73, 1.77)]), (0, 0, 0.03 * k)), hair
    )
    return design


def coat_stand(rng: np.random.Generator) -> Design:
    """Pole with jackets on it."""
    design = Design("coat stand")
    tall = rng.uniform(1.6, 1.85)
    metal = palette.pick(rng, palette.METALS + palette.WOODS)
    design.add(parts.lathe([(0.2, 0.0), (0.2, 0.02), (0.02, 0.05), (0.02, tall)], 12), metal)
    for i in range(int(rng.integers(1, 5))):
        coat = _lump(rng, (rng.uniform(0.25, 0.4), rng.uniform(0.7, 1.1), 0.18), 0.25)
        angle = i * 1.6 + rng.uniform(0, 0.5)
        at = 0.14 * np.cos(angle), tall - 0.15 - np.ptp(coat.vertices[:, 1]), 0.14 * np.sin(angle)
        design.add(parts.moved(parts.turned(coat, float(np.degrees(angle))), at), _any(rng))
    return design


def fan(rng: np.random.Generator) -> Design:
    """Standing fan or heater on a foot."""
    design = Design("fan")
    tall, color = rng.uniform(0.5, 1.2), palette.pick(rng, palette.PLASTICS)
    design.add(parts.lathe([(0.17, 0.0), (0.17, 0.02), (0.02, 0.05), (0.016, tall)], 14), color)
    disc = parts.tilted(parts.lathe([(0.2, -0.05), (0.22, 0.0), (0.2, 0.05)], 20), 90.0)
    design.add(parts.moved(disc, (0, tall + 0.1, -0.03)), palette.shade(color, 1.3))
    hub = parts.tilted(parts.lathe([(0.05, -0.1), (0.05, 0.1)], 12), 90.0)
    design.add(parts.moved(hub, (0, tall + 0.1, -0.03)), palette.shade(color, 0.5))
    return design


def drying_rack(rng: np.random.Generator) -> Design:
    """Rack with towels over its bars."""
    design = Design("drying rack")
    width, tall = rng.uniform(0.6, 1.1), rng.uniform(0.75, 1.05)
    metal = palette.pick(rng, palette.METALS)
    for side in (-width / 2, width / 2):
        design.add(parts.tube([(side, 0, -0.28), (side, tall / 2, 0), (side, tall, 0.28)], 0.012, 6), metal)
        design.add(parts.tube([(side, 0, 0.28), (side, tall / 2, 0), (side, tall, -0.28)], 0.012, 6), metal)
    for z in np.linspace(-0.28, 0.28, 5):
        design.add(parts.tube([(-width / 2, tall, z), (0, tall, z), (width / 2, tall, z)], 0.006, 5), metal)
        if rng.random() < 0.6:
            w, h = rng.uniform(0.2, 0.9) * width, rng.uniform(0.2, 0.55)
            x = rng.uniform(-0.5, 0.5) * (width - w)
            design.add(parts.box((x, tall - h / 2 + 0.01, z), (w, h, 0.03)), _any(rng))
    return design


def game_table(rng: np.random.Generator) -> Design:
    """Big piece that is of no class: a football table, an exercise machine, a crib of tools."""
    design = Design("game table")
    width, tall, depth = rng.uniform(0.9, 1.5), rng.uniform(0.75, 0.95), rng.uniform(0.6, 0.8)
    body = _any(rng)
    for x in (-1, 1):
        for z in (-1, 1):
            leg = parts.box(
                (x * (width / 2 - 0.08), tall / 2 - 0.1, z * (depth / 2 - 0.08)), (0.09, tall - 0.2, 0.09)
            )
            design.add(leg, palette.shade(body, 0.6))
    rim = [parts.rectangle(width * k, depth * k) for k in (1.0, 1.0, 0.94, 0.94)]
    design.add(parts.stack(rim, [tall - 0.3, tall, tall, tall - 0.1]), body)
    for x in np.linspace(-0.42, 0.42, 8):
        bar = [
            (x * width, tall + 0.02, -depth / 2 - 0.15),
            (x * width, tall + 0.02, 0),
            (x * width, tall + 0.02, depth / 2 + 0.15),
        ]
        design.add(parts.tube(bar, 0.01, 6), (0.75, 0.75, 0.77))
        for z in rng.uniform(-0.4, 0.4, int(rng.integers(1, 4))):
            design.add(parts.box((x * width, tall - 0.03, z * depth), (0.03, 0.13, 0.04)), _any(rng))
    return design


def ladder(rng: np.random.Generator) -> Design:
    """Stepladder, ironing board or easel: two legs and boards across."""
    design = Design("ladder")
    tall, width, color = (
        rng.uniform(0.8, 1.7),
        rng.uniform(0.35, 0.5),
        palette.pick(rng, palette.METALS + palette.WOODS),
    )
    for side in (-1, 1):
        design.add(
            parts.tube(
                [
                    (side * width / 2, 0, -0.3),
                    (side * width / 2.4, tall / 2, -0.15),
                    (side * width / 3, tall, 0),
                ],
                0.02,
                6,
            ),
            color,
        )
        design.add(
            parts.tube(
                [
                    (side * width / 2, 0, 0.35),
                    (side * width / 2.4, tall / 2, 0.18),
                    (side * width / 3, tall, 0),
                ],
                0.016,
                6,
            ),
            color,
        )
    for level in np.arange(0.25, tall, 0.25):
        design.add(
            parts.box((0, level, -0.3 * (1 - level / tall)), (width * 0.9, 0.025, 0.1)),
            palette.shade(color, 0.8),
        )
    return design


def bean_bag(rng: np.random.Generator) -> Design:
    """Sack, rolled mat or heap in a corner."""
    design = Design("bean bag")
    side = rng.uniform(0.4, 0.8)
    design.add(_lump(rng, (side, side * rng.uniform(0.5, 1.1), side), 0.15), _any(rng))
    return design


ON_TABLES: dict[Thing, float] = {
    small_plant: 1.0,
    books: 1.5,
    standing_books: 1.0,
    bottle: 1.5,
    cups: 1.5,
    fruit_bowl: 0.7,
    papers: 2.0,
    keyboard: 1.0,
    carrier_bag: 0.4,
    cardboard_box: 0.3,
    crate: 0.4,
    clothes: 0.3,
    backpack: 0.3,
    toys: 0.3,
}
"""What stands and lies on tables, desks and cabinets, and how often."""

IN_SHELVES: dict[Thing, float] = {
    standing_books: 5.0,
    books: 2.0,
    bottle: 1.0,
    small_plant: 0.5,
    cups: 0.7,
    toys: 0.3,
}
"""What fills bookshelves."""

ON_SEATS: dict[Thing, float] = {clothes: 2.0, backpack: 1.0, carrier_bag: 0.5, books: 0.7, papers: 0.5}
"""What lies on sofas, beds and chairs."""

ON_FLOORS: dict[Thing, float] = {
    tall_plant: 2.0,
    backpack: 1.2,
    carrier_bag: 1.0,
    cardboard_box: 2.0,
    crate: 0.8,
    books: 0.4,
    toys: 0.7,
    shoes: 1.0,
    cable: 0.8,
    clothes: 0.5,
    person: 1.2,
    coat_stand: 0.5,
    fan: 0.5,
    drying_rack: 0.4,
    game_table: 0.5,
    ladder: 0.4,
    bean_bag: 0.5,
}
"""What stands and lies on the floor."""
