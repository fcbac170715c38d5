# SPDX-License-Identifier: Apache-2.0
"""Pretrained weights of an image encoder: read, and put into it."""

from __future__ import annotations

import logging
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TypeVar, cast

import torch
from torch import Tensor, nn

from raytran.errors import CheckpointError
from raytran.tensor_archive import load_archive, load_stream

_log = logging.getLogger(__name__)

_T = TypeVar("_T")


def imagenet_or_random(get: Callable[[], _T], *, required: bool) -> _T | None:
    """Return what ``get`` returns, or None with a warning where ImageNet weights cannot be had.

    Args:
        get: fetches the weights; raises ``CheckpointError`` where it cannot.
        required: raise that error instead.

    Raises:
        CheckpointError: the weights are required and cannot be had.
    """
    try:
        return get()
    except CheckpointError as error:
        if required:
            raise
        _log.warning("the image encoder starts from random weights, which learns far slower: %s", error)
        return None


def read_state(path: Path, *, name: str, remedy: str) -> dict[str, Tensor]:
    """Return the state dict in a file.

    Args:
        path: a file of named tensors.
        name: of the encoder, for messages.
        remedy: what to do if the file is not there, for messages.

    Raises:
        CheckpointError: there is no such file, or it cannot be read, or holds something else.
    """
    if not path.is_file():
        raise CheckpointError(f"no {name} weights at {path}: {remedy}")
    try:
        # Some weights are still in the form from before PyTorch 1.6, which is no archive.
        state = load_archive(path) if zipfile.is_zipfile(path) else load_stream(path)
    except Exception as error:  # torch.load raises whatever its unpickler meets
        raise CheckpointError(
            f"{path} is not a readable state dict ({str(error)[:80]!r}): download it again"
        ) from error
    if not isinstance(state, dict) or not all(isinstance(value, Tensor) for value in state.values()):
        raise CheckpointError(f"{path} holds no state dict: give a file of named tensors of {name}")
    return cast("dict[str, Tensor]", state)


def load_state(
    network: nn.Module, state: Mapping[str, Tensor], *, first: str, source: object, name: str
) -> None:
    """Put weights for red, green and blue into an encoder; a fourth input channel starts without effect.

    Args:
        network: the encoder.
        state: all its weights.
        first: name of the first convolution's weight, ``(C, 3, k, k)`` in the state.
        source: where the state is from, for messages.
        name: of the encoder, for messages.

    Raises:
        CheckpointError: names or shapes differ.
    """
    fitted = dict(state)
    weight, wanted = fitted.get(first), network.state_dict()[first]
    if weight is not None and weight.ndim == 4 and weight.shape[1] == 3 and wanted.shape[1] == 4:
        fitted[first] = torch.cat([weight, torch.zeros_like(weight[:, :1])], dim=1)
    try:
        network.load_state_dict(fitted)
    except RuntimeError as error:
        reason = str(error).splitlines()[-1].strip()[:120]
        raise CheckpointError(
            f"{source} does not fit {name} ({reason}): give a state dict of {name}"
        ) from error
