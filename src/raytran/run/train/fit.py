# SPDX-License-Identifier: Apache-2.0
"""One stage, one fit: start it, continue it, mark it as finished."""

from __future__ import annotations

import logging
import time
import warnings
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import lightning.pytorch as pl
from lightning.pytorch.utilities import rank_zero_only
from lightning.pytorch.utilities.exceptions import SIGTERMException
from omegaconf import DictConfig, OmegaConf

from raytran.checkpoints.file import read_checkpoint, read_newest
from raytran.checkpoints.load import classes_of, load_weights
from raytran.checkpoints.metadata import DataIdentity, checkpoint_metadata, provenance
from raytran.checkpoints.runs import FINISHED, LAST, one_at_a_time, read_finished, write_finished
from raytran.classes import Classes
from raytran.data.files import write_json, write_text
from raytran.errors import CheckpointError, ConfigError
from raytran.run.device import cudnn_warning, device_name, set_matmul_precision
from raytran.run.train.build import build_data, build_model, build_module, build_trainer, plain
from raytran.run.train.learning_rate import find_learning_rate
from raytran.run.train.memory import explained_out_of_memory
from raytran.run.train.parent import find_parent, stage_of, stages_after
from raytran.run.train.rank_processes import rank_processes
from raytran.run.train.settings import CONFIG, RunConfig, given_steps
from raytran.run.train.start_report import changed_settings, start_report
from raytran.training.callbacks.stage import StageCallback
from raytran.training.callbacks.stop_signals import StopRequestedError
from raytran.training.lightning_module import Reconstruction
from raytran.training.stage import Stage

if TYPE_CHECKING:
    from raytran.model import RayTran

_log = logging.getLogger(__name__)

_RATE = "optimizer.learning_rate"

RANDOM_ENCODER = (
    "IMAGE ENCODER STARTS FROM RANDOM WEIGHTS: model.backbone.encoder.weights=auto found no ImageNet weights"
)
"""In every checkpoint that comes of such a start, those of later stages included."""


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
    with one_at_a_time(folder) if _is_first_rank() else nullcontext():
        return _finished_before(run, folder, steps=cfg.trainer.max_steps) or _train(cfg, run, folder)


def _train(cfg: DictConfig, run: RunConfig, folder: Path) -> FitResult:
    """Train what is left to train."""
    pl.seed_everything(run.seed, workers=True, verbose=False)
    _quiet()
    if cfg.lr_find:
        cfg = _with_found_learning_rate(cfg, run)
    config = plain(cfg)
    start = _start(cfg, run)
    module = start.module
    metadata = checkpoint_metadata(
        stage=module.stage.name,
        preset=run.preset,
        config=config,
        parent=start.stage.parent,
        warnings=start.stage.warnings,
    )
    trainer = build_trainer(cfg, run, metadata, start.stage)
    device = trainer.strategy.root_device
    set_matmul_precision(run.matmul_precision, device)
    data = build_data(cfg)
    if trainer.is_global_zero:
        _describe_run(cfg, folder)
    devices = (
        device_name(device) if trainer.world_size == 1 else f"{trainer.world_size} x {device_name(device)}"
    )
    _log.info("%s, %d steps on %s, in %s", module.stage.name, trainer.max_steps, devices, folder)
    for line in start_report(module.stage, module.model, metadata, trust=run.trust):
        _log.info("%s", line)
    warning = cudnn_warning(device, str(trainer.precision))
    if warning is not None:
        _log.warning("%s", warning)
    began = time.monotonic()
    try:
        with explained_out_of_memory(cfg), rank_processes(trainer):
            trainer.fit(module, data, ckpt_path=start.resume_from)
    except StopRequestedError as stop:
        # One rank tells the shell; Lightning and torchrun would take codes of the others for a crash.
        raise SystemExit(128 + stop.signum if trainer.is_global_zero else 0) from stop
    except SystemExit as stop:
        # Before the first step, or at the second Ctrl-C, Lightning turns a signal into an exit of its own.
        raise SystemExit(143 if isinstance(stop, SIGTERMException) else 130) from stop
    seconds = time.monotonic() - began
    if trainer.is_global_zero:
        write_finished(
            folder,
            stage=module.stage.name,
            preset=run.preset,
            experiment=run.experiment,
            steps=trainer.global_step,
            data=DataIdentity.of_config(config).as_plain(),
        )
    metrics = {name: float(value) for name, value in trainer.logged_metrics.items()}
    _log.info("%s finished after %.0f s: %s", module.stage.name, seconds, folder / LAST)
    return FitResult(folder, folder / LAST, trainer.global_step, seconds, metrics)


def _with_found_learning_rate(cfg: DictConfig, run: RunConfig) -> DictConfig:
    """Return the settings with a learning rate that was searched for, or that a resumed run has found before.

    The run that follows is the one with that rate typed, to the last bit.
    """
    found = _to_continue(run)
    before = (
        None if found is None else OmegaConf.select(OmegaConf.create(found[1].get("config") or {}), _RATE)
    )
    if before is None:
        start = _start(cfg, run)
        before = find_learning_rate(cfg, start.module, start.stage)
        pl.seed_everything(run.seed, workers=True, verbose=False)
    cfg = cfg.copy()
    OmegaConf.update(cfg, _RATE, float(before))
    return cfg


def _finished_before(run: RunConfig, folder: Path, *, steps: int) -> FitResult | None:
    """Return the result of a run that needs nothing more, None if there is work to do.

    A run that has taken all the steps it was given goes on if it is given more; it then is unfinished again.

    Args:
        run: the switches of the run.
        folder: of the run.
        steps: how many it is to take in all, as of Lightning's ``max_steps``.
    """
    # In this order: the first of torchrun's ranks removes the mark before it writes down its own settings.
    given = given_steps(folder)
    finished = read_finished(folder)
    if run.resume == "none":
        if finished is not None or (folder / LAST).is_file():
            raise ConfigError(
                f"{folder} holds a run already: continue it with resume=auto or choose another output_dir"
            )
        return None
    if finished is None:
        return None
    before = given or finished.steps
    if before >= 0 and not 0 <= steps <= before:
        _log.info("%s has finished with %d steps and goes on", folder, finished.steps)
        if _is_first_rank():
            (folder / FINISHED).unlink(missing_ok=True)
        return None
    _log.info("%s has finished already (%s, %d steps)", folder, finished.stage, finished.steps)
    return FitResult(folder, folder / finished.checkpoint, finished.steps, 0.0, {})


class _Start(NamedTuple):
    """Where a fit begins.

    Attributes:
        module: what is trained.
        stage: what the stage is; it takes the parent's weights.
        resume_from: the checkpoint of the run to go on with, None for a new run.
    """

    module: Reconstruction
    stage: StageCallback
    resume_from: Path | None


def _start(cfg: DictConfig, run: RunConfig) -> _Start:
    """Return what a resumed or a new run begins with."""
    stage = stage_of(cfg)
    next_stages = stages_after(stage)
    found = _to_continue(run)
    if found is not None:
        path, content = found
        module = _resumed_module(cfg, stage, path, content)
        callback = StageCallback(
            parent_of_resumed=content.get("parent"),
            warnings=content.get("warnings") or (),
            next_stages=next_stages,
        )
        return _Start(module, callback, path)
    parent = find_parent(run, stage, DataIdentity.of_config(plain(cfg)))
    if parent is None:
        model = build_model(cfg)
        callback = StageCallback(warnings=_warnings(model), next_stages=next_stages)
        return _Start(build_module(cfg, model), callback, None)
    # Before the network is built: a parent that is refused is told at once.
    callback = StageCallback(parent=parent, stage=stage, check=run.check_parent, next_stages=next_stages)
    return _Start(build_module(cfg, build_model(cfg, pretrained=False)), callback, None)


def _resumed_module(cfg: DictConfig, stage: Stage, path: Path, content: dict[str, Any]) -> Reconstruction:
    """Return the module with the weights of the checkpoint at ``path``, from which the run goes on."""
    if "resume" not in content:
        raise CheckpointError(
            f"{path} holds weights but no state of training: start a new run with init_from={path}"
        )
    if content["stage"] != stage.name:
        raise CheckpointError(
            f"{path} is of {content['stage']}, not {stage.name}: choose the experiment "
            f"that wrote it, or start a new run from its weights with init_from={path}"
        )
    difference = Classes.of(plain(cfg.classes)).difference(classes_of(content))
    if difference is not None:
        raise CheckpointError(
            f"{path} has {difference}: give the classes that the run began with, or start a new run from its "
            f"weights with init_from={path}"
        )
    module = build_module(cfg, build_model(cfg, pretrained=False))
    load_weights(module.model, content, path)
    _log.info("continuing from step %d of %s", content.get("global_step", 0), path)
    for line in changed_settings(content.get("config") or {}, plain(cfg)):
        _log.warning("continued with another setting, %s", line)
    return module


def _warnings(model: RayTran) -> list[str]:
    """Return what is to be known of the weights that a network starts from without any parent."""
    # An encoder of the user's own need not tell.
    return [RANDOM_ENCODER] if getattr(model.backbone.encoder, "random_fallback", False) else []


def _to_continue(run: RunConfig) -> tuple[Path, dict[str, Any]] | None:
    """Return the checkpoint to go on from and its content, None for a new run."""
    if run.resume == "none":
        return None
    if run.resume != "auto":
        return Path(run.resume), read_checkpoint(Path(run.resume))
    found = read_newest((Path(run.output_dir) / LAST).parent)
    if found is None:
        runs = Path(run.outputs) / run.preset / run.experiment
        # Where a folder was named, a curriculum's for one, there need not be anything yet.
        was_searched = Path(run.output_dir).resolve().parent == runs.resolve()
        level = logging.WARNING if was_searched else logging.INFO
        where = f"no unfinished run in {runs} has a checkpoint" if was_searched else "nothing to continue"
        _log.log(level, "%s: this is a new run, from the first step", where)
    return found


def _describe_run(cfg: DictConfig, folder: Path) -> None:
    """Write the resolved config and where the code comes from beside the results."""
    write_text(folder / CONFIG, OmegaConf.to_yaml(cfg, resolve=True))
    write_json(folder / "provenance.json", provenance())


def _is_first_rank() -> bool:
    return getattr(rank_zero_only, "rank", 0) == 0


def _quiet() -> None:
    """Silence Lightning's advice where we decided on purpose, and all ranks but the first."""
    if not _is_first_rank():
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
        ".*overridden `transfer_batch_to_device`.*",  # in the module, which serves any loader
        "Grad strides do not match bucket view strides.*",  # of a convolution to one channel
        ".*recommended to use .*sync_dist=True.*",  # the metrics have gathered over the ranks themselves
    ):
        warnings.filterwarnings("ignore", message=pattern)
