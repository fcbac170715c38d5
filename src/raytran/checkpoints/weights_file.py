# SPDX-License-Identifier: Apache-2.0
"""Weights to give away: a safetensors file whose header holds all that rebuilds the network.

The tensors have the names of ``RayTran.state_dict()``, so that any program opens them. The header's
``raytran`` is JSON: what a checkpoint says of itself, without the state of training; ``sha256`` is of that
text and of the tensors, which safetensors itself does not check.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors import safe_open
from safetensors.torch import save
from torch import Tensor

from raytran.checkpoints.content import DamagedCheckpointError, check_content
from raytran.data.files import whole_file
from raytran.errors import CheckpointError

SUFFIX = ".safetensors"
PREFIX = "model."
"""Of the network's weights among those of a checkpoint."""

_MAX_CARD = 1 << 20
"""Characters of the header's JSON at most; those of the presets have some 3,000."""


def is_weights_file(path: Path) -> bool:
    """Return whether ``path`` is to be read as safetensors: by its name, or by its first bytes."""
    if path.suffix == SUFFIX:
        return True
    with path.open("rb") as file:
        return file.read(9)[8:] == b"{"


def write_weights(path: Path, card: Mapping[str, Any], weights: Mapping[str, Tensor]) -> None:
    """Write ``weights`` to ``path``, which appears whole or not at all; what was there is replaced.

    Args:
        path: the file.
        card: what ``check_content`` asks for and anything else that is JSON, without ``state_dict``.
        weights: the network's, named as in its ``state_dict``.

    Raises:
        CheckpointError: the disk is full or does not take the file; what was there stays.
    """
    # Copies, because safetensors takes no two tensors that share memory.
    copies = {name: value.detach().cpu().contiguous().clone() for name, value in weights.items()}
    text = json.dumps(card, ensure_ascii=False)
    header = {"format": "pt", "raytran": text, "sha256": _digest(text, copies)}
    # Not save_file, whose files only the owner may read.
    write_whole(path, save(copies, metadata=header))


def write_whole(path: Path, content: bytes) -> None:
    """Write ``content`` to ``path``, which appears whole or not at all; what was there is replaced.

    Raises:
        CheckpointError: the disk is full or does not take the file; what was there stays.
    """
    try:
        with whole_file(path, durable=True) as partial:
            partial.write_bytes(content)
    except OSError as error:
        raise CheckpointError(
            f"cannot write {path} ({error.strerror}): make room there, or choose another place"
        ) from error


def read_weights(path: Path) -> dict[str, Any]:
    """Return the content of a checkpoint from a file that ``write_weights`` wrote, on the CPU.

    Raises:
        DamagedCheckpointError: the file is cut short or some of its bytes have changed.
        CheckpointError: it is another program's, or of a newer raytran.
    """
    try:
        with safe_open(path, framework="pt") as file:
            header = file.metadata() or {}
            card = _parse(header.get("raytran"))
            weights = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - no mapping
    except Exception as error:  # a made-up file can fail anywhere in the reader
        raise _damaged(path) from error
    if card is None:
        raise CheckpointError(
            f"{path} holds no network of raytran: its header does not say how to build one; "
            "give a file that `python -m raytran.export_model` wrote"
        )
    content = {**card, "state_dict": {f"{PREFIX}{name}": value for name, value in weights.items()}}
    check_content(content, path)
    if _digest(header["raytran"], weights) != header.get("sha256"):
        raise _damaged(path)
    return content


def _parse(text: str | None) -> dict[str, Any] | None:
    """Return the card in a header, None if there is none."""
    if text is None or len(text) > _MAX_CARD:
        return None
    card = json.loads(text)
    return card if isinstance(card, dict) else None


def _digest(text: str, weights: Mapping[str, Tensor]) -> str:
    """Return the SHA-256 of the card and of every tensor's name, type, shape and bytes."""
    found = hashlib.sha256(text.encode())
    for name in sorted(weights):
        value = weights[name]
        found.update(f"\n{name} {value.dtype} {tuple(value.shape)}\n".encode())
        found.update(value.reshape(-1).view(torch.uint8).numpy().data)
    return found.hexdigest()


def _damaged(path: Path) -> DamagedCheckpointError:
    return DamagedCheckpointError(
        f"cannot read {path}: the file is damaged, cut short or no safetensors file; take another copy "
        "of it, or export it again"
    )
