# SPDX-License-Identifier: Apache-2.0
"""The errors a user can meet, one sentence each: what is wrong and what to do; and the shape check."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from torch import Tensor


LONGEST = 290
"""Characters of an error's sentence; with the program's name before it 300 at most."""

_KEPT_OF_WORDS = (40, 20)
"""Characters that the longest words keep: so many first, so many if that does not do."""

_FROM_A_WORKER = re.compile(r"Caught \w+ in DataLoader worker process \d+\.\n")


_PACKAGE = Path(__file__).resolve().parent


def page(name: str, package: Path = _PACKAGE) -> str:
    """Return where a page lies, so that a message can name it: in the installed package, or in the clone.

    Args:
        name: of a page below ``docs/``, e.g. ``own-data.md``; ``.`` is the folder itself.
        package: the folder of the package ``raytran``.
    """
    for folder in (package / "docs", package.parents[1] / "docs"):
        if (folder / name).exists():
            return str(folder / name)
    return f"docs/{name}"


class RaytranError(Exception):
    """Base of all errors that are the user's to mend; commands print it as one sentence and exit with 1.

    Its ``str`` is one line of at most ``LONGEST`` characters, whatever a file or a command line has put into
    it; ``args`` hold what was given.

    A loader makes an error of one of its worker processes anew, with the worker's traceback as the message:
    what counts is the sentence at the end of that.
    """

    def __init__(self, message: object = "") -> None:
        text = str(message)
        if _FROM_A_WORKER.match(text):
            text = text.rstrip().splitlines()[-1].partition(": ")[2] or text
        super().__init__(text)

    def __str__(self) -> str:
        return one_line(super().__str__())


class ConfigError(RaytranError):
    """A setting is missing, unknown, or contradicts another one."""


class DataError(RaytranError):
    """A file or folder is missing, damaged, or inconsistent with its neighbours."""


class CheckpointError(RaytranError):
    """A checkpoint is missing, damaged, or of the wrong stage."""


class NonFiniteError(RaytranError):
    """Training has lost itself: losses or gradients stay infinite or undefined."""


class ShapeError(RaytranError, ValueError):
    """A tensor does not have the documented shape."""


def one_line(text: str, longest: int = LONGEST) -> str:
    """Return a sentence in printable characters on one line, cut in the middle where it is too long.

    What cannot be printed is written by its number, as in a literal of Python. The longest words, which are
    paths and values, give way first, so that the reason at the front and the remedy at the end stay.

    Args:
        text: the sentence.
        longest: most characters.
    """
    text = _printable(_middle_cut(text, 40 * longest).strip())  # what is far too long is not looked through
    if len(text) <= longest:
        return text
    words = text.split(" ")
    too_many = len(text) - longest
    for kept in _KEPT_OF_WORDS:
        while too_many > 0 and len(word := max(words, key=len)) > kept:
            cut = _middle_cut(word, max(kept, len(word) - too_many))
            words[words.index(word)] = cut
            too_many -= len(word) - len(cut)
    return _middle_cut(" ".join(words), longest)


def _printable(text: str) -> str:
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in text)


def _middle_cut(text: str, length: int) -> str:
    if len(text) <= length:
        return text
    return f"{text[: length // 2]}…{text[len(text) - (length - length // 2 - 1) :]}"


def check_shape(tensor: Tensor, letters: str, name: str) -> None:
    """Raise unless ``tensor`` has the shape that ``letters`` describes.

    Args:
        tensor: the tensor to check.
        letters: one word per dimension: a number must be equal, a word stands for any size,
            and a leading ``...`` for any number of dimensions, e.g. ``"B N 4 4"`` or ``"... 3"``.
        name: what to call the tensor in the message.

    Raises:
        ShapeError: ``expected NAME of shape (B, N, 4, 4), got (2, 4, 4)``.
    """
    words = letters.split()
    open_front = bool(words) and words[0] == "..."
    wanted = words[1:] if open_front else words
    actual = tuple(tensor.shape)
    tail = actual[len(actual) - len(wanted) :] if open_front else actual
    fits = len(tail) == len(wanted) and all(
        not word.isdigit() or int(word) == size for word, size in zip(wanted, tail, strict=True)
    )
    if not fits:
        raise ShapeError(f"expected {name} of shape ({', '.join(words)}), got {actual}")
