# SPDX-License-Identifier: Apache-2.0
"""Checkpoint files: tensors and plain Python only, never half-written under their final name."""

from __future__ import annotations

import contextlib
import logging
import os
import pickle
import zipfile
from pathlib import Path
from typing import Any

import torch

from raytran.checkpoints.content import DamagedCheckpointError, check_content, with_stage_names
from raytran.checkpoints.weights_file import is_weights_file, read_weights
from raytran.errors import CheckpointError

_log = logging.getLogger(__name__)

LAST_NAME = "last.ckpt"
PREVIOUS_NAME = "previous.ckpt"


def write_checkpoint(path: Path, content: dict[str, Any]) -> None:
    """Write ``content`` to ``path`` and keep what was there as ``previous.ckpt``.

    A kill at any moment leaves the old file or the new one under either name, whole.

    Raises:
        CheckpointError: the disk is full or does not take the file; what was there stays.
    """
    partial = path.with_name(f"{path.name}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with partial.open("wb") as file:
            torch.save(content, file)
            file.flush()
            os.fsync(file.fileno())
        _replace(partial, path)
    except (OSError, RuntimeError) as error:
        # PyTorch turns a failed write into a RuntimeError about its own file position.
        cause = error if isinstance(error, OSError) else error.__context__
        reason = cause.strerror if isinstance(cause, OSError) else "the disk is full or the file too large"
        with contextlib.suppress(OSError):
            partial.unlink(missing_ok=True)
        raise CheckpointError(
            f"cannot write {path} ({reason}): make room there; the checkpoint from before is kept"
        ) from error


def _replace(partial: Path, path: Path) -> None:
    """Give ``partial`` the name ``path``, whose file becomes the previous one; both exist throughout."""
    previous = path.with_name(PREVIOUS_NAME)
    if path.is_file() and path.name != PREVIOUS_NAME:
        linked = path.with_name(f"{PREVIOUS_NAME}.part")
        linked.unlink(missing_ok=True)
        try:
            os.link(path, linked)
        except OSError:
            os.replace(path, previous)  # a file system without links
            os.replace(partial, path)
        else:
            os.replace(partial, path)
            os.replace(linked, previous)
    else:
        os.replace(partial, path)
    with contextlib.suppress(OSError):  # not every system lets a folder be opened
        folder = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)


def read_checkpoint(path: Path) -> dict[str, Any]:
    """Return the content of a checkpoint, on the CPU. Nothing inside is run, whoever wrote the file.

    It may be one that training wrote, or weights that were exported to a ``.safetensors`` file.

    Raises:
        DamagedCheckpointError: the file is cut short or some of its bytes have changed.
        CheckpointError: the file is missing, no checkpoint of raytran, of a newer format, or holds more than
            tensors and plain values.
    """
    if not path.is_file():
        raise CheckpointError(
            f"no checkpoint at {path}: give the path of a .ckpt file that training wrote, "
            "or of a .safetensors file that was exported from one"
        )
    if path.suffix == ".pt2":
        raise CheckpointError(
            f"{path} is a program of torch.export, which holds no settings to build a network by: give the "
            ".ckpt or .safetensors file that it was made from"
        )
    if is_weights_file(path):
        return with_stage_names(read_weights(path))
    _check_bytes(path)
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except pickle.UnpicklingError as error:
        raise CheckpointError(
            f"{path} was not loaded: it holds more than tensors and plain values, which no checkpoint of "
            "raytran does; do not use this file"
        ) from error
    except Exception as error:  # a made-up file can fail anywhere in the reader
        raise _damaged(path) from error
    check_content(content, path)
    return with_stage_names(content)


def read_newest(folder: Path) -> tuple[Path, dict[str, Any]] | None:
    """Return path and content of the newest whole checkpoint in ``folder``, None if there is none at all.

    Raises:
        CheckpointError: all are damaged, or the newest is of another program or a newer version.
    """
    failure: CheckpointError | None = None
    for name in (LAST_NAME, PREVIOUS_NAME):
        path = folder / name
        if not path.is_file():
            continue
        try:
            content = read_checkpoint(path)
        except DamagedCheckpointError as error:
            failure = failure or error
            continue
        if failure is not None:
            _log.warning("%s; going on from the one before it, %s", failure, path)
        return path, content
    if failure is not None:
        raise failure
    return None


def _check_bytes(path: Path) -> None:
    """Compare every part of the file with its check sum, which PyTorch itself does not."""
    try:
        with zipfile.ZipFile(path) as archive:
            # PyTorch compresses nothing; what is small here and huge in memory is not from it.
            if any(part.compress_type != zipfile.ZIP_STORED for part in archive.infolist()):
                raise CheckpointError(f"{path} is no checkpoint of raytran: it is a compressed archive")
            if archive.testzip() is not None:
                raise _damaged(path)
    except (zipfile.BadZipFile, OSError, EOFError, NotImplementedError, ValueError) as error:
        raise _damaged(path) from error


def _damaged(path: Path) -> DamagedCheckpointError:
    return DamagedCheckpointError(
        f"cannot read {path}: the file is damaged or cut short; take another copy of it, "
        "or delete it and train that stage again"
    )
