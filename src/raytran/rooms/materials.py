# SPDX-License-Identifier: Apache-2.0
"""What a renderer draws: triangles painted with procedural grey textures in two colours."""

from __future__ import annotations

import colorsys
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

SIZE = 512
"""Texels along each side of a texture at its finest level."""

LEVELS = 10
"""Mip levels of a texture, from ``SIZE`` texels down to one."""

TEXTURES = {
    "plain": 1.0,
    "plaster": 1.6,
    "stripes": 0.8,
    "planks": 2.4,
    "parquet": 1.6,
    "tiles": 1.2,
    "carpet": 0.8,
    "wood": 1.2,
    "fabric": 0.4,
    "sky": 3.0,
    "picture": 1.3,
}
"""Name and side length in metres of every texture; a texture repeats after that length."""

_NAMES = tuple(TEXTURES)
_SEED = 20220721

ROOM_OWNER = -1
"""Owner of triangles that belong to the room itself and to no object."""

_BOX_QUADS = ((0, 4, 6, 2), (1, 3, 7, 5), (0, 1, 5, 4), (2, 6, 7, 3), (0, 2, 3, 1), (4, 5, 7, 6))


@dataclass(frozen=True)
class Paint:
    """How a surface looks: a grey texture blended between two colours.

    Attributes:
        dark: display RGB in [0, 1] where the texture is 0.
        light: display RGB in [0, 1] where the texture is 1.
        texture: index into ``materials.TEXTURES``.
        emissive: the surface shines and takes no light.
        scale: the texture repeats after its side times this.
        turned: the texture's two axes are exchanged, as where a board lies across.
        shift: where the texture begins, in its sides.
    """

    dark: tuple[float, float, float]
    light: tuple[float, float, float]
    texture: int = 0
    emissive: bool = False
    scale: float = 1.0
    turned: bool = False
    shift: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True)
class Surfaces:
    """``T`` painted triangles in the room's frame, metres.

    Attributes:
        triangles: ``(T, 3, 3)`` float32 corners.
        dark: ``(T, 3)`` float32, as in ``Paint``.
        light: ``(T, 3)`` float32.
        texture: ``(T,)`` int32.
        emissive: ``(T,)`` bool.
        owner: ``(T,)`` int32 number of the object, or ``ROOM_OWNER``.
        mapping: ``(T, 4)`` float32: scale, turned and shift of the ``Paint``.
    """

    triangles: NDArray[np.float32]
    dark: NDArray[np.float32]
    light: NDArray[np.float32]
    texture: NDArray[np.int32]
    emissive: NDArray[np.bool_]
    owner: NDArray[np.int32]
    mapping: NDArray[np.float32]

    @staticmethod
    def painted(triangles: NDArray[np.floating], paint: Paint, owner: int = ROOM_OWNER) -> Surfaces:
        """Return ``(T, 3, 3)`` triangles that all have the same paint."""
        count = len(triangles)
        return Surfaces(
            triangles=np.asarray(triangles, dtype=np.float32),
            dark=np.tile(np.asarray(paint.dark, dtype=np.float32), (count, 1)),
            light=np.tile(np.asarray(paint.light, dtype=np.float32), (count, 1)),
            texture=np.full(count, paint.texture, dtype=np.int32),
            emissive=np.full(count, paint.emissive),
            owner=np.full(count, owner, dtype=np.int32),
            mapping=np.tile(
                np.array([paint.scale, paint.turned, *paint.shift], dtype=np.float32), (count, 1)
            ),
        )

    @staticmethod
    def joined(sets: Sequence[Surfaces]) -> Surfaces:
        """Return the triangles of several sets as one set, in order."""
        return Surfaces(
            triangles=np.concatenate([surfaces.triangles for surfaces in sets]),
            dark=np.concatenate([surfaces.dark for surfaces in sets]),
            light=np.concatenate([surfaces.light for surfaces in sets]),
            texture=np.concatenate([surfaces.texture for surfaces in sets]),
            emissive=np.concatenate([surfaces.emissive for surfaces in sets]),
            owner=np.concatenate([surfaces.owner for surfaces in sets]),
            mapping=np.concatenate([surfaces.mapping for surfaces in sets]),
        )


def box_triangles(lower: ArrayLike, upper: ArrayLike) -> NDArray[np.float64]:
    """Return the 12 triangles ``(12, 3, 3)`` of the axis-aligned box between two corners."""
    low, high = np.asarray(lower, dtype=np.float64), np.asarray(upper, dtype=np.float64)
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)]) * (high - low) + low
    return np.concatenate([quad_triangles(corners[list(quad)]) for quad in _BOX_QUADS])


def quad_triangles(corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return two triangles ``(2, 3, 3)`` that fill a flat quadrilateral ``(4, 3)`` given round its rim."""
    return corners[np.array([[0, 1, 2], [0, 2, 3]])]


def texture_index(name: str) -> int:
    """Return the number of the texture called ``name``."""
    return _NAMES.index(name)


@dataclass(frozen=True)
class TextureLibrary:
    """All textures and their mip levels in one array.

    Attributes:
        texels: all levels of all textures, float32 in [0, 1].
        side: ``(n,)`` metres.
    """

    texels: NDArray[np.float32]
    side: NDArray[np.float32]

    def sample(
        self,
        texture: NDArray[np.int32],
        u: NDArray[np.float32],
        v: NDArray[np.float32],
        footprint: NDArray[np.float32],
    ) -> NDArray[np.float32]:
        """Return the grey value at surface coordinates.

        Args:
            texture: ``(n,)`` texture of each sample.
            u: ``(n,)`` metres along the surface.
            v: ``(n,)`` metres along the surface.
            footprint: ``(n,)`` size of a pixel on the surface, metres; chooses the mip level.

        Returns:
            ``(n,)`` in [0, 1].
        """
        return self.texels[texel_index(self.side, texture, u, v, footprint)]


def texel_index(
    side: NDArray[np.float32],
    texture: NDArray[np.int32],
    u: NDArray[np.float32],
    v: NDArray[np.float32],
    footprint: NDArray[np.float32],
) -> NDArray[np.int32]:
    """Return where the texels ``(n,)`` lie in an array of all levels of all textures, one after another.

    Args:
        side: ``(textures,)`` metres after which each repeats.
        texture: this and the rest as of ``TextureLibrary.sample``.
        u: see there.
        v: see there.
        footprint: see there.
    """
    density = (SIZE / side)[texture]
    # The exponent of the footprint in texels is the level whose texels are as large as the pixel.
    level = np.frexp(footprint * density)[1].clip(0, LEVELS - 1)
    column = np.floor(u * density).astype(np.int32) & (SIZE - 1)
    row = np.floor(v * density).astype(np.int32) & (SIZE - 1)
    start = texture * _LEVEL_START[-1] + _LEVEL_START[level]
    index: NDArray[np.int32] = start + ((row >> level) << (LEVELS - 1 - level)) + (column >> level)
    return index


_LEVEL_START = np.concatenate([[0], np.cumsum([(SIZE >> level) ** 2 for level in range(LEVELS)])]).astype(
    np.int32
)


@lru_cache(maxsize=3)
def texture_library(draw: int = 0) -> TextureLibrary:
    """Return one of any number of draws of all textures, the same in every process."""
    rng = np.random.default_rng([_SEED, draw] if draw else _SEED)
    texels: list[NDArray[np.float32]] = []
    for name in _NAMES:
        image = _draw(name, rng).clip(0.0, 1.0).astype(np.float32)
        for _ in range(LEVELS):
            texels.append(image.ravel())
            half = image.shape[0] // 2
            image = image.reshape(half, 2, half, 2).mean(axis=(1, 3)) if half else image
    return TextureLibrary(np.concatenate(texels), np.array(list(TEXTURES.values()), dtype=np.float32))


def value_noise(rng: np.random.Generator, cells: tuple[int, int]) -> NDArray[np.float64]:
    """Return ``(SIZE, SIZE)`` periodic noise: random values on a lattice, smoothly interpolated."""
    lattice = rng.random(cells)
    result = lattice
    for axis, count in enumerate(cells):
        position = np.arange(SIZE) * count / SIZE
        index = np.floor(position).astype(int)
        weight = position - index
        weight = weight * weight * (3 - 2 * weight)
        weight = weight[:, None] if axis == 0 else weight[None, :]
        low, high = np.take(result, index, axis=axis), np.take(result, (index + 1) % count, axis=axis)
        result = low + (high - low) * weight
    return result


def cloud(rng: np.random.Generator, cells: int, octaves: int) -> NDArray[np.float64]:
    """Return ``(SIZE, SIZE)`` noise of several octaves, each half as strong as the one before."""
    parts = [value_noise(rng, (cells << i, cells << i)) * 0.5**i for i in range(octaves)]
    return sum(parts, np.zeros(())) / (2 - 0.5 ** (octaves - 1))


def grain(rng: np.random.Generator) -> NDArray[np.float64]:
    """Return ``(SIZE, SIZE)`` wood grain: noise stretched along u, bent by a slow cloud."""
    bent = cloud(rng, 3, 2) * 10 + value_noise(rng, (64, 2)) * 1.5
    return (
        0.5
        + 0.3 * np.sin(2 * np.pi * bent) * value_noise(rng, (16, 4))
        + 0.35 * (value_noise(rng, (256, 8)) - 0.5)
    )


def blocks(
    rng: np.random.Generator, rows: int, columns: int, shift: float, gap: float
) -> NDArray[np.float64]:
    """Return ``(SIZE, SIZE)``: staggered grey blocks with dark joints of ``gap`` of a row's height."""
    v, u = np.meshgrid(np.arange(SIZE) * rows / SIZE, np.arange(SIZE) * columns / SIZE, indexing="ij")
    row = v.astype(int)
    u = u + row * shift
    shade = rng.random((rows, columns))[row, u.astype(int) % columns]
    joint = (v % 1 < gap) | (u % 1 < gap * columns / rows)
    return np.where(joint, 0.0, 0.35 + 0.65 * shade)


def _draw(name: str, rng: np.random.Generator) -> NDArray[np.float64]:
    if name == "plaster":
        return 0.7 * cloud(rng, 8, 4) + 0.3 * rng.random((SIZE, SIZE))
    if name == "stripes":
        wave = (np.arange(SIZE) * 8 // SIZE) % 2
        return 0.15 + 0.7 * np.tile(wave, (SIZE, 1)) + 0.15 * cloud(rng, 16, 2)
    if name == "planks":
        return 0.6 * blocks(rng, 16, 2, 0.5, 0.04) + 0.5 * grain(rng) - 0.1
    if name == "parquet":
        return 0.6 * blocks(rng, 16, 4, 0.5, 0.05) + 0.4 * grain(rng)
    if name == "tiles":
        return 0.75 * blocks(rng, 4, 4, 0.0, 0.03) ** 0.4 + 0.25 * cloud(rng, 8, 4)
    if name == "carpet":
        return 0.5 * rng.random((SIZE, SIZE)) + 0.5 * cloud(rng, 16, 4)
    if name == "wood":
        return grain(rng)
    if name == "fabric":
        weave = np.sin(np.arange(SIZE) * 2 * np.pi * 64 / SIZE)
        return 0.5 + 0.2 * weave[:, None] * weave[None, :] + 0.4 * (cloud(rng, 16, 3) - 0.5)
    if name == "sky":
        return 0.6 + 0.8 * (cloud(rng, 3, 4) - 0.5)
    if name == "picture":
        return np.floor(cloud(rng, 4, 3) * 6) / 5
    return np.ones((SIZE, SIZE))


def tinted(hue: float, saturation: float, value: float, contrast: float, texture: str) -> Paint:
    """Return a paint around one colour.

    Args:
        hue: in [0, 1].
        saturation: in [0, 1].
        value: brightness in [0, 1] where the texture is 1.
        contrast: share of the brightness that is lost where the texture is 0.
        texture: name in ``TEXTURES``.
    """
    light = colorsys.hsv_to_rgb(hue % 1.0, saturation, value)
    dark = colorsys.hsv_to_rgb(hue % 1.0, min(1.0, saturation * 1.15), value * (1 - contrast))
    return Paint(dark=dark, light=light, texture=texture_index(texture))


def wall_paint(rng: np.random.Generator) -> Paint:
    """Draw a wall: painted plaster or striped wallpaper, bright and little saturated."""
    texture = "stripes" if rng.random() < 0.2 else "plaster"
    contrast = rng.uniform(0.06, 0.2) if texture == "stripes" else rng.uniform(0.03, 0.12)
    saturation = rng.uniform(0.1, 0.35) if rng.random() < 0.35 else rng.uniform(0.0, 0.08)
    return tinted(rng.random(), saturation, rng.uniform(0.75, 0.96), contrast, texture)


def floor_paint(rng: np.random.Generator, *, wet: bool) -> Paint:
    """Draw a floor: wood, tiles or carpet; always tiles in a wet room."""
    texture = (
        "tiles" if wet else str(rng.choice(["planks", "parquet", "carpet", "tiles"], p=[0.4, 0.2, 0.3, 0.1]))
    )
    if texture in ("planks", "parquet"):
        return tinted(rng.uniform(0.05, 0.1), rng.uniform(0.3, 0.6), rng.uniform(0.4, 0.8), 0.45, texture)
    contrast = 0.35 if texture == "tiles" else 0.3
    colorful = texture == "carpet" and rng.random() < 0.4
    saturation = rng.uniform(0.1, 0.35) if colorful else rng.uniform(0.0, 0.1)
    return tinted(rng.random(), saturation, rng.uniform(0.35, 0.85), contrast, texture)
