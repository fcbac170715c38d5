# SPDX-License-Identifier: Apache-2.0
"""Paints of rooms that look like the world: floors, walls, trims, furniture; each draw is another one."""

from __future__ import annotations

import colorsys

import numpy as np
from numpy.typing import ArrayLike, NDArray

from raytran.rooms.materials import Paint
from raytran.rooms.objects import PlacedObject
from raytran.rooms.textures import photo_index

Color = tuple[float, float, float]

WOODS = ("wood", "oak", "walnut", "planks")
CLOTHS = ("weave", "weave", "corduroy", "tweed", "leather", "plain")
COLORFUL_CLOTHS = ("tartan", "floral", "floral 2", "bands")
PICTURES = ("photo", "photo 2", "poster", "poster 2", "face", "street", "text", "persian 2")

_FLOORS: dict[str, float] = {
    "planks": 0.17,
    "old planks": 0.12,
    "parquet": 0.08,
    "herringbone": 0.06,
    "oak": 0.04,
    "carpet": 0.18,
    "carpet tiles": 0.1,
    "tiles": 0.08,
    "checkered tiles": 0.03,
    "terrazzo": 0.03,
    "granite": 0.03,
    "marble": 0.02,
    "concrete": 0.04,
    "plain": 0.02,
}
_WET_FLOORS = ("tiles", "checkered tiles", "mosaic", "terrazzo", "granite", "marble")
_WALLS: dict[str, float] = {
    "plaster": 0.42,
    "plain": 0.2,
    "roughcast": 0.1,
    "concrete": 0.05,
    "brick": 0.05,
    "stone wall": 0.01,
    "stripes": 0.03,
    "damask": 0.03,
    "floral": 0.02,
    "diamonds": 0.01,
    "oak": 0.03,
    "grooves": 0.02,
    "subway tiles": 0.02,
    "dots": 0.01,
}
_OWN_COLORS = frozenset(
    {
        *("terrazzo", "floral", "floral 2", "mosaic", "persian", "persian 2", "bands", "tartan", "leaves"),
        *("photo", "photo 2", "street", "poster", "poster 2", "face", "books", "screen", "text"),
    }
)
"""Textures in colour: the paint only makes them brighter or darker."""


def hsv(hue: float, saturation: float, value: float) -> Color:
    """Return a display colour; ``value`` may be above 1 for what shines."""
    red, green, blue = colorsys.hsv_to_rgb(hue % 1.0, min(saturation, 1.0), 1.0)
    return red * value, green * value, blue * value


def finish(
    rng: np.random.Generator,
    texture: str,
    color: ArrayLike,
    contrast: float,
    *,
    scale: float | None = None,
    emissive: bool = False,
    turned: bool | None = None,
) -> Paint:
    """Return a paint of one texture at a random place of it.

    Args:
        rng: source of all choices.
        texture: name in ``raytran.rooms.textures``.
        color: display RGB where the texture is 1.
        contrast: share of the brightness that is lost where it is 0; 1 where the texture has colours.
        scale: of the texture; None draws one.
        emissive: whether it shines, then with the linear brightness ``color ** 2``.
        turned: whether the texture lies across; None draws it.
    """
    red, green, blue = (float(channel) for channel in np.asarray(color, dtype=np.float64))
    left = 0.0 if texture in _OWN_COLORS else 1 - contrast
    return Paint(
        dark=(red * left, green * left, blue * left),
        light=(red, green, blue),
        texture=photo_index(texture),
        emissive=emissive,
        scale=float(rng.uniform(0.7, 1.5)) if scale is None else scale,
        turned=bool(rng.random() < 0.5) if turned is None else turned,
        shift=(float(rng.random()), float(rng.random())),
    )


def tone(
    rng: np.random.Generator, *, colorful: float = 0.3, value: tuple[float, float] = (0.1, 0.95)
) -> Color:
    """Draw a colour, with a probability of ``colorful`` a saturated one; most are warm or blue."""
    bright = rng.uniform(*value)
    if rng.random() >= colorful:
        return hsv(rng.choice([0.09, 0.09, 0.6]) + rng.normal(0, 0.04), rng.uniform(0.0, 0.2), bright)
    usual = rng.random() < 0.7
    hue = rng.choice([0.02, 0.08, 0.12, 0.58, 0.62]) + rng.normal(0, 0.03) if usual else rng.random()
    return hsv(hue, min(rng.beta(2.0, 2.5), 0.9) * (1.1 - 0.4 * bright), bright)


def wood_tone(rng: np.random.Generator) -> Color:
    """Draw the colour of a wood, from birch to nearly black."""
    return hsv(rng.uniform(0.04, 0.12), rng.uniform(0.15, 0.75), rng.uniform(0.2, 0.95))


def floor_finish(rng: np.random.Generator, *, wet: bool) -> Paint:
    """Draw a floor."""
    names = list(_FLOORS)
    texture = str(rng.choice(_WET_FLOORS)) if wet else str(rng.choice(names, p=_shares(_FLOORS)))
    if texture in ("planks", "old planks", "parquet", "herringbone", "oak"):
        color = wood_tone(rng) if rng.random() < 0.85 else tone(rng, colorful=0.0, value=(0.3, 0.8))
        return finish(rng, texture, color, rng.uniform(0.2, 0.75))
    if texture == "terrazzo" or texture == "mosaic":
        return finish(rng, texture, (0.9, 0.9, 0.9), 1.0)
    colorful = 0.5 if "carpet" in texture else 0.2
    return finish(rng, texture, tone(rng, colorful=colorful, value=(0.2, 0.9)), rng.uniform(0.2, 0.6))


def wall_finish(rng: np.random.Generator) -> Paint:
    """Draw a wall: most often painted in a light colour, seldom strong or dark, papered, of brick or wood."""
    texture = str(rng.choice(list(_WALLS), p=_shares(_WALLS)))
    if texture in _OWN_COLORS:
        return finish(rng, texture, (0.85, 0.85, 0.85), 1.0, turned=False)
    if texture in ("brick", "oak", "stone wall") and rng.random() < 0.7:
        color = hsv(rng.uniform(0.0, 0.1), rng.uniform(0.2, 0.7), rng.uniform(0.35, 0.8))
        return finish(rng, texture, color, rng.uniform(0.3, 0.6), turned=False)
    bright = rng.random() < 0.75
    color = tone(rng, colorful=0.12 if bright else 0.6, value=(0.7, 0.97) if bright else (0.15, 0.75))
    patterned = texture in ("stripes", "damask", "diamonds", "dots", "brick", "grooves")
    return finish(
        rng, texture, color, rng.uniform(0.08, 0.45) if patterned else rng.uniform(0.03, 0.18), turned=False
    )


def trim_finish(rng: np.random.Generator) -> Paint:
    """Draw skirtings and frames: white, wood, grey or black."""
    if rng.random() < 0.5:
        return finish(rng, "plain", (0.92, 0.92, 0.9), 0.1)
    if rng.random() < 0.5:
        return finish(rng, str(rng.choice(WOODS[:3])), wood_tone(rng), 0.4)
    return finish(rng, "plain", tone(rng, colorful=0.1, value=(0.04, 0.7)), 0.2)


def board_finish(rng: np.random.Generator) -> Paint:
    """Draw fronts of doors and cupboards."""
    if rng.random() < 0.45:
        return finish(rng, str(rng.choice(WOODS[:3])), wood_tone(rng), rng.uniform(0.2, 0.6))
    return finish(rng, "plain", tone(rng, colorful=0.2, value=(0.05, 0.95)), 0.15)


def cloth_finish(rng: np.random.Generator, color: ArrayLike | None = None) -> Paint:
    """Draw a cloth: of one colour, or with a pattern."""
    if rng.random() < 0.18:
        value = rng.uniform(0.6, 1.0)
        return finish(rng, str(rng.choice(COLORFUL_CLOTHS)), (value, value, value), 1.0)
    chosen = tone(rng, colorful=0.5, value=(0.06, 0.9)) if color is None else color
    return finish(rng, str(rng.choice(CLOTHS)), chosen, rng.uniform(0.15, 0.55))


def picture_finish(rng: np.random.Generator, *, bright: float = 1.0, emissive: bool = False) -> Paint:
    """Draw a picture, poster or sheet of text, anywhere in its motif."""
    value = bright * rng.uniform(0.7, 1.0)
    return finish(rng, str(rng.choice(PICTURES)), (value, value, value), 1.0, emissive=emissive, turned=False)


def rug_finish(rng: np.random.Generator) -> Paint:
    """Draw a rug: woven patterns, stripes, fur, or plain."""
    texture = str(
        rng.choice(["persian", "persian 2", "bands", "tartan", "floral", "carpet", "tweed", "diamonds"])
    )
    if texture in _OWN_COLORS:
        value = rng.uniform(0.5, 1.0)
        return finish(rng, texture, (value, value, value), 1.0)
    return finish(rng, texture, tone(rng, colorful=0.6, value=(0.15, 0.95)), rng.uniform(0.2, 0.7))


def object_finish(placed: PlacedObject, rng: np.random.Generator) -> list[Paint]:
    """Draw a paint for each material of an object.

    Half of the time its colours are kept, else each material gets another one. Given and generated models
    are treated alike.
    """
    model = placed.model
    recolored = rng.random() < 0.5
    soft = model.category == "sofa" or model.kind in ("armchair", "bed", "pillow")
    seat = model.category == "chair" and not soft
    screen_on = model.category == "display" and rng.random() < 0.45
    paints = []
    main = None
    for group in range(int(model.face_group.max()) + 1):
        faces = model.face_group == group
        color = model.face_color[faces][0] if faces.any() else np.ones(3)
        hue, saturation, value = colorsys.rgb_to_hsv(*np.clip(color, 0, 1))
        if model.category == "display" and value < 0.06:
            paints.append(_screen(rng) if screen_on else finish(rng, "plain", color + 0.03, 0.3))
            continue
        wooden = saturation > 0.2 and 0.02 < hue < 0.15 and not soft
        if recolored:
            if wooden:
                color = np.array(wood_tone(rng))
            elif main is None or rng.random() < 0.4:
                color = np.array(tone(rng, colorful=0.4, value=(0.04, 0.95)))
                main = color
            else:
                color = main * rng.uniform(0.6, 1.2)
        color = np.clip(color * rng.uniform(0.8, 1.15), 0.02, 1.0)
        paints.append(_surface(rng, color, wooden=wooden, soft=soft, seat=seat))
    return paints


def _surface(
    rng: np.random.Generator, color: NDArray[np.float64], *, wooden: bool, soft: bool, seat: bool
) -> Paint:
    """Draw the paint of one material of a piece of furniture."""
    if wooden:
        return finish(rng, str(rng.choice(WOODS)), color, rng.uniform(0.15, 0.6))
    if soft or (seat and rng.random() < 0.5):
        return cloth_finish(rng, color)
    if seat and rng.random() < 0.25:
        return finish(rng, "mesh", color, 0.5)
    drawn = rng.random()
    if drawn < 0.08:
        texture = str(rng.choice(["marble", "granite", "concrete", "chipboard"]))
        return finish(rng, texture, color, rng.uniform(0.15, 0.5))
    if drawn < 0.3:
        return finish(rng, "brushed", color, rng.uniform(0.1, 0.35))
    return finish(rng, "plain" if drawn < 0.7 else "plaster", color, rng.uniform(0.05, 0.25))


def _screen(rng: np.random.Generator) -> Paint:
    value = float(np.sqrt(rng.uniform(0.1, 0.9)))
    texture = str(rng.choice(["screen", "screen", "text", "photo", "poster"]))
    return finish(rng, texture, (value, value, value), 1.0, emissive=True, turned=False)


def clutter_finish(placed: PlacedObject, rng: np.random.Generator) -> list[Paint]:
    """Draw a paint for each material of a thing that is not annotated."""
    model = placed.model
    paints = []
    for group in range(int(model.face_group.max()) + 1):
        color = model.face_color[model.face_group == group][0]
        if model.kind in ("person", "clothes", "coat stand", "backpack", "drying rack", "bean bag"):
            paints.append(cloth_finish(rng, color))
        elif model.kind in ("papers", "books", "carrier bag") and rng.random() < 0.35:
            paints.append(picture_finish(rng))
        elif model.kind == "carrier bag" or (model.kind == "crate" and rng.random() < 0.3):
            paints.append(finish(rng, "crumpled", color, 0.5))
        elif "plant" in model.kind and color[1] > color[0]:
            paints.append(finish(rng, "leaves" if rng.random() < 0.3 else "plain", color, 0.6))
        else:
            paints.append(_surface(rng, color, wooden=False, soft=False, seat=False))
    return paints


def _shares(table: dict[str, float]) -> NDArray[np.float64]:
    values = np.array(list(table.values()))
    return np.asarray(values / values.sum())
