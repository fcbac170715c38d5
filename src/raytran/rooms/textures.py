# SPDX-License-Identifier: Apache-2.0
"""Photograph-like textures in colour, all computed: stone, wood, cloth, wallpaper, views, posters, screens.

Those in grey are blended between the two colours of a ``Paint``; those in colour show their own where the
paint goes from black to white.
"""

from __future__ import annotations

import colorsys
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from raytran.rooms.materials import LEVELS, SIZE, blocks, cloud, grain, texel_index, value_noise

Image = NDArray[np.float64]
Draw = Callable[[np.random.Generator], Image]

_SEED = 20261130


@dataclass(frozen=True)
class PhotoTextures:
    """All textures of this module and their mip levels in one array.

    Attributes:
        texels: all levels of all textures, ``(n,)`` uint32 of which three bytes are red, green and blue.
        side: ``(textures,)`` metres after which each repeats.
    """

    texels: NDArray[np.uint32]
    side: NDArray[np.float32]

    def sample(
        self,
        texture: NDArray[np.int32],
        u: NDArray[np.float32],
        v: NDArray[np.float32],
        footprint: NDArray[np.float32],
    ) -> NDArray[np.float32]:
        """Return ``(3, n)`` colours in [0, 1]; arguments as of ``TextureLibrary.sample``."""
        texels = self.texels[texel_index(self.side, texture, u, v, footprint)]
        found = texels.view(np.uint8).reshape(-1, 4)
        return np.ascontiguousarray(found[:, :3].T, dtype=np.float32) * np.float32(1 / 255)


@lru_cache(maxsize=2)
def photo_textures(draw: int = 0) -> PhotoTextures:
    """Return one of any number of draws of all textures, the same in every process."""
    texels = []
    for number, (_, texture) in enumerate(_TEXTURES.values()):
        image = texture(np.random.default_rng([_SEED, draw, number]))
        image = np.repeat(image[..., None], 3, axis=2) if image.ndim == 2 else image
        image = image[::-1].clip(0.0, 1.0).astype(np.float32)  # rows grow upwards on a wall
        for _ in range(LEVELS):
            packed = np.zeros((*image.shape[:2], 4), dtype=np.uint8)
            packed[..., :3] = image * 255 + 0.5
            texels.append(packed.view(np.uint32).ravel())
            half = image.shape[0] // 2
            image = image.reshape(half, 2, half, 2, 3).mean(axis=(1, 3)) if half else image
    side = np.array([side for side, _ in _TEXTURES.values()], dtype=np.float32)
    return PhotoTextures(np.concatenate(texels), side)


def photo_index(name: str) -> int:
    """Return the number of the texture called ``name``."""
    return _NAMES.index(name)


def _grid() -> tuple[Image, Image]:
    """Return rows and columns ``(SIZE, SIZE)`` in [0, 1)."""
    row, column = np.mgrid[0:SIZE, 0:SIZE] / SIZE
    return row, column


def _stretched(image: Image) -> Image:
    """Bring an image to the range [0, 1]."""
    low, high = image.min(), image.max()
    return np.asarray((image - low) / max(high - low, 1e-9))


def _color(
    rng: np.random.Generator,
    saturation: tuple[float, float],
    value: tuple[float, float],
    hue: float | None = None,
) -> Image:
    if hue is None:
        hue = rng.choice([0.02, 0.09, 0.13, 0.33, 0.58, 0.62, 0.95]) + rng.normal(0, 0.04)
    return 0.08 + 0.84 * np.array(
        colorsys.hsv_to_rgb(hue % 1.0, rng.uniform(*saturation), rng.uniform(*value))
    )


def _mixed(low: Image, high: Image, share: Image) -> Image:
    """Blend two colours by an image of shares."""
    return low + (high - low) * share[..., None]


def _sparse(rng: np.random.Generator, share: float, blur: float) -> Image:
    """Return specks: a share of all texels set, a little blurred."""
    return ndimage.gaussian_filter((rng.random((SIZE, SIZE)) < share).astype(float), blur, mode="wrap")


def _cells(rng: np.random.Generator, count: int) -> tuple[Image, NDArray[np.int_]]:
    """Return how far each texel is from the border of its cell, and the number of the cell (periodic)."""
    points = rng.random((count, 2)) * SIZE
    marked = np.ones((SIZE, SIZE), dtype=bool)
    index = points.astype(int)
    marked[index[:, 0], index[:, 1]] = False
    tiled = np.tile(marked, (3, 3))
    nearest = ndimage.distance_transform_edt(tiled, return_distances=False, return_indices=True)
    nearest = nearest[:, SIZE : 2 * SIZE, SIZE : 2 * SIZE] % SIZE
    label = nearest[0] * SIZE + nearest[1]
    border = (label != np.roll(label, 1, axis=0)) | (label != np.roll(label, 1, axis=1))
    far = ndimage.distance_transform_edt(~np.tile(border, (3, 3)))[SIZE : 2 * SIZE, SIZE : 2 * SIZE]
    return far, np.unique(label, return_inverse=True)[1].reshape(SIZE, SIZE)


# Walls and stone.
def _plain(rng: np.random.Generator) -> Image:
    return 0.9 + 0.1 * cloud(rng, 4, 5)


def _plaster(rng: np.random.Generator) -> Image:
    return 0.75 * cloud(rng, 6, 6) + 0.25 * rng.random((SIZE, SIZE))


def _roughcast(rng: np.random.Generator) -> Image:
    bumps = cloud(rng, 48, 3)
    shaded = bumps - np.roll(bumps, (2, 2), axis=(0, 1))
    return 0.6 + 2.2 * shaded + 0.2 * (cloud(rng, 3, 3) - 0.5)


def _concrete(rng: np.random.Generator) -> Image:
    pores = _sparse(rng, 0.0015, 1.2)
    return 0.35 + 0.6 * cloud(rng, 3, 7) - 2.0 * pores + 0.08 * rng.standard_normal((SIZE, SIZE))


def _brick(rng: np.random.Generator) -> Image:
    wall = blocks(rng, 16, 6, 0.5, 0.12)
    return wall * (0.75 + 0.5 * cloud(rng, 16, 5)) + (wall == 0) * 0.85


def _stone_wall(rng: np.random.Generator) -> Image:
    far, label = _cells(rng, 60)
    return np.minimum(far / 6, 1.0) * (
        0.4 + 0.4 * rng.random(label.max() + 1)[label] + 0.4 * (cloud(rng, 16, 5) - 0.5)
    )


def _marble(rng: np.random.Generator) -> Image:
    row, column = _grid()
    bent = cloud(rng, 3, 6) * 5 + 1.0 * (row + column)
    veins = 1 - np.abs(np.sin(np.pi * bent))
    return 0.95 - 0.7 * veins**8 - 0.25 * cloud(rng, 4, 4) * veins


def _granite(rng: np.random.Generator) -> Image:
    return 0.5 + 1.2 * (cloud(rng, 90, 2) - 0.5) + 0.25 * rng.standard_normal((SIZE, SIZE))


def _terrazzo(rng: np.random.Generator) -> Image:
    far, label = _cells(rng, 900)
    colors = np.stack([_color(rng, (0.0, 0.4), (0.3, 0.9)) for _ in range(label.max() + 1)])
    ground = _color(rng, (0.0, 0.15), (0.6, 0.85))
    shown = (rng.random(label.max() + 1) < 0.55)[label] & (far > 2.5)
    return np.where(shown[..., None], colors[label], ground)


def _stripes(rng: np.random.Generator) -> Image:
    _, column = _grid()
    widths = rng.integers(0, 2, size=16)
    return 0.1 + 0.8 * widths[(column * 16).astype(int)] + 0.1 * cloud(rng, 16, 3)


def _damask(rng: np.random.Generator) -> Image:
    part = cloud(rng, 4, 3)[: SIZE // 4, : SIZE // 4]
    motif = np.concatenate([part, part[:, ::-1]], axis=1)
    motif = np.concatenate([motif, np.roll(motif, SIZE // 4, axis=1)[::-1]], axis=0)
    figure = np.tile(motif, (2, 2))
    level = np.median(figure)
    return 0.5 + 0.45 * np.tanh((figure - level) * 40) + 0.06 * rng.standard_normal((SIZE, SIZE))


def _floral(rng: np.random.Generator) -> Image:
    image = np.empty((SIZE, SIZE, 3))
    image[:] = _color(rng, (0.0, 0.3), (0.6, 1.0))
    row, column = np.mgrid[0:SIZE, 0:SIZE]
    colors = [_color(rng, (0.3, 0.9), (0.3, 0.9)) for _ in range(4)]
    for _ in range(70):
        y, x = rng.integers(SIZE, size=2)
        dy = (row - y + SIZE // 2) % SIZE - SIZE // 2
        dx = (column - x + SIZE // 2) % SIZE - SIZE // 2
        angle, radius = np.arctan2(dy, dx), np.hypot(dy, dx)
        size = rng.uniform(12, 34)
        petals = size * (0.6 + 0.4 * np.cos(int(rng.integers(3, 8)) * angle + rng.uniform(0, 6)))
        image[radius < petals] = colors[int(rng.integers(4))]
        image[radius < 0.2 * size] = colors[int(rng.integers(4))]
    return image


def _diamonds(rng: np.random.Generator) -> Image:
    row, column = _grid()
    across = np.abs(((row * 8) % 1) - 0.5) + np.abs(((column * 8) % 1) - 0.5)
    return np.where(np.abs(across - 0.5) < 0.06, 0.1, np.where(across < 0.2, 0.4, 0.95)) + 0.05 * cloud(
        rng, 8, 3
    )


# Floors.
def _planks(rng: np.random.Generator) -> Image:
    rows = int(rng.integers(8, 17))
    joints = blocks(rng, 1 << int(np.log2(rows)), 2, 0.5, 0.03)
    return (0.55 * joints + 0.5 * grain(rng)) * (joints > 0) + 0.12 * (cloud(rng, 32, 4) - 0.5)


def _old_planks(rng: np.random.Generator) -> Image:
    joints = blocks(rng, 8, 1, 0.37, 0.05)
    worn = cloud(rng, 3, 6)
    return (0.4 * joints + 0.4 * grain(rng) + 0.4 * (worn - 0.5)) * (joints > 0) + 0.08 * _knots(rng)


def _knots(rng: np.random.Generator) -> Image:
    return -_stretched(_sparse(rng, 0.0002, 5.0))


def _parquet(rng: np.random.Generator) -> Image:
    return 0.55 * blocks(rng, 16, 4, 0.5, 0.05) + 0.45 * grain(rng)


def _herringbone(rng: np.random.Generator) -> Image:
    row, column = np.mgrid[0:SIZE, 0:SIZE] // 32
    side = 4
    lies = ((row + column) // side) % 2 == 0
    piece = np.where(
        lies, row * 31 + (column - row) // (2 * side), column * 37 + (row - column) // (2 * side)
    )
    shade = rng.random(997)[piece % 997]
    fine = np.where(lies, grain(rng), grain(rng).T)
    y, x = np.mgrid[0:SIZE, 0:SIZE]
    joint = np.where(lies, y % 32 < 2, x % 32 < 2)
    return np.where(joint, 0.1, 0.25 + 0.45 * shade + 0.3 * fine)


def _tiles(rng: np.random.Generator) -> Image:
    count = int(rng.choice([2, 4, 8]))
    return 0.72 * blocks(rng, count, count, 0.0, 0.03) ** 0.3 + 0.28 * cloud(rng, 8, 6)


def _subway_tiles(rng: np.random.Generator) -> Image:
    return 0.9 * blocks(rng, 16, 8, 0.5, 0.06) ** 0.12 + 0.1 * cloud(rng, 8, 3)


def _checkered_tiles(rng: np.random.Generator) -> Image:
    row, column = _grid()
    dark = ((row * 4).astype(int) + (column * 4).astype(int)) % 2
    joint = ((row * 4) % 1 < 0.02) | ((column * 4) % 1 < 0.02)
    return np.where(joint, 0.5, 0.1 + 0.75 * dark) + 0.2 * (cloud(rng, 6, 6) - 0.5)


def _mosaic(rng: np.random.Generator) -> Image:
    palette = np.stack([_color(rng, (0.1, 0.7), (0.3, 0.95)) for _ in range(5)])
    row, column = _grid()
    cell = palette[rng.integers(5, size=(32, 32))][(row * 32).astype(int), (column * 32).astype(int)]
    joint = ((row * 32) % 1 < 0.12) | ((column * 32) % 1 < 0.12)
    return np.where(joint[..., None], 0.8, cell)


def _carpet(rng: np.random.Generator) -> Image:
    return 0.45 * rng.random((SIZE, SIZE)) + 0.3 * cloud(rng, 64, 2) + 0.3 * cloud(rng, 4, 4)


def _carpet_tiles(rng: np.random.Generator) -> Image:
    row, column = _grid()
    turned = ((row * 4).astype(int) + (column * 4).astype(int)) % 2
    lines = value_noise(rng, (256, 16))
    return (
        0.3
        + 0.35 * np.where(turned, lines, lines.T)
        + 0.25 * rng.random((SIZE, SIZE))
        + 0.2 * cloud(rng, 4, 3)
        - 0.12 * (((row * 4) % 1 < 0.012) | ((column * 4) % 1 < 0.012))
    )


def _persian(rng: np.random.Generator) -> Image:
    row, column = _grid()
    x, y = np.abs(column - 0.5) * 2, np.abs(row - 0.5) * 2
    edge = np.maximum(x, y)
    palette = np.stack([_color(rng, (0.3, 0.9), (0.15, 0.85)) for _ in range(6)])
    part = cloud(rng, 12, 3)[: SIZE // 2, : SIZE // 2]
    motif = np.concatenate([part, part[:, ::-1]], axis=1)
    motif = np.concatenate([motif, motif[::-1]], axis=0)
    level = np.digitize(motif, np.quantile(motif, [0.35, 0.5, 0.65, 0.8]))
    band = np.select([edge > 0.94, edge > 0.8, edge > 0.76, np.hypot(x, y) < 0.35], [0, 2, 4, 3], 1)
    return palette[(level // 2 + band) % 6] * (0.85 + 0.25 * rng.random((SIZE, SIZE, 1)))


def _bands(rng: np.random.Generator) -> Image:
    palette = np.stack([_color(rng, (0.1, 0.9), (0.2, 0.95)) for _ in range(5)])
    chosen = rng.integers(5, size=32)
    row, _ = _grid()
    return palette[chosen[(row * 32).astype(int)]] * (0.8 + 0.3 * rng.random((SIZE, SIZE, 1)))


# Wood, cloth and other matter of furniture.
def _wood(rng: np.random.Generator) -> Image:
    return 0.35 * grain(rng) + 0.4 * value_noise(rng, (128, 3)) + 0.35 * value_noise(rng, (400, 8))


def _oak(rng: np.random.Generator) -> Image:
    row, _ = _grid()
    bent = row * 14 + 3.5 * cloud(rng, 2, 4)
    return (
        0.55 + 0.1 * np.sin(2 * np.pi * bent) + 0.45 * (value_noise(rng, (512, 16)) - 0.5) + 0.4 * _knots(rng)
    )


def _walnut(rng: np.random.Generator) -> Image:
    return 0.2 + 0.6 * _stretched(
        value_noise(rng, (64, 2)) + 0.6 * value_noise(rng, (200, 6)) + 0.5 * cloud(rng, 2, 3)
    )


def _chipboard(rng: np.random.Generator) -> Image:
    far, label = _cells(rng, 2500)
    return 0.35 + 0.45 * rng.random(label.max() + 1)[label] + 0.02 * far


def _weave(rng: np.random.Generator) -> Image:
    wave = np.sin(np.arange(SIZE) * 2 * np.pi * 64 / SIZE)
    return (
        0.5
        + 0.22 * wave[:, None] * wave[None, :]
        + 0.35 * (cloud(rng, 24, 4) - 0.5)
        + 0.1 * rng.standard_normal((SIZE, SIZE))
    )


def _corduroy(rng: np.random.Generator) -> Image:
    _, column = _grid()
    return 0.55 + 0.3 * np.sin(column * 2 * np.pi * 48) + 0.4 * (cloud(rng, 4, 4) - 0.5)


def _tweed(rng: np.random.Generator) -> Image:
    row, column = _grid()
    zigzag = np.abs(((column * 16) % 1) - 0.5)
    return (
        0.5
        + 0.35 * np.sign(np.sin(2 * np.pi * (row * 64 + 4 * zigzag))) * rng.random((SIZE, SIZE))
        + 0.2 * (cloud(rng, 4, 3) - 0.5)
    )


def _leather(rng: np.random.Generator) -> Image:
    far, _ = _cells(rng, 5000)
    return 0.3 + 0.5 * np.minimum(far / 3, 1.0) + 0.5 * (cloud(rng, 3, 4) - 0.5)


def _mesh(rng: np.random.Generator) -> Image:
    row, column = _grid()
    holes = np.hypot(((row * 64) % 1) - 0.5, ((column * 64) % 1) - 0.5) < 0.33
    return np.where(holes, 0.1, 0.8) + 0.2 * (cloud(rng, 4, 3) - 0.5)


def _tartan(rng: np.random.Generator) -> Image:
    palette = np.stack([_color(rng, (0.2, 0.9), (0.15, 0.85)) for _ in range(4)])
    lines = palette[rng.integers(4, size=24)][np.arange(SIZE) * 24 // SIZE]
    twill = ((np.arange(SIZE)[:, None] + np.arange(SIZE)[None]) // 2) % 2
    return np.where(twill[..., None] == 0, lines[None], lines[:, None])


def _dots(rng: np.random.Generator) -> Image:
    row, column = _grid()
    y = row * 16
    x = column * 16 + 0.5 * (y.astype(int) % 2)
    return np.where(np.hypot(y % 1 - 0.5, x % 1 - 0.5) < 0.3, 0.05, 0.95) + 0.05 * cloud(rng, 8, 3)


def _brushed(rng: np.random.Generator) -> Image:
    return 0.45 + 0.35 * (value_noise(rng, (512, 3)) - 0.5) + 0.35 * cloud(rng, 2, 2)


def _leaves(rng: np.random.Generator) -> Image:
    far, label = _cells(rng, 700)
    shade = rng.random(label.max() + 1)[label]
    low, high = np.array([0.03, 0.1, 0.02]), np.array([0.35, 0.55, 0.18])
    return _mixed(low, high, (shade * np.minimum(far / 5, 1.0)) ** 1.3)


def _crumpled(rng: np.random.Generator) -> Image:
    folds = np.abs(cloud(rng, 6, 5) - 0.5)
    return 0.35 + 2.2 * (folds - np.roll(folds, (3, 3), axis=(0, 1))) * 3 + 0.5 * cloud(rng, 5, 3)


# What is printed, shown or seen outside.
def _text(rng: np.random.Generator) -> Image:
    """Sheets with a heading, lines of text and a picture."""
    page = np.ones((SIZE, SIZE))
    for top in range(0, SIZE, 256):
        for left in range(0, SIZE, 171):
            y = top + 24
            while y < top + 240:
                tall = 14 if y == top + 24 else 4
                if rng.random() < 0.12 and y < top + 150:
                    size = int(rng.integers(40, 80))
                    page[y : y + size, left + 20 : left + 150] = cloud(rng, 6, 4)[:size, :130]
                    y += size + 8
                    continue
                run = left + 20
                stop = left + int(rng.integers(90, 150))
                while run < stop:
                    word = int(rng.integers(5, 22))
                    page[y : y + tall, run : min(run + word, stop)] = 0.15 + 0.2 * rng.random()
                    run += word + 4
                y += tall + 6
    return page


def _photo(rng: np.random.Generator) -> Image:
    """A landscape: sky, hills one behind the other, and something in front."""
    row, _ = _grid()
    sky = _mixed(_color(rng, (0.2, 0.7), (0.5, 0.9), 0.58), _color(rng, (0.0, 0.5), (0.8, 1.0)), row)
    image = sky + 0.3 * (cloud(rng, 4, 6) - 0.5)[..., None]
    for depth in range(4):
        line = 0.35 + 0.15 * depth + 0.12 * (value_noise(rng, (1, 4 << depth))[0] - 0.5)
        hue = rng.uniform(0.08, 0.4)
        ground = _mixed(
            _color(rng, (0.2, 0.8), (0.05, 0.3), hue),
            _color(rng, (0.2, 0.8), (0.3, 0.8), hue),
            cloud(rng, 12, 6),
        )
        image = np.where((row > line)[..., None], ground, image)
    return image


def _street(rng: np.random.Generator) -> Image:
    """Houses with windows before a sky, a tree line below."""
    row, column = _grid()
    image = _mixed(np.array([0.75, 0.85, 1.0]), np.array([1.0, 1.0, 1.0]), cloud(rng, 3, 6))
    left = 0
    while left < SIZE:
        wide, top = int(rng.integers(50, 150)), int(rng.integers(60, 260))
        house = (column * SIZE >= left) & (column * SIZE < left + wide) & (row * SIZE > top)
        panes = ((column * SIZE - left) % 24 > 9) & ((row * SIZE - top) % 34 > 14)
        wall, pane = _color(rng, (0.05, 0.5), (0.3, 0.9)), _color(rng, (0.1, 0.4), (0.1, 0.4), 0.6)
        image = np.where(house[..., None], np.where(panes[..., None], pane, wall), image)
        left += wide
    trees = row > 0.68 + 0.25 * (value_noise(rng, (1, 12))[0] - 0.5)
    return np.where(trees[..., None], _leaves(rng), image)


def _poster(rng: np.random.Generator) -> Image:
    """Large shapes in strong colours, some lettering."""
    row, column = _grid()
    image = np.empty((SIZE, SIZE, 3))
    image[:] = _color(rng, (0.0, 0.9), (0.2, 1.0))
    for _ in range(int(rng.integers(5, 14))):
        y, x, r = rng.random(), rng.random(), rng.uniform(0.05, 0.35)
        shape = int(rng.integers(3))
        if shape == 0:
            inside = np.hypot(row - y, column - x) < r
        elif shape == 1:
            inside = (np.abs(row - y) < r) & (np.abs(column - x) < r * rng.uniform(0.2, 1.0))
        else:
            inside = np.abs((row - y) + rng.uniform(-2, 2) * (column - x)) < 0.3 * r
        image[inside] = _color(rng, (0.0, 1.0), (0.0, 1.0))
    return np.where((_text(rng) < 0.5)[..., None] & (row > 0.75)[..., None], 0.05, image)


def _face(rng: np.random.Generator) -> Image:
    """A portrait: head, hair and shoulders before a blurred ground."""
    row, column = _grid()
    image = _mixed(_color(rng, (0.1, 0.7), (0.1, 0.6)), _color(rng, (0.1, 0.7), (0.4, 0.9)), cloud(rng, 3, 3))
    skin = np.array([0.85, 0.65, 0.52]) * rng.uniform(0.35, 1.1)
    cloth, hair = _color(rng, (0.1, 0.8), (0.1, 0.9)), _color(rng, (0.2, 0.6), (0.05, 0.5), 0.07)
    for center, size, color in (
        ((1.0, 0.5), (0.42, 0.42), cloth),
        ((0.4, 0.5), (0.27, 0.21), hair),
        ((0.44, 0.5), (0.22, 0.16), skin),
        ((0.4, 0.43), (0.02, 0.03), np.full(3, 0.1)),
        ((0.4, 0.57), (0.02, 0.03), np.full(3, 0.1)),
        ((0.54, 0.5), (0.012, 0.05), np.array([0.5, 0.2, 0.2])),
    ):
        inside = ((row - center[0]) / size[0]) ** 2 + ((column - center[1]) / size[1]) ** 2 < 1
        image = np.where(inside[..., None], color, image)
    return image * (0.8 + 0.4 * cloud(rng, 4, 4))[..., None]


def _books(rng: np.random.Generator) -> Image:
    """Spines side by side, with bands and lettering, standing in rows of a quarter of the texture."""
    image = np.zeros((SIZE, SIZE, 3))
    for top in range(0, SIZE, 128):
        x = 0
        while x < SIZE:
            wide, tall = int(rng.integers(7, 26)), int(rng.integers(88, 124))
            color = _color(rng, (0.0, 0.85), (0.1, 0.95))
            spine = image[top + 128 - tall : top + 128, x : x + wide]
            spine[:] = color * (0.75 + 0.25 * np.sin(np.linspace(0, np.pi, spine.shape[1])))[:, None]
            band = int(rng.integers(8, 50))
            spine[band : band + 14, 2:-2] = _color(rng, (0.0, 0.5), (0.0, 1.0))
            x += wide
    return image


def _screen(rng: np.random.Generator) -> Image:
    """Windows on a desktop, two of them side by side."""
    image = _photo(rng)
    for _ in range(5):
        y, x = rng.integers(0, 380, size=2)
        tall, wide = rng.integers(90, 240, size=2)
        ground = 0.97 if rng.random() < 0.6 else 0.12
        lines = np.where(_text(rng)[:tall, :wide] < 0.5, 1 - ground, ground)
        part = image[y : y + tall, x : x + wide]
        part[:] = lines[: part.shape[0], : part.shape[1], None]
        part[:12] = _color(rng, (0.1, 0.8), (0.3, 0.8))
    return image


def _blinds(rng: np.random.Generator) -> Image:
    row, _ = _grid()
    slat = (row * 32) % 1
    return np.where(slat < 0.15, 0.2, 0.75 + 0.25 * slat) + 0.03 * rng.standard_normal((SIZE, SIZE))


def _grooves(rng: np.random.Generator) -> Image:
    _, column = _grid()
    rib = (column * 16) % 1
    return np.where(rib < 0.2, 0.25, 0.8 + 0.2 * np.sin(np.pi * rib)) + 0.03 * rng.standard_normal(
        (SIZE, SIZE)
    )


def _stain(rng: np.random.Generator) -> Image:
    return _stretched(cloud(rng, 3, 5))


_TEXTURES: dict[str, tuple[float, Draw]] = {
    "plain": (1.0, _plain),
    "plaster": (1.6, _plaster),
    "roughcast": (1.0, _roughcast),
    "concrete": (2.0, _concrete),
    "brick": (1.3, _brick),
    "stone wall": (1.6, _stone_wall),
    "marble": (1.6, _marble),
    "granite": (0.7, _granite),
    "terrazzo": (0.7, _terrazzo),
    "stripes": (1.1, _stripes),
    "damask": (1.2, _damask),
    "floral": (1.2, _floral),
    "diamonds": (1.0, _diamonds),
    "planks": (2.0, _planks),
    "old planks": (1.8, _old_planks),
    "parquet": (1.4, _parquet),
    "herringbone": (1.6, _herringbone),
    "tiles": (1.6, _tiles),
    "subway tiles": (1.0, _subway_tiles),
    "checkered tiles": (1.4, _checkered_tiles),
    "mosaic": (0.9, _mosaic),
    "carpet": (0.8, _carpet),
    "carpet tiles": (2.0, _carpet_tiles),
    "persian": (2.2, _persian),
    "persian 2": (2.0, _persian),
    "bands": (1.4, _bands),
    "wood": (1.2, _wood),
    "oak": (0.9, _oak),
    "walnut": (1.4, _walnut),
    "chipboard": (0.8, _chipboard),
    "weave": (0.35, _weave),
    "corduroy": (0.4, _corduroy),
    "tweed": (0.3, _tweed),
    "leather": (0.5, _leather),
    "mesh": (0.4, _mesh),
    "tartan": (0.5, _tartan),
    "floral 2": (0.6, _floral),
    "dots": (0.5, _dots),
    "brushed": (0.8, _brushed),
    "leaves": (0.8, _leaves),
    "crumpled": (0.6, _crumpled),
    "text": (0.6, _text),
    "photo": (0.9, _photo),
    "photo 2": (0.7, _photo),
    "street": (2.4, _street),
    "poster": (0.8, _poster),
    "poster 2": (0.6, _poster),
    "face": (0.7, _face),
    "books": (1.0, _books),
    "screen": (0.5, _screen),
    "blinds": (1.6, _blinds),
    "grooves": (1.0, _grooves),
    "stain": (4.0, _stain),
}
"""Name → length in metres after which a texture repeats, and what draws it."""

_NAMES = tuple(_TEXTURES)
