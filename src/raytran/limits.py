# SPDX-License-Identifier: Apache-2.0
"""What numbers in files and settings can mean: the one place that bounds them, used by all readers.

A file from elsewhere may hold anything: text where a number belongs, a number of a thousand digits, infinity,
a box that is wider than a galaxy. Whatever goes on to be computed with passes through here first.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from raytran.errors import DataError, RaytranError

MAX_SIDE = 8192
"""Most pixels along a side of an image that is decoded: a few bytes can claim any number."""

MAX_VIEWS = 100_000
"""Most frames of a scan, or views that a network is given."""

MAX_STEPS = 10**9
"""Most steps of a training."""

_SHOWN = 40
"""Characters of a wrong value that a message shows."""


class Quantity(NamedTuple):
    """What a number measures, and between which bounds it can lie.

    Attributes:
        name: what to call it in messages, with its unit.
        low: least value.
        high: largest value.
    """

    name: str
    low: float
    high: float


POSITION = Quantity("a position", -1e6, 1e6)
"""Coordinate in a world, in its unit. In millimetres that is a kilometre; positions on the globe, of millions
of metres, would lose their centimetres in float32."""

COORDINATE = Quantity("a coordinate of a mesh", -1e9, 1e9)
"""In the unit of its file, which may be a micrometre."""

VOXEL_CUBE = Quantity("a side of a cube of voxels", 1e-12, 1e9)

HALF_EXTENT = Quantity("half a length of a box", 0, 1e4)
"""Of a CAD model's box, in its unit; a flat sheet has none along one axis."""

QUATERNION = Quantity("a part of a quaternion", -1e6, 1e6)
"""Of any length: the evaluation scripts take them as they are."""

CAD_SCALE = Quantity("a scale of a CAD model", -1e4, 1e4)
"""As annotated: negative for a mirrored model, almost 0 for one that is left out."""

BOX_SIDE = Quantity("a length in metres", 1e-6, 1e4)
"""Side of an object's box."""

MATRIX_ENTRY = Quantity("an entry of a transformation", -1e6, 1e6)
"""Entry of a matrix that rotates, scales and shifts."""

SCALE = Quantity("a positive scale", 1e-6, 1e6)
"""Factor between two units, or of a predicted CAD model."""

SCORE = Quantity("a score", -1e6, 1e6)
"""Confidence; only its order counts, and programs write logits too."""

SHARE = Quantity("a share", 0, 1)
LOG_ODDS = Quantity("a logarithm of odds", -1e3, 1e3)
FOCAL_LENGTH = Quantity("a focal length in pixels", 1e-2, 1e7)
PIXEL = Quantity("a pixel coordinate", -1e6, 1e6)
SIDE = Quantity("a number of pixels", 1, MAX_SIDE)
DISTORTION = Quantity("a coefficient of a lens", -1e6, 1e6)
ANGLE = Quantity("an angle in radians", -1e4, 1e4)
SECONDS = Quantity("a time in seconds", -1e11, 1e11)
TIMESTAMP = Quantity("a time stamp", -1e20, 1e20)
"""Time since any moment in seconds, or in milli-, micro- or nanoseconds since 1970."""


def as_number(
    value: object, quantity: Quantity, what: str, *, error: type[RaytranError] = DataError
) -> float:
    """Return a value that is a number within the bounds of what it measures.

    Args:
        value: what a file or setting holds, of any type.
        quantity: what it measures.
        what: name of the value and its place, e.g. ``fx in cameras.json``.
        error: what to raise.

    Raises:
        DataError: it is no number, not finite, or out of bounds.
    """
    number = _as_float(value)
    if not quantity.low <= number <= quantity.high:  # also if it is not a number
        raise error(
            f"{what} is {shown(value)}, not {quantity.name} of {quantity.low:g} to {quantity.high:g}: mend it"
        )
    return number


def as_count(value: object, low: int, high: int, what: str, *, error: type[RaytranError] = DataError) -> int:
    """Return a value that is a whole number from ``low`` to ``high``; 4.0 is one, 4.5, "4" and True are none.

    Raises:
        DataError: it is none, or out of bounds.
    """
    number = _as_float(value)
    if not (low <= number <= high and number == int(number)):
        raise error(f"{what} is {shown(value)}, not a whole number from {low} to {high}: mend it")
    return int(number)


def as_numbers(
    value: object, shape: tuple[int, ...], quantity: Quantity, what: str, *, lost: bool = False
) -> NDArray[np.float64]:
    """Return nested lists of numbers as an array, each within the bounds of what it measures.

    Args:
        value: what a file holds, of any type.
        shape: of the array, -1 for any size; a flat list of as many numbers will do.
        quantity: what each number measures.
        what: name of the value and its place.
        lost: numbers that are not finite or out of bounds become NaN instead of an error: programs write
            them where tracking was lost, and one lost frame does not spoil the others.

    Raises:
        DataError: it does not hold so many numbers, or one is out of bounds.
    """
    try:
        given = np.array(value)
        if given.dtype.kind not in "iuf":  # numpy takes "1", None and True for numbers if asked for some
            raise TypeError
        array = given.astype(np.float64).reshape(shape)
    except (TypeError, ValueError, OverflowError) as error:
        size = "x".join("n" if side == -1 else str(side) for side in shape)
        raise DataError(f"{what} does not hold {size} numbers: mend it") from error
    within = (array >= quantity.low) & (array <= quantity.high)
    if lost:
        return np.where(within, array, np.nan)
    if not within.all():
        raise DataError(
            f"{what} holds {array[~within][0]:g}, not {quantity.name} of {quantity.low:g} to "
            f"{quantity.high:g}: mend it"
        )
    return array


def shown(value: object) -> str:
    """Return a value as a message shows it: in one line, and no longer than a line can be."""
    if isinstance(value, int) and not -1e30 < value < 1e30:
        return "a whole number of more than 30 digits"
    # The text alone may be huge: no more of it is made than is shown.
    text = repr(value[:_SHOWN] if isinstance(value, str | bytes | list | tuple) else value)
    return text if len(text) <= _SHOWN else text[: _SHOWN - 1] + "…"


def _as_float(value: Any) -> float:
    """Return a number as a float, and not-a-number for everything else."""
    if isinstance(value, bool | np.bool_) or not isinstance(value, int | float | np.number):
        return math.nan
    try:
        return float(value)
    except (OverflowError, TypeError):
        return math.nan
