# SPDX-License-Identifier: Apache-2.0
"""Write a network to a file that others can use: ``raytran export_model``."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from omegaconf import DictConfig
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from raytran.checkpoints.file import (
    PREFIX,
    SUFFIX,
    checkpoint_path,
    export_weights,
    file_digest,
    read_checkpoint,
)
from raytran.checkpoints.load import classes_of, model_from, prediction_settings
from raytran.checkpoints.metadata import DataIdentity
from raytran.checkpoints.network import trusted_packages
from raytran.classes import Classes
from raytran.data.text import read_json_object
from raytran.errors import ConfigError, DataError
from raytran.export.torch_program import SUFFIX as PROGRAM_SUFFIX
from raytran.export.torch_program import export_program
from raytran.heads.score_scaling import ScoreScaling
from raytran.run.evaluate.results import MARKER
from raytran.run.export.model_card import card_beside, write_card
from raytran.run.plan.camera_paths import walk
from raytran.run.train.build import plain

_log = logging.getLogger(__name__)

_VIEWS_TRIED = 5
"""Views of a made-up walk on which a program is tried before it is written."""


def export_model(cfg: DictConfig) -> Path | None:
    """Run ``raytran export_model``; see ``conf/export_model.yaml``.

    Returns:
        The file that was written, None if there was only to say what is in the checkpoint.

    Raises:
        ConfigError: a setting is unknown, ``output`` is the checkpoint itself or a folder, ``calibration`` is
            no evaluation of it, or there is a page where the card belongs.
        CheckpointError: the checkpoint is missing or damaged, or the file cannot be written.
    """
    source = checkpoint_path(cfg.checkpoint)
    if cfg.output is None:
        Console().print(described(read_checkpoint(source), source))
        return None
    output = Path(cfg.output)
    _check_output(source, output)
    card = card_beside(output) if cfg.card else None
    checkpoint = read_checkpoint(source)
    if cfg.calibration is not None:
        checkpoint = calibrated(checkpoint, source, Path(cfg.calibration))
    # What cannot be loaded is not given away.
    model = model_from(checkpoint, source, trust=trusted_packages(cfg.trust))
    if output.suffix == SUFFIX:
        export_weights(checkpoint, source, output, dtype=cfg.dtype)
        if card is not None:
            write_card(card, output, facts(read_checkpoint(output), output))
            _log.info("wrote %s", card.resolve())
    else:
        if cfg.dtype != "float32":
            raise ConfigError(f"dtype={cfg.dtype} is for {SUFFIX}: a program computes in float32")
        if card is not None:
            raise ConfigError(f"card=true is for {SUFFIX}: hubs offer weights, not programs")
        cameras = walk(_VIEWS_TRIED).scaled_to(prediction_settings(source).image_size)
        export_program(model, checkpoint, output, cameras=cameras, **plain(cfg.program))
    _log.info("wrote %s: %.1f MB", output.resolve(), output.stat().st_size / 1e6)
    return output


def calibrated(checkpoint: Mapping[str, Any], source: Path, evaluation: Path) -> dict[str, Any]:
    """Return a checkpoint whose scores mean what they say in an evaluation of it, see ``ScoreScaling``.

    Args:
        checkpoint: what ``read_checkpoint`` returned.
        source: where from.
        evaluation: folder that ``raytran evaluate`` wrote of this very file.

    Raises:
        ConfigError: there is no such evaluation, it is of another file, or its scores tell nothing.
    """
    path = evaluation / MARKER
    try:
        metrics = read_json_object(path)
        of_file, split = metrics["checkpoint_sha256"], metrics["split"]
        scaling = ScoreScaling.of(metrics["strict"]["calibration"]["every_score"]["scaling"])
    except (DataError, KeyError, TypeError) as error:
        raise ConfigError(
            f"{path} says nothing of scores ({type(error).__name__}): calibration= takes a folder that "
            "raytran evaluate wrote for this checkpoint"
        ) from error
    if of_file != file_digest(source):
        raise ConfigError(f"{path} is of another file than {source}: evaluate this one and give its folder")
    if scaling is None:
        raise ConfigError(f"the scores in {path} do not tell right from wrong: there is nothing to scale")
    if split == "test":
        _log.warning("scores are fitted to test scenes: measured on these they are no test any more")
    whole = scaling.after(ScoreScaling.of(checkpoint["model"].get("score_scaling")))
    _log.info("scores are scaled by %.3f and shifted by %+.3f, on log odds", whole.scale, whole.offset)
    return {**checkpoint, "model": {**checkpoint["model"], "score_scaling": whole.settings()}}


def facts(checkpoint: Mapping[str, Any], path: Path) -> dict[str, Any]:
    """Return what a checkpoint says of itself, by name; None where it says nothing."""
    weights = [value for name, value in checkpoint["state_dict"].items() if name.startswith(PREFIX)]
    dtypes = sorted(
        {str(value.dtype).removeprefix("torch.") for value in weights if value.is_floating_point()}
    )
    views, versions = checkpoint["views"], checkpoint.get("versions") or {}
    parent, classes = checkpoint.get("parent") or {}, classes_of(checkpoint)
    return {
        "size": f"{path.stat().st_size / 1e6:.1f} MB",
        "preset": checkpoint["preset"],
        "stage": checkpoint["stage"],
        "steps": checkpoint.get("global_step"),
        "parent": f"{parent['stage']}, {parent['step']} steps" if parent else None,
        "trained on": str(known) if (known := DataIdentity.of_checkpoint(checkpoint)) else None,
        "classes": str(classes),
        "scores": _scaling_of(checkpoint),
        "weights": f"{sum(value.numel() for value in weights) / 1e6:.2f} M, {', '.join(dtypes)}",
        "images": f"{views.get('image_size')}, {views.get('predict_views')} a scene",
        "raytran": versions.get("raytran"),
        "commit": checkpoint.get("git_commit"),
        "torch": versions.get("torch"),
        "WARNING": "; ".join(checkpoint.get("warnings") or ()) or None,
        **{
            name: score
            for name, score in (checkpoint.get("scores") or {}).items()
            if _is_summary(name, classes)
        },
    }


def described(checkpoint: Mapping[str, Any], path: Path) -> Table:
    """Return what a checkpoint says of itself, for the terminal."""
    # What a file says may look like Rich's markup.
    table = Table("", "", title=escape(str(path)), show_header=False)
    table.columns[1].overflow = "fold"
    for name, value in facts(checkpoint, path).items():
        if value is not None:
            table.add_row(escape(name), f"{value:.4g}" if isinstance(value, float) else escape(str(value)))
    return table


def _scaling_of(checkpoint: Mapping[str, Any]) -> str | None:
    """Return how scores are scaled, in words."""
    scaling = ScoreScaling.of(checkpoint["model"].get("score_scaling"))
    return None if scaling is None else f"log odds × {scaling.scale:.3f} {scaling.offset:+.3f}"


def _is_summary(name: str, classes: Classes) -> bool:
    """Say whether a score is neither of one class nor of what precedes the last layer."""
    last = name.rpartition("/")[2]
    return last not in classes.names and last != "proposals" and not last.startswith("layer")


def _check_output(source: Path, output: Path) -> None:
    if output.suffix not in (SUFFIX, PROGRAM_SUFFIX):
        raise ConfigError(f"output={output} has an unknown ending: choose {SUFFIX} or {PROGRAM_SUFFIX}")
    if output.is_dir():
        raise ConfigError(f"output={output} is a folder: name a file")
    if output.exists() and source.exists() and output.samefile(source):
        raise ConfigError(f"output={output} is the checkpoint itself: choose another name")
