# SPDX-License-Identifier: Apache-2.0
"""Checkpoint files: tensors and plain Python only, never half-written under their final name.

There are two kinds. Training writes ``.ckpt`` files by ``torch.save``, which hold its whole state. Weights to
give away are ``.safetensors`` files: the tensors have the names of ``RayTran.state_dict()``, so that any
program opens them; the header's ``raytran`` is JSON, what a checkpoint says of itself without the state of
training, and ``sha256`` is of that text and of the tensors, which safetensors itself does not check. Both are
read as one dictionary.
"""

from __future__ import annotations

import hashlib
import json
import logging
import os
import pickle
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors import safe_open
from safetensors.torch import save
from torch import Tensor

import raytran
from raytran.checkpoints.earlier import upgraded
from raytran.checkpoints.hub import file_of_hub, is_on_hub
from raytran.checkpoints.network import without_sources
from raytran.data.files import UNFINISHED, whole_file
from raytran.data.text import parse_json
from raytran.errors import CheckpointError, ConfigError
from raytran.limits import MAX_STEPS, shown
from raytran.tensor_archive import CompressedArchiveError, load_archive

_log = logging.getLogger(__name__)

BEST_NAME = "best.ckpt"
LAST_NAME = "last.ckpt"
PREVIOUS_NAME = "previous.ckpt"


def write_checkpoint(path: Path, content: dict[str, Any]) -> None:
    """Write ``content`` to ``path``; a ``last.ckpt`` that was there is kept as ``previous.ckpt``.

    A kill at any moment leaves the old file or the new one under either name, whole.

    Raises:
        CheckpointError: the disk is full or does not take the file; what was there stays.
    """
    previous = path.with_name(PREVIOUS_NAME)
    try:
        with whole_file(path, durable=True) as partial:
            with partial.open("wb") as file:
                torch.save(content, file)
            link = _link_previous(path, previous)
        if link is not None:
            os.replace(link, previous)
    except (OSError, RuntimeError) as error:
        # PyTorch turns a failed write into a RuntimeError about its own file position.
        cause = error if isinstance(error, OSError) else error.__context__
        reason = cause.strerror if isinstance(cause, OSError) else "the disk is full or the file too large"
        raise CheckpointError(
            f"cannot write {path} ({reason}): make room there; the checkpoint from before is kept"
        ) from error


def _link_previous(path: Path, previous: Path) -> Path | None:
    """Return a second name of the file at ``path``, which takes the name ``previous`` once ``path`` is new.

    Both ``path`` and ``previous`` so exist throughout. None if there is nothing to keep, or if the file
    system has no links: then ``path`` has become ``previous`` already.
    """
    if not path.is_file() or path.name != LAST_NAME:
        return None
    link = previous.with_name(f"{UNFINISHED}{previous.name}")
    link.unlink(missing_ok=True)
    try:
        os.link(path, link)
    except OSError:
        os.replace(path, previous)
        return None
    return link


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
    content = read_weights(path) if is_weights_file(path) else _read_torch_file(path)
    if content["format"] == EARLIER_FORMAT:
        return upgraded(content) | {"format": FORMAT}
    return content


def _read_torch_file(path: Path) -> dict[str, Any]:
    try:
        content = load_archive(path)
    except CompressedArchiveError as error:
        raise CheckpointError(
            f"{path} was not loaded: it is a compressed archive, as PyTorch writes none; do not use this file"
        ) from error
    except pickle.UnpicklingError as error:
        raise CheckpointError(
            f"{path} was not loaded: it holds more than tensors and plain values, which no checkpoint of "
            "raytran does; do not use this file"
        ) from error
    except (ValueError, OSError) as error:
        raise _damaged(path) from error
    check_content(content, path)
    return content


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


def _damaged_weights(path: Path) -> DamagedCheckpointError:
    return DamagedCheckpointError(
        f"cannot read {path}: the file is damaged, cut short or no safetensors file; take another copy "
        "of it, or export it again"
    )


def _damaged(path: Path) -> DamagedCheckpointError:
    return DamagedCheckpointError(
        f"cannot read {path}: the file is damaged or cut short; take another copy of it, "
        "or delete it and train that stage again"
    )


FORMAT = "raytran.checkpoint/2"
EARLIER_FORMAT = "raytran.checkpoint/1"

_NAME = re.compile(r"\w[\w./+-]{0,99}")
"""Names of presets and stages, which become words of a command."""


_MAX_NAME = 150
"""Characters of a weight's name."""


def _is_name(value: Any) -> bool:
    return isinstance(value, str) and _NAME.fullmatch(value) is not None and ".." not in value


def _is_object(value: Any) -> bool:
    return isinstance(value, dict) and all(isinstance(name, str) for name in value)


def _is_state(value: Any) -> bool:
    return _is_object(value) and all(len(name) <= _MAX_NAME and name.isprintable() for name in value)


def _is_texts(value: Any) -> bool:
    return isinstance(value, list | tuple) and all(isinstance(text, str) for text in value)


def _is_step(value: Any) -> bool:
    return isinstance(value, int) and 0 <= value <= MAX_STEPS


def _is_parent(value: Any) -> bool:
    return _is_object(value) and _is_name(value.get("stage")) and _is_step(value.get("step"))


def _is_scores(value: Any) -> bool:
    return _is_object(value) and all(isinstance(score, int | float) for score in value.values())


def _is_data(value: Any) -> bool:
    texts = ("name", "root", "annotation")
    return (
        _is_object(value)
        and all(isinstance(value.get(name), str | None) for name in texts)
        and isinstance(value.get("made"), dict | None)
    )


_REQUIRED: dict[str, Callable[[Any], bool]] = {
    "stage": _is_name,
    "preset": _is_name,
    "model": _is_object,
    "views": _is_object,
    "state_dict": _is_state,
}
_OPTIONAL: dict[str, Callable[[Any], bool]] = {
    "config": _is_object,
    "data": _is_data,
    "parent": _is_parent,
    "scores": _is_scores,
    "versions": _is_object,
    "warnings": _is_texts,
    "global_step": _is_step,
    "git_commit": lambda value: isinstance(value, str),
}


class DamagedCheckpointError(CheckpointError):
    """A checkpoint that was whole once."""


def check_content(content: Any, path: Path) -> None:
    """Raise unless ``content`` is what this version of raytran reads.

    Raises:
        CheckpointError: it is of a newer version, of another program, or not all there.
    """
    found = content.get("format") if isinstance(content, dict) else None
    family, _, version = FORMAT.partition("/")
    if isinstance(found, str) and found.startswith(f"{family}/") and found != FORMAT:
        newer = found.removeprefix(f"{family}/")
        if newer.isdigit() and int(newer) > int(version):
            raise CheckpointError(
                f"{path} was written by a newer raytran (format {found}, this one reads {FORMAT}): "
                "update raytran"
            )
    if found not in (FORMAT, EARLIER_FORMAT):
        raise CheckpointError(
            f"{path} is no checkpoint of raytran: expected format {FORMAT}, got {shown(found)}"
        )
    for name, is_proper in _REQUIRED.items():
        if not is_proper(content.get(name)):
            raise CheckpointError(f"{path} is no whole checkpoint of raytran: it has no proper '{name}'")
    for name, is_proper in _OPTIONAL.items():
        if content.get(name) is not None and not is_proper(content[name]):
            raise CheckpointError(f"{path} is no checkpoint of raytran: its '{name}' is damaged")
    if not all(
        isinstance(value, Tensor) and value.layout is torch.strided and not value.is_complex()
        for name, value in content["state_dict"].items()
    ):
        raise CheckpointError(f"{path} is no checkpoint of raytran: some of its weights are no tensors")


SUFFIX = ".safetensors"
PREFIX = "model."
"""Of the network's weights among those of a checkpoint."""

_MAX_METADATA = 1 << 20
"""Characters of the header's JSON at most; those of the presets have some 3,000."""


_MAX_TENSORS = 100_000
"""Tensors in a file at most; the presets have some hundred."""


def is_weights_file(path: Path) -> bool:
    """Return whether ``path`` is to be read as safetensors: by its name, or by its first bytes."""
    if path.suffix == SUFFIX:
        return True
    with path.open("rb") as file:
        return file.read(9)[8:] == b"{"


def write_weights(path: Path, metadata: Mapping[str, Any], weights: Mapping[str, Tensor]) -> None:
    """Write ``weights`` to ``path``, which appears whole or not at all; what was there is replaced.

    Args:
        path: the file.
        metadata: what ``check_content`` asks for and anything else that is JSON, without ``state_dict``.
        weights: the network's, named as in its ``state_dict``.

    Raises:
        CheckpointError: the disk is full or does not take the file; what was there stays.
    """
    # Copies, because safetensors takes no two tensors that share memory.
    copies = {name: value.detach().cpu().contiguous().clone() for name, value in weights.items()}
    text = json.dumps(metadata, ensure_ascii=False)
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
            metadata = _parse(header.get("raytran"))
            names = file.keys()
            if len(names) > _MAX_TENSORS:
                raise ValueError(f"it has {len(names)} tensors")
            weights = {name: file.get_tensor(name) for name in names}
    except Exception as error:  # a made-up file can fail anywhere in the reader
        raise _damaged_weights(path) from error
    if metadata is None:
        raise CheckpointError(
            f"{path} holds no network of raytran: its header does not say how to build one; "
            "give a file that `raytran export_model` wrote"
        )
    content = {**metadata, "state_dict": {f"{PREFIX}{name}": value for name, value in weights.items()}}
    check_content(content, path)
    if _digest(header["raytran"], weights) != header.get("sha256"):
        raise _damaged_weights(path)
    return content


def _parse(text: str | None) -> dict[str, Any] | None:
    """Return the metadata in a header, None if there is none."""
    if text is None or len(text) > _MAX_METADATA:
        return None
    metadata = parse_json(text, "its header")
    return metadata if isinstance(metadata, dict) else None


def _digest(text: str, weights: Mapping[str, Tensor]) -> str:
    """Return the SHA-256 of the metadata and of every tensor's name, type, shape and bytes."""
    found = hashlib.sha256(text.encode())
    for name in sorted(weights):
        value = weights[name]
        found.update(f"\n{name} {value.dtype} {tuple(value.shape)}\n".encode())
        found.update(value.reshape(-1).view(torch.uint8).numpy().data)
    return found.hexdigest()


DEFAULT = "default"
"""Stands for the package's own weights wherever a checkpoint is named."""

FOLDER = Path(raytran.__file__).resolve().parent / "weights"
"""Where these are: one file, and the page that says what it can do."""

DTYPES = {"float32": torch.float32, "float16": torch.float16, "bfloat16": torch.bfloat16}

_KEPT = (
    *("format", "stage", "preset", "model", "views", "input_mask", "scores", "global_step", "warnings"),
    *("git_commit", "versions"),
)
"""Of what a checkpoint says. The rest is the state of training, and settings that hold a machine's paths."""


def checkpoint_path(checkpoint: str | Path) -> Path:
    """Return the file that a checkpoint's name stands for: a path, ``default``, or ``hf:owner/name``.

    Raises:
        CheckpointError: it is ``default``, and the package was built without weights; or it is of the hub and
            cannot be had, see ``file_of_hub``.
    """
    if is_on_hub(str(checkpoint)):
        return file_of_hub(str(checkpoint))
    if str(checkpoint) != DEFAULT:
        return Path(checkpoint)
    found = _files()
    if len(found) != 1:
        what = f"{len(found)} files of weights, not one," if found else "no weights"
        raise CheckpointError(
            f"there are {what} in {FOLDER}, which checkpoint=default stands for: give checkpoint=FILE, "
            "a .ckpt file that training wrote or a .safetensors file that was exported from one"
        )
    return found[0]


def shipped_weights() -> Path | None:
    """Return the package's own weights, None if it was built without."""
    found = _files()
    return found[0] if len(found) == 1 else None


def _files() -> list[Path]:
    return sorted(FOLDER.glob(f"*{SUFFIX}"))


def file_digest(path: Path) -> str:
    """Return the SHA-256 of a checkpoint's file, in hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def export_weights(checkpoint: Mapping[str, Any], source: Path, output: Path, *, dtype: str) -> None:
    """Write the network of a checkpoint to a safetensors file, without the state of training.

    Args:
        checkpoint: what ``read_checkpoint`` returned.
        source: where from, for messages.
        output: the file, which appears whole or not at all.
        dtype: one of ``DTYPES``, for the weights; counters stay integers.

    Raises:
        ConfigError: there is no such dtype.
        CheckpointError: some weights are beyond its range, or the file cannot be written.
    """
    if dtype not in DTYPES:
        raise ConfigError(f"unknown dtype={dtype}: choose one of {', '.join(DTYPES)}")
    weights = {
        name.removeprefix(PREFIX): _converted(value, DTYPES[dtype], f"{name} in {source}")
        for name, value in checkpoint["state_dict"].items()
        if name.startswith(PREFIX)
    }
    write_weights(output, _metadata(checkpoint), weights)


def _metadata(checkpoint: Mapping[str, Any]) -> dict[str, Any]:
    """Return what the file says of itself."""
    metadata = {name: checkpoint[name] for name in _KEPT if name in checkpoint}
    parent = checkpoint.get("parent")
    if isinstance(parent, Mapping):
        metadata["parent"] = {name: parent.get(name) for name in ("stage", "step")}
    data = checkpoint.get("data")
    if isinstance(data, Mapping):
        metadata["data"] = {name: data.get(name) for name in ("name", "annotation")}
    return metadata | {"model": without_sources(checkpoint["model"])}


def _converted(value: Tensor, dtype: torch.dtype, name: str) -> Tensor:
    if not value.is_floating_point():
        return value
    if not value.isfinite().all():
        raise CheckpointError(f"{name} is not finite: export a checkpoint from before the training diverged")
    converted = value.to(dtype)
    if not converted.isfinite().all():
        raise CheckpointError(f"{name} is beyond the range of float16: choose dtype=bfloat16 or float32")
    return converted
