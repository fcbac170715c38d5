# SPDX-License-Identifier: Apache-2.0
"""Models out of checkpoints: the description inside says how to build the network, the weights fill it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import torch

from raytran.checkpoints.file import PREFIX, checkpoint_path, read_checkpoint
from raytran.checkpoints.metadata import input_mask
from raytran.checkpoints.network import build_network
from raytran.classes import Classes
from raytran.errors import CheckpointError, ConfigError, DataError
from raytran.limits import MAX_VIEWS, SIDE, as_count, as_numbers
from raytran.model import RayTran
from raytran.ops.traverse import Attention, RayTracer

_MAX_REASON = 120
"""Characters of PyTorch's reason that a message shows: it may list all names of a file."""


def load_model(
    checkpoint: str | Path, *, attention: Attention = "auto", trust: Iterable[str] = ()
) -> RayTran:
    """Return the model of a checkpoint, in evaluation mode, on the CPU.

    Args:
        checkpoint: path of the file, ``default`` for the weights that the package carries, or
            ``hf:owner/name`` for weights on the hub.
        attention: as in ``RayTran``; what the network was trained with does not matter.
        trust: packages of your own whose classes the file may name, see ``trusted_packages``.

    Raises:
        CheckpointError: the file is missing, damaged, or its weights do not fit the model described in it; or
            that names a class of a package that is not trusted.
        ConfigError: there is no such attention, or ``trust`` is no list of packages.
    """
    path = checkpoint_path(checkpoint)
    model = model_from(read_checkpoint(path), path, trust=trust)
    model.ray_tracer = RayTracer(attention)
    return model


@dataclass(frozen=True)
class PredictionSettings:
    """What a checkpoint says about the images it wants.

    Attributes:
        preset: name of the preset it was trained with.
        stage: name of the stage.
        image_size: ``(H, W)``.
        num_views: frames to predict from (96 in the paper).
        input_mask: mask that goes in as a fourth channel, see ``SceneDataset``; None if that is not known.
    """

    preset: str
    stage: str
    image_size: tuple[int, int]
    num_views: int
    input_mask: str | None = None


def prediction_settings(checkpoint: str | Path) -> PredictionSettings:
    """Read how a checkpoint is to be used.

    Args:
        checkpoint: as in ``load_model``.

    Raises:
        CheckpointError: the file is missing or damaged.
    """
    path = checkpoint_path(checkpoint)
    metadata = read_checkpoint(path)
    views = metadata["views"]
    try:
        height, width = as_numbers(views.get("image_size"), (2,), SIDE, "image_size").astype(int).tolist()
        num_views = as_count(views.get("predict_views"), 1, MAX_VIEWS, "predict_views")
    except DataError as error:
        raise CheckpointError(
            f"{path} does not say which images its network wants ({error}): it is damaged"
        ) from error
    mask = metadata.get("input_mask") or input_mask(metadata.get("config"))
    return PredictionSettings(metadata["preset"], metadata["stage"], (height, width), num_views, mask)


def model_from(checkpoint: Mapping[str, Any], path: Path, *, trust: Iterable[str] = ()) -> RayTran:
    """Return the model of a checkpoint that was read from ``path`` already.

    Args:
        checkpoint: what ``read_checkpoint`` returned.
        path: where from, for messages.
        trust: packages of your own whose classes it may name, see ``trusted_packages``.

    Raises:
        CheckpointError: the checkpoint describes no network of raytran or of a trusted package, or its
            weights do not fit.
        ConfigError: ``trust`` is no list of packages.
    """
    with torch.device("meta"):  # the file's size, and not what it claims, decides how much memory is taken
        shell = build_network(
            checkpoint["model"], path, trust=trust, max_tensors=len(checkpoint["state_dict"])
        )
    if not isinstance(shell, RayTran):
        raise CheckpointError(f"{path} describes only a part of a network: do not use this file")
    load_weights(shell, checkpoint, path, assign=True)
    model = cast("RayTran", build_network(checkpoint["model"], path, trust=trust))
    load_weights(model, checkpoint, path)
    return model.eval()


def load_weights(
    model: RayTran,
    checkpoint: Mapping[str, Any],
    path: Path,
    *,
    assign: bool = False,
    fresh: Sequence[str] = (),
) -> None:
    """Fill ``model`` with the weights of a checkpoint.

    Args:
        model: the network.
        checkpoint: what ``read_checkpoint`` returned.
        path: where from, for messages.
        assign: take the checkpoint's tensors themselves, instead of copying into those of ``model``.
        fresh: parts that keep the weights they have, see ``fresh_parts``.

    Raises:
        CheckpointError: names or shapes differ, or a weight is not finite.
    """
    kept = tuple(f"{part}." for part in fresh)
    state = {name: value for name, value in _state(checkpoint).items() if not f"{name}.".startswith(kept)}
    for name, value in state.items():
        if value.is_floating_point() and not _in_float32(value).isfinite().all():
            raise CheckpointError(
                f"{PREFIX}{name} in {path} is not finite: take a checkpoint from before the training diverged"
            )
    state |= {name: value for name, value in model.state_dict().items() if f"{name}.".startswith(kept)}
    try:
        model.load_state_dict(state, assign=assign)
    except RuntimeError as error:
        reason = str(error).splitlines()[-1].strip()[:_MAX_REASON]
        raise CheckpointError(
            f"the weights in {path} (preset {checkpoint['preset']}) do not fit this model ({reason}): "
            "choose the preset and model settings that the checkpoint was trained with"
        ) from error


def _in_float32(value: torch.Tensor) -> torch.Tensor:
    """Return numbers as those of 32 bits, as they are computed with: of 64, some become infinite by it."""
    return value if value.dtype in (torch.float32, torch.float16, torch.bfloat16) else value.float()


def classes_of(checkpoint: Mapping[str, Any]) -> Classes:
    """Return the classes of a checkpoint's network; one that says nothing of them has the paper's nine.

    Args:
        checkpoint: what ``read_checkpoint`` returned.

    Raises:
        CheckpointError: what it says of them cannot be.
    """
    try:
        return Classes.of(checkpoint["model"].get("classes"))
    except ConfigError as error:
        raise CheckpointError(
            f"the checkpoint says odd things of its classes ({error}): do not use this file"
        ) from error


def fresh_parts(model: RayTran, checkpoint: Mapping[str, Any], may_be_missing: Sequence[str]) -> list[str]:
    """Return the parts of ``model`` that a stage starts at random although it has a parent.

    Those are, first, the parts in ``may_be_missing`` of which the checkpoint has nothing. Second, heads of
    another form than the checkpoint's, if the checkpoint's were never trained: it has no parent, and its
    stage did not train them. So one stage 1 serves all object heads. Third, what tells classes apart, if the
    checkpoint has others.

    Args:
        model: the network.
        checkpoint: what ``read_checkpoint`` returned.
        may_be_missing: parts that the checkpoint need not have.

    Raises:
        CheckpointError: see ``classes_of``.
    """
    state = {name: value.shape for name, value in _state(checkpoint).items()}
    wanted = {name: value.shape for name, value in model.state_dict().items()}

    def within(part: str, shapes: dict[str, torch.Size]) -> dict[str, torch.Size]:
        return {name: shape for name, shape in shapes.items() if name.startswith(f"{part}.")}

    missing = [part for part in may_be_missing if not within(part, state)]
    heads = [f"heads.{head}" for head in model.heads]
    other = [head for head in heads if within(head, state) not in ({}, within(head, wanted))]
    fresh = missing + [head for head in other if _is_random(head, checkpoint)]
    if model.classes.names == classes_of(checkpoint).names:
        return fresh
    within_fresh = tuple(f"{part}." for part in fresh)
    return fresh + [layer for layer in model.class_layers() if not layer.startswith(within_fresh)]


def _is_random(part: str, checkpoint: Mapping[str, Any]) -> bool:
    """Say whether ``part`` of a checkpoint was never trained, as far as the checkpoint tells."""
    try:
        if checkpoint["parent"] is not None:
            return False
        trained = [f"{name}." for name in checkpoint["config"]["stage"]["trainable"]]
    except (KeyError, TypeError):
        return False
    return not any(name.startswith(f"{part}.") or f"{part}.".startswith(name) for name in trained)


def _state(checkpoint: Mapping[str, Any]) -> dict[str, torch.Tensor]:
    """Return the network's weights in a checkpoint by their names in the network."""
    return {
        name.removeprefix(PREFIX): value
        for name, value in checkpoint["state_dict"].items()
        if name.startswith(PREFIX)
    }
