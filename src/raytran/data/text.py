# SPDX-License-Identifier: Apache-2.0
"""Reads text, tables of numbers and JSON out of files that anybody may have written.

What every program of the field writes is read: byte order marks, Windows' line ends, UTF-16 of PowerShell,
commas for blanks. What no program writes ends in one sentence, and takes neither long nor much memory.
"""

from __future__ import annotations

import codecs
import io
import json
import re
from array import array
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from raytran.errors import DataError
from raytran.limits import shown

MAX_BYTES = 64 * 2**20
"""Bytes of a text file that are read: lists of a hundred thousand frames are smaller."""

_MAX_VALUES = 8_000_000
"""Numbers, texts and lists in a JSON file, objects counted thrice: two bytes of text can cost a hundred of
memory. Cameras of a hundred thousand frames have two million."""

_MAX_NAME = 200
"""Characters of a name."""

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
    # Rows of Python's numbers would take forty bytes for each byte of text.
    numbers = array("d")
    width = 0
    for number, line in enumerate(io.StringIO(read_text(path, max_bytes=max_bytes), newline=None), start=1):
        words = parted(line)
        try:
            numbers.extend(map(float, words))
        except ValueError as error:
            raise _no_row(path, number) from error
        if words and len(words) != (width := width or len(words)):
            raise _no_row(path, number)
    table = np.array(numbers, dtype=np.float64)
    return table.reshape(-1, width) if width else table


def parted(line: str) -> list[str]:
    """Return the words of a line that are parted by blanks, commas or semicolons, without a comment."""
    return line.partition("#")[0].translate(_PARTED).split()


_PARTED = str.maketrans(",;", "  ")


def _no_row(path: Path, number: int) -> DataError:
    return DataError(f"line {number} of {path} does not hold numbers, as many as the other lines do: mend it")


def read_names(path: Path) -> list[str]:
    """Return the words of a text file, e.g. the scans of a split.

    Raises:
        DataError: the file cannot be read, see ``read_text``, or a word is no name.
    """
    return [as_name(word, f"a word in {path}") for word in read_text(path).split()]


def as_name(value: object, what: str) -> str:
    """Return a text that can name something: a scan, a model, a preset.

    Args:
        value: what a file holds, of any type.
        what: name of the value and its place.

    Raises:
        DataError: it is another type, empty, longer than 200 characters, or more than one line.
    """
    if not isinstance(value, str) or not 0 < len(value) <= _MAX_NAME or not value.isprintable():
        raise DataError(f"{what} is {shown(value)}, no name of at most {_MAX_NAME} characters: mend it")
    return value


def read_json(path: Path, *, max_bytes: int = MAX_BYTES) -> Any:
    """Return what a JSON file holds; whole numbers of more than 18 digits are floats, infinite if need be.

    Raises:
        DataError: the file cannot be read, see ``read_text``; it is no JSON, is nested too deeply, has a key
            twice in one object, millions of values, or text that no file name or message can hold.
    """
    return parse_json(read_text(path, max_bytes=max_bytes), str(path))


def parse_json(text: str, what: str) -> Any:
    """Return what a text in JSON stands for, as ``read_json`` does for a file.

    Args:
        text: of at most ``MAX_BYTES``.
        what: what to call it in messages.

    Raises:
        DataError: see ``read_json``.
    """
    if text.count(",") + text.count("[") + 3 * text.count("{") > _MAX_VALUES:
        raise DataError(f"{what} holds more than {_MAX_VALUES:,} values: check that it is the right file")
    try:
        content = json.loads(text, parse_int=_as_whole, object_pairs_hook=_as_object)
    except (ValueError, RecursionError) as error:
        raise DataError(f"{what} is no valid JSON ({str(error)[:80]}): export it again") from error
    # Halves of a UTF-16 pair are valid JSON, but no text.
    if _HALF.search(text):
        try:
            json.dumps(content, ensure_ascii=False).encode()
        except (UnicodeEncodeError, ValueError, RecursionError) as error:
            raise DataError(f"{what} holds text that is no Unicode: export it again") from error
    return content


_HALF = re.compile(r"\\u[dD][89a-fA-F]")


def _as_object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Return an object; one of two values of a key would be taken at random."""
    content = dict(pairs)
    if len(content) != len(pairs):
        (twice, _), *_ = Counter(key for key, _ in pairs).most_common(1)
        raise ValueError(f"the key {shown(twice)} comes twice")
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
