# SPDX-License-Identifier: Apache-2.0
"""Reads text, tables of numbers and JSON out of files that anybody may have written.

What every program of the field writes is read: byte order marks, Windows' line ends, UTF-16 of PowerShell,
commas for blanks. What no program writes ends in one sentence, and takes neither long nor much memory.
"""

from __future__ import annotations

import codecs
import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from raytran.errors import DataError

MAX_BYTES = 64 * 2**20
"""Bytes of a text file that are read: lists of a hundred thousand frames are smaller."""

_WIDE_MARKS = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)


def read_text(path: Path, *, max_bytes: int = MAX_BYTES) -> str:
    """Return the text of a file in UTF-8, or in UTF-16 with a byte order mark; the mark is left out.

    Raises:
        DataError: the file cannot be read, is larger than ``max_bytes``, or is no text.
    """
    try:
        # Read up to the limit rather than asked for its size: a device or a pipe has none.
        with path.open("rb") as file:
            content = file.read(max_bytes + 1)
    except OSError as error:
        raise DataError(f"cannot read {path} ({error.strerror}): check the path") from error
    except ValueError as error:  # a NUL in the name
        raise DataError(f"cannot read {path!r} ({error}): check the path") from error
    if len(content) > max_bytes:
        raise DataError(f"{path} is larger than {max_bytes / 2**20:g} MB, as no such file is: check the path")
    try:
        return content.decode("utf-16" if content.startswith(_WIDE_MARKS) else "utf-8-sig")
    except UnicodeDecodeError as error:
        raise DataError(f"{path} is no text in UTF-8 ({error.reason}): check the path") from error


def read_table(path: Path, *, max_bytes: int = MAX_BYTES) -> NDArray[np.float64]:
    """Return the numbers in a text file, one row a line; ``#`` starts a comment.

    Numbers are parted by blanks, commas or semicolons.

    Returns:
        ``(rows, columns)`` float64, ``(0,)`` if there are none; they may not be finite.

    Raises:
        DataError: the file cannot be read, see ``read_text``, or its lines hold no numbers or not as many
            each.
    """
    lines = read_text(path, max_bytes=max_bytes).splitlines()
    rows = [parted(line) for line in lines]
    try:
        return np.array([[float(word) for word in row] for row in rows if row], dtype=np.float64)
    except ValueError as error:
        number = next(i for i, row in enumerate(rows, 1) if row and not _is_like(row, rows))
        raise DataError(
            f"line {number} of {path} does not hold numbers, as many as the other lines do: mend it"
        ) from error


def parted(line: str) -> list[str]:
    """Return the words of a line that are parted by blanks, commas or semicolons, without a comment."""
    return line.partition("#")[0].translate(_PARTED).split()


_PARTED = str.maketrans(",;", "  ")


def _is_like(row: list[str], rows: list[list[str]]) -> bool:
    """Whether a row holds numbers, as many as the first."""
    try:
        return len([float(word) for word in row]) == len(next(other for other in rows if other))
    except ValueError:
        return False


def read_json(path: Path, *, max_bytes: int = MAX_BYTES) -> Any:
    """Return what a JSON file holds; whole numbers of more than 18 digits are floats, infinite if need be.

    Raises:
        DataError: the file cannot be read, see ``read_text``; it is no JSON, is nested too deeply, or holds
            text that no file name or message can hold.
    """
    text = read_text(path, max_bytes=max_bytes)
    try:
        content = json.loads(text, parse_int=_as_whole)
    except (ValueError, RecursionError) as error:
        raise DataError(f"{path} is no valid JSON ({str(error)[:80]}): export it again") from error
    # Halves of a UTF-16 pair are valid JSON, but no text.
    if "\\ud" in text or "\\uD" in text:
        try:
            json.dumps(content, ensure_ascii=False).encode()
        except (UnicodeEncodeError, ValueError, RecursionError) as error:
            raise DataError(f"{path} holds text that is no Unicode: export it again") from error
    return content


def read_json_object(path: Path, *, max_bytes: int = MAX_BYTES) -> dict[str, Any]:
    """Return the object that a JSON file holds.

    Raises:
        DataError: see ``read_json``; or it holds something else.
    """
    content = read_json(path, max_bytes=max_bytes)
    if not isinstance(content, dict):
        raise DataError(f"{path} holds a {type(content).__name__}, not a JSON object: export it again")
    return content


def _as_whole(digits: str) -> int | float:
    """Return a whole number as one, unless it is one that no reader has a use for."""
    return int(digits) if len(digits) <= 18 else float(digits)
