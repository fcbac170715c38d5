# SPDX-License-Identifier: Apache-2.0
"""Kinds of furniture: class, ShapeNet's synset, where a piece stands, and how large it is.

ShapeNet's models are scaled to one size and tell neither their kind nor their real size: both are guessed.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from raytran.classes import SCAN2CAD_CLASS_BY_CATID

CATID_BY_CLASS = {name: catid for catid, name in SCAN2CAD_CLASS_BY_CATID.items()}
"""ShapeNet's synset of every class but ``other``."""


@dataclass(frozen=True)
class Kind:
    """What all pieces of one kind have in common.

    Attributes:
        category: one of the paper's classes.
        catid: ShapeNet's synset.
        support: where it stands (see ``CadModel.support``).
    """

    category: str
    catid: str
    support: str


def _of(category: str, **support: str) -> dict[str, Kind]:
    """Return kinds of a class that has its own synset, given as ``name=support``, ``_`` for a space."""
    catid = CATID_BY_CLASS[category]
    return {name.replace("_", " "): Kind(category, catid, where) for name, where in support.items()}


KINDS: dict[str, Kind] = {
    **_of("bathtub", bathtub="wall"),
    **_of("bookshelf", bookshelf="wall"),
    **_of("cabinet", cabinet="wall", chest_of_drawers="wall", night_stand="wall", sideboard="wall"),
    **_of("cabinet", tv_cabinet="wall", wardrobe="wall"),
    **_of("chair", armchair="floor", armed_chair="floor", dining_chair="floor", office_chair="floor"),
    **_of("chair", child_chair="floor", floor_chair="floor", high_chair="floor", school_chair="floor"),
    **_of("chair", stool="floor"),
    **_of("display", monitor="table", television="table"),
    **_of("sofa", sofa="wall", corner_sofa="wall"),
    **_of("table", bar_table="floor", coffee_table="floor", dining_table="floor", desk="floor"),
    **_of("table", child_table="floor", dressing_table="wall", workbench="wall"),
    **_of("trashbin", bin="floor"),
    "basket": Kind("other", "02801938", "floor"),
    "bed": Kind("other", "02818832", "wall"),
    "bench": Kind("other", "02828884", "wall"),
    "bunk bed": Kind("other", "02818832", "wall"),
    "crib": Kind("other", "02818832", "wall"),
    "file cabinet": Kind("other", "03337140", "wall"),
    "floor lamp": Kind("other", "03636649", "floor"),
    "flowerpot": Kind("other", "03991062", "floor"),
    "laptop": Kind("other", "03642806", "table"),
    "microwave": Kind("other", "03761084", "table"),
    "piano": Kind("other", "03928116", "wall"),
    "pillow": Kind("other", "03938244", "bed"),
    "printer": Kind("other", "04004475", "table"),
    "speaker": Kind("other", "03691459", "floor"),
    "stove": Kind("other", "04330267", "wall"),
    "table lamp": Kind("other", "03636649", "table"),
    "washing machine": Kind("other", "04554684", "wall"),
}
"""Kinds by name, as ``furnish`` asks for them."""

_HIGHEST, _LONGEST = 2.2, 2.6
"""No piece is given a larger size, metres."""


@dataclass(frozen=True)
class _Guess:
    """A kind, for models whose proportions fit, and how large such a piece is.

    Attributes:
        kind: name in ``KINDS``.
        side: ``width``, ``height`` or ``length``, the longer of width and depth.
        between: least and greatest length of that side, metres.
        fits: whether a model of ``width, height, depth`` can be of the kind.
    """

    kind: str
    side: str
    between: tuple[float, float]
    fits: Callable[[float, float, float], bool] = lambda width, height, depth: True


# The first that fits is taken; several with the same condition share the models among them.
_GUESSES: dict[str, tuple[_Guess, ...]] = {
    "bathtub": (_Guess("bathtub", "length", (1.45, 1.8)),),
    "bookshelf": (_Guess("bookshelf", "height", (0.9, 2.1)),),
    "cabinet": (
        _Guess("wardrobe", "height", (1.6, 2.1), lambda w, h, d: h > 1.4 * w),
        _Guess("tv cabinet", "height", (0.4, 0.65), lambda w, h, d: w > 2.0 * h),
        _Guess("sideboard", "height", (0.7, 0.95), lambda w, h, d: w > 1.25 * h),
        _Guess("night stand", "height", (0.45, 0.65), lambda w, h, d: d > 0.75 * w),
        _Guess("chest of drawers", "height", (0.75, 1.2)),
    ),
    "chair": (
        _Guess("stool", "height", (0.42, 0.75), lambda w, h, d: h < 1.05 * max(w, d)),
        _Guess("dining chair", "height", (0.78, 1.05)),
    ),
    "display": (
        _Guess("television", "width", (0.75, 1.15), lambda w, h, d: w > 1.6 * h),
        _Guess("monitor", "width", (0.4, 0.6)),
    ),
    "sofa": (
        _Guess("corner sofa", "width", (2.0, 2.6), lambda w, h, d: d > 0.6 * w and w > 2.0 * h),
        _Guess("sofa", "width", (1.4, 2.3)),
    ),
    "table": (
        _Guess("coffee table", "height", (0.36, 0.5), lambda w, h, d: h < 0.42 * max(w, d)),
        _Guess("desk", "height", (0.7, 0.78), lambda w, h, d: w > 1.6 * d),
        _Guess("dining table", "height", (0.7, 0.78)),
    ),
    "trashbin": (_Guess("bin", "height", (0.3, 0.8)),),
    "02801938": (_Guess("basket", "height", (0.25, 0.5)),),
    "02818832": (_Guess("bed", "length", (1.9, 2.15)),),
    "02828884": (_Guess("bench", "length", (1.0, 1.5)),),
    "03337140": (_Guess("file cabinet", "height", (0.6, 1.3)),),
    "03636649": (
        _Guess("floor lamp", "height", (1.35, 1.8), lambda w, h, d: h > 2.5 * max(w, d)),
        _Guess("table lamp", "height", (0.35, 0.6)),
    ),
    "03642806": (_Guess("laptop", "width", (0.3, 0.38)),),
    "03691459": (_Guess("speaker", "height", (0.3, 1.0)),),
    "03761084": (_Guess("microwave", "width", (0.45, 0.55)),),
    "03928116": (_Guess("piano", "width", (1.35, 1.5)),),
    "03938244": (_Guess("pillow", "length", (0.4, 0.6)),),
    "03991062": (_Guess("flowerpot", "height", (0.25, 0.9)),),
    "04004475": (_Guess("printer", "width", (0.38, 0.5)),),
    "04330267": (_Guess("stove", "height", (0.85, 0.95)),),
    "04554684": (_Guess("washing machine", "height", (0.85, 0.95)),),
}

KNOWN_CATIDS = (*SCAN2CAD_CLASS_BY_CATID, *(name for name in _GUESSES if name.isdigit()))
"""ShapeNet's synsets that rooms are furnished from."""


def guess_kind(catid: str, extent: Sequence[float]) -> str:
    """Return the kind of furniture that a model's proportions suggest.

    Args:
        catid: one of ``KNOWN_CATIDS``.
        extent: width (x), height (y) and depth (z) in any unit.
    """
    return _guess(catid, extent).kind


def draw_size(catid: str, extent: ArrayLike, rng: np.random.Generator) -> NDArray[np.float64]:
    """Draw a plausible real size ``(3,)`` in metres with the proportions of ``extent``."""
    sides = np.asarray(extent, dtype=np.float64)
    guess = _guess(catid, sides.tolist())
    width, height, depth = sides
    side = {"width": width, "height": height, "length": max(width, depth)}[guess.side]
    size: NDArray[np.float64] = sides * (rng.uniform(*guess.between) / side)
    return size * min(1.0, _HIGHEST / size[1], _LONGEST / size.max())


def _guess(catid: str, extent: Sequence[float]) -> _Guess:
    guesses = _GUESSES[SCAN2CAD_CLASS_BY_CATID.get(catid, catid)]
    return next(guess for guess in guesses if guess.fits(extent[0], extent[1], extent[2]))
