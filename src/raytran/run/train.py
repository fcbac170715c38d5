# SPDX-License-Identifier: Apache-2.0
"""One stage, one fit: start it, continue it, mark it as finished."""

from __future__ import annotations

import json
import logging
import os
import time
import warnings
from dataclasses import dataclass
from pathlib import Path

import lightning.pytorch as pl
from lightning.pytorch.utilities import rank_zero_only
from lightning.pytorch.utilities.exceptions import SIGTERMException
from omegaconf import DictConfig, OmegaConf

from raytran.errors import CheckpointError, ConfigError
from raytran.run.build import build_data, build_model, build_module, build_trainer, plain
from raytran.run.checkpoint import checkpoint_card, load_weights
from raytran.run.folders import LAST, newest_finished, read_finished, write_finished
from raytran.run.provenance import provenance
from raytran.run.settings import RunConfig
from raytran.training.checkpoint_file import read_checkpoint
from raytran.training.reconstruction import Reconstruction
from raytran.training.stage import Stage

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class FitResult:
    """A finished fit.

    Attributes:
        folder: of the run.
        checkpoint: its final checkpoint.
        steps: optimiser steps taken in all.
        seconds: time of this fit, 0 if the run had finished before.
        metrics: the last logged values, by name.
    """

    folder: Path
    checkpoint: Path
    steps: int
    seconds: float
    metrics: dict[str, float]


def train(cfg: DictConfig) -> FitResult:
    """Train one stage as ``conf/train.yaml`` describes it.

    Returns:
        The finished fit; at once if ``resume`` leads to a run that has finished already.

    Raises:
        ConfigError: settings contradict each other or the parent stage is missing.
        CheckpointError: a checkpoint is missing, damaged, or of another stage.
        DataError: the data are missing or damaged.
    """
    run = RunConfig.read(cfg)
    folder = Path(run.output_dir)
    finished = _finished_before(run, folder)
    if finished is not None:
        return finished
    pl.seed_everything(run.seed, workers=True, verbose=False)
    _quiet()
    module, resume_from, parent = _start(cfg, run)
    card = checkpoint_card(
        stage=module.stage.name,
        preset=run.preset,
        model=plain(cfg.model),
        views=plain(cfg.views),
        parent=parent,
    )
    trainer = build_trainer(cfg, run, card)
    data = build_data(cfg)
    if trainer.is_global_zero:
        _describe_run(cfg, folder)
    _log.info("stage %s, %d steps, in %s", module.stage.name, trainer.max_steps, folder)
    began = time.monotonic()
    try:
        trainer.fit(module, data, ckpt_path=resume_from)
    except SystemExit as stop:
        # Lightning turns Ctrl-C and SIGTERM into exits; the shell shall see which it was.
        raise SystemExit(143 if isinstance(stop, SIGTERMException) else 130) from stop
    seconds = time.monotonic() - began
    if trainer.is_global_zero:
        write_finished(
            folder,
            stage=module.stage.name,
            preset=run.preset,
            experiment=run.experiment,
            steps=trainer.global_step,
        )
    metrics = {name: float(value) for name, value in trainer.logged_metrics.items()}
    _log.info("stage %s finished after %.0f s: %s", module.stage.name, seconds, folder / LAST)
    return FitResult(folder, folder / LAST, trainer.global_step, seconds, metrics)


def _finished_before(run: RunConfig, folder: Path) -> FitResult | None:
    """Return the result of a run that needs nothing more, None if there is work to do."""
    finished = read_finished(folder)
    if run.resume == "none":
        if finished is not None or (folder / LAST).is_file():
            raise ConfigError(
                f"{folder} holds a run already: continue it with resume=auto or choose another output_dir"
            )
        return None
    if finished is None:
        return None
    _log.info("%s has finished already (stage %s, %d steps)", folder, finished.stage, finished.steps)
    return FitResult(folder, folder / finished.checkpoint, finished.steps, 0.0, {})


def _start(cfg: DictConfig, run: RunConfig) -> tuple[Reconstruction, Path | None, str | None]:
    """Return the module with its starting weights, the checkpoint to resume, and the path of the parent."""
    last = Path(run.output_dir) / LAST
    if run.resume != "none" and last.is_file():
        card = read_checkpoint(last)
        module = build_module(cfg, build_model(cfg, pretrained=False))
        if card["stage"] != module.stage.name:
            raise CheckpointError(
                f"{last} is of stage {card['stage']}, not {module.stage.name}: choose the experiment "
                f"that wrote it, or start a new run from its weights with init_from={last}"
            )
        _log.info("continuing from step %d of %s", card["global_step"], last)
        return module, last, card["parent"]
    if run.resume not in ("none", "auto"):
        raise CheckpointError(f"no checkpoint at {run.resume}: give the path of a last.ckpt, or resume=auto")
    if run.resume == "auto":
        _log.info("nothing to continue: this is a new run")
    parent = find_parent(run, _stage(cfg))
    module = build_module(cfg, build_model(cfg, pretrained=parent is None))
    if parent is None:
        return module, None, None
    checkpoint = read_checkpoint(parent)
    if checkpoint["stage"] not in (module.stage.parent, module.stage.name):
        _log.warning("%s is of stage %s, expected %s", parent, checkpoint["stage"], module.stage.parent)
    load_weights(module.model, checkpoint, parent)
    _log.info("starting from stage %s: %s", checkpoint["stage"], parent)
    return module, None, str(parent)


def find_parent(run: RunConfig, stage: Stage) -> Path | None:
    """Return the checkpoint whose weights a new run starts from, None to start from scratch.

    Raises:
        ConfigError: ``init_from=auto`` finds no finished run of the parent stage.
    """
    if run.init_from not in ("auto", "none"):
        return Path(run.init_from)
    if run.init_from == "none" or stage.parent is None:
        return None
    found = newest_finished(Path(run.outputs), preset=run.preset, stage=stage.parent)
    if found is None:
        raise ConfigError(
            f"no finished run of stage {stage.parent} with preset {run.preset} under "
            f"{Path(run.outputs).resolve()}: run `python -m raytran.train "
            f"experiment={stage.parent_experiment} preset={run.preset}` first, "
            "or give init_from=CHECKPOINT, or init_from=none to start from scratch"
        )
    return found


def _stage(cfg: DictConfig) -> Stage:
    return Stage(**{name: value for name, value in plain(cfg.stage).items() if name != "_target_"})


def _describe_run(cfg: DictConfig, folder: Path) -> None:
    """Write the resolved config and where the code comes from beside the results."""
    folder.mkdir(parents=True, exist_ok=True)
    texts: dict[str, str] = {
        "config.yaml": OmegaConf.to_yaml(cfg, resolve=True),
        "provenance.json": json.dumps(provenance(), indent=2) + "\n",
    }
    for name, text in texts.items():
        partial = folder / f"{name}.part"
        partial.write_text(text)
        os.replace(partial, folder / name)


def _quiet() -> None:
    """Silence Lightning's advice where we decided on purpose, and all ranks but the first."""
    if getattr(rank_zero_only, "rank", 0) != 0:
        logging.getLogger("raytran").setLevel(logging.WARNING)
    for name in ("lightning.pytorch", "lightning.fabric"):
        logger = logging.getLogger(name)
        logger.setLevel(logging.WARNING)
        logger.handlers.clear()  # its own handler would print each line twice
    for pattern in (
        ".*does not have many workers.*",
        ".*ended before the epoch ended.*",
        ".*in eval mode at the start of training.*",
        ".*isinstance.treespec, LeafSpec.*",
        ".*smaller than the logging interval.*",
        ".*recommended to use .*sync_dist=True.*",  # the metrics have gathered over the ranks themselves
    ):
        warnings.filterwarnings("ignore", message=pattern)
