# SPDX-License-Identifier: Apache-2.0
"""The errors a user can meet, one sentence each: what is wrong and what to do; and the shape check."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from torch import Tensor


_FROM_A_WORKER = re.compile(r"Caught \w+ in DataLoader worker process \d+\.\n")


class RaytranError(Exception):
    """Base of all errors that are the user's to mend; commands print it as one sentence and exit with 1.

    A loader makes an error of one of its worker processes anew, with the worker's traceback as the message:
    what counts is the sentence at the end of that.
    """

    def __init__(self, message: object = "") -> None:
        text = str(message)
        if _FROM_A_WORKER.match(text):
            text = text.rstrip().splitlines()[-1].partition(": ")[2] or text
        super().__init__(text)


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
