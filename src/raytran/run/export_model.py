# SPDX-License-Identifier: Apache-2.0
"""Write a network to a file that others can use: ``python -m raytran.export_model``."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from raytran.errors import ConfigError
from raytran.run.checkpoint import model_from
from raytran.run.weights import export_weights
from raytran.training.checkpoint_file import read_checkpoint
from raytran.training.weights_file import SUFFIX

_log = logging.getLogger(__name__)


def export_model(cfg: DictConfig) -> Path:
    """Run ``python -m raytran.export_model``; see ``conf/export_model.yaml``.

    Returns:
        The file that was written.

    Raises:
        ConfigError: a setting is unknown, or ``output`` is the checkpoint itself or a folder.
        CheckpointError: the checkpoint is missing or damaged, or the file cannot be written.
    """
    source, output = Path(cfg.checkpoint), Path(cfg.output)
    _check_output(source, output)
    checkpoint = read_checkpoint(source)
    model_from(checkpoint, source)  # what cannot be loaded is not given away
    export_weights(checkpoint, source, output, dtype=str(cfg.dtype))
    _log.info("wrote %s (%s): %s", output.resolve(), cfg.dtype, _described(checkpoint, output))
    return output


def _check_output(source: Path, output: Path) -> None:
    if output.suffix != SUFFIX:
        raise ConfigError(f"output={output} has an unknown ending: choose {SUFFIX}")
    if output.is_dir():
        raise ConfigError(f"output={output} is a folder: name a file")
    if output.exists() and source.exists() and output.samefile(source):
        raise ConfigError(f"output={output} is the checkpoint itself: choose another name")


def _described(checkpoint: dict[str, Any], output: Path) -> str:
    """Return what is in the file, in a line."""
    megabytes = output.stat().st_size / 1e6
    step = checkpoint.get("global_step")
    at = "" if step is None else f", step {step}"
    return f"{megabytes:.1f} MB, preset {checkpoint['preset']}, stage {checkpoint['stage']}{at}"
