# SPDX-License-Identifier: Apache-2.0
"""JSON files of strangers: read with a bound, asked for numbers and lists."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from raytran.errors import DataError

_MAX_BYTES = 64 * 2**20


def read_object(path: Path) -> dict[str, Any]:
    """Return the object that a JSON file holds.

    Raises:
        DataError: the file cannot be read, is larger than 64 MB, or holds no JSON object.
    """
    try:
        if path.stat().st_size > _MAX_BYTES:
            raise DataError(f"{path} is larger than 64 MB, as no list of frames is: check the path")
        content = json.loads(path.read_text(encoding="utf-8-sig"))
    except OSError as error:
        raise DataError(f"cannot read {path} ({error.strerror}): check the path") from error
    except (ValueError, RecursionError) as error:
        raise DataError(f"{path} is no valid JSON ({error}): export it again") from error
    if not isinstance(content, dict):
        raise DataError(f"{path} holds a {type(content).__name__}, not a JSON object: export it again")
    return content


def number(content: Mapping[str, Any], key: str, where: str, default: float | None = None) -> float:
    """Return a finite number.

    Args:
        content: where it is looked up.
        key: its name.
        where: what to name in the message.
        default: value if it is missing; None: it must be there.

    Raises:
        DataError: it is missing or no finite number.
    """
    value = content.get(key, default)
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        state = f"has {key} = {str(value)[:50]!r}" if key in content else f"has no {key}"
        raise DataError(f"{where} {state} where a number is needed: export it again")
    return float(value)


def numbers(content: Mapping[str, Any], key: str, where: str, shape: tuple[int, ...]) -> NDArray[np.float64]:
    """Return an array; it may hold numbers that are not finite.

    Args:
        content: where it is looked up.
        key: its name.
        where: what to name in the message.
        shape: of the array; flat lists of as many numbers will do.

    Raises:
        DataError: it is missing or of another size.
    """
    try:
        return np.array(content[key], dtype=np.float64).reshape(shape)
    except (KeyError, TypeError, ValueError) as error:
        size = "x".join(map(str, shape))
        raise DataError(f"{where} has no {key} of {size} numbers: export it again") from error
