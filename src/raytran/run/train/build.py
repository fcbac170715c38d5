# SPDX-License-Identifier: Apache-2.0
"""From a config to the objects that it describes."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import lightning.pytorch as pl
import torch
from hydra.errors import InstantiationException
from hydra.utils import instantiate
from lightning.pytorch.callbacks import EarlyStopping, LearningRateMonitor, ModelCheckpoint
from lightning.pytorch.utilities.exceptions import MisconfigurationException
from omegaconf import DictConfig, OmegaConf

from raytran.checkpoints.file import BEST_NAME
from raytran.checkpoints.network import without_sources
from raytran.checkpoints.runs import LAST
from raytran.checkpoints.sweeps import varied_settings
from raytran.errors import ConfigError
from raytran.run.path_settings import without_references
from raytran.run.train.settings import RunConfig, does_compile
from raytran.training.callbacks.averaged_weights import AveragedWeights
from raytran.training.callbacks.health import Health
from raytran.training.callbacks.last_checkpoint import BestCheckpoint, LastCheckpoint
from raytran.training.callbacks.run_checks import EffectiveBatch, RankAgreement, RepeatedFramesWarning
from raytran.training.callbacks.scene_pictures import ScenePictures
from raytran.training.callbacks.stage import StageCallback
from raytran.training.callbacks.step_progress import LossBar, StepProgress
from raytran.training.callbacks.telemetry import RunSettings, Telemetry
from raytran.training.checkpoint_io import AtomicCheckpointIO
from raytran.training.datamodule import SceneDataModule
from raytran.training.history import METRICS
from raytran.training.lightning_module import Reconstruction
from raytran.training.loggers import MetricsTable
from raytran.training.ranks import SyncedBatchNorm

if TYPE_CHECKING:
    from raytran.model import RayTran

PRECISIONS = ("auto", "bf16-mixed", "16-mixed", "32-true")
DETERMINISTIC = (True, False, "warn")


def plain(node: Any) -> Any:
    """Return a config node as plain Python, interpolations resolved."""
    return OmegaConf.to_container(node, resolve=True)


def _literal(node: Any) -> Any:
    """Return plain Python whose texts ``instantiate`` hands on as they are, with ``${`` in them too."""
    if isinstance(node, dict):
        return {key: _literal(value) for key, value in node.items()}
    if isinstance(node, list):
        return [_literal(value) for value in node]
    # Hydra has OmegaConf read every text twice.
    return without_references(without_references(node)) if isinstance(node, str) else node


def build_model(cfg: DictConfig, *, pretrained: bool = True) -> RayTran:
    """Return the network.

    Args:
        cfg: the root config.
        pretrained: False leaves out the image encoder's own weights, because a checkpoint will fill it.
    """
    config = plain(cfg.model)
    return instantiate(_literal(config if pretrained else without_sources(config)), _convert_="all")


def build_module(cfg: DictConfig, model: RayTran) -> Reconstruction:
    """Return the LightningModule around ``model``."""
    return Reconstruction(
        model=model,
        loss=instantiate(cfg.loss, _convert_="all"),
        stage=instantiate(cfg.stage, _convert_="all"),
        optimization=instantiate(cfg.optimizer, _convert_="all"),
        compiled=does_compile(cfg.compile),
        metrics=instantiate(cfg.get("metrics", {}), _convert_="all"),
        map_boxes=cfg.get("map_boxes"),
    )


def build_data(cfg: DictConfig) -> SceneDataModule:
    """Return the data module."""
    return instantiate(_literal(plain(cfg.data)), _convert_="all")


def choose_precision(precision: str, *, on_cpu: bool) -> str:
    """Return what ``auto`` means: bf16-mixed on GPUs that compute with it, 16-mixed on others, else 32-true.

    Raises:
        ConfigError: there is no such precision, or none on a CPU.
    """
    if precision not in PRECISIONS or (on_cpu and precision == "16-mixed"):
        choices = [name for name in PRECISIONS if not (on_cpu and name == "16-mixed")]
        raise ConfigError(f"unknown precision={precision} here: choose one of {', '.join(choices)}")
    if precision != "auto":
        return precision
    if on_cpu:
        return "32-true"
    return "bf16-mixed" if torch.cuda.is_bf16_supported(including_emulation=False) else "16-mixed"


def build_trainer(
    cfg: DictConfig, run: RunConfig, metadata: dict[str, Any], stage: StageCallback
) -> pl.Trainer:
    """Return Lightning's Trainer with the callbacks of every run.

    Args:
        cfg: the root config.
        run: the same config's switches.
        metadata: what each checkpoint carries.
        stage: what the stage is.

    Raises:
        ConfigError: a setting has no meaning.
    """
    settings = plain(cfg.trainer)
    if settings["deterministic"] not in DETERMINISTIC:  # Lightning takes anything else for false
        raise ConfigError(
            f"unknown trainer.deterministic={settings['deterministic']}: choose true, false or warn"
        )
    on_cpu = settings["accelerator"] == "cpu" or not torch.cuda.is_available()
    settings["precision"] = choose_precision(str(settings["precision"]), on_cpu=on_cpu)
    # Lightning counts batches here, and the configs steps.
    settings["val_check_interval"] *= settings["accumulate_grad_batches"]
    if settings["accumulate_grad_batches"] > 1 and isinstance(settings["strategy"], dict):
        # A static graph is learned in the first backward pass, which here exchanges nothing.
        settings["strategy"]["static_graph"] = False
    folder = Path(run.output_dir)
    callbacks: list[pl.Callback] = [
        stage,
        EffectiveBatch(per_device=cfg.data.batch_size, expected=cfg.schedule.batch),
        RankAgreement(),
        RepeatedFramesWarning(),
        LastCheckpoint(folder / LAST, every_n_steps=run.checkpoint_every, metadata=metadata),
        *_monitors(cfg, folder, metadata["config"]),
        *_averaged_weights(cfg),
        *_judges(cfg, folder),
    ]
    settings["enable_checkpointing"] = any(isinstance(callback, ModelCheckpoint) for callback in callbacks)
    if run.progress_bar == "rich":
        callbacks.append(StepProgress(metadata["stage"]))
    elif run.progress_bar == "tqdm":
        callbacks.append(LossBar())
    loggers = [instantiate(logger, _convert_="all") for logger in plain(cfg.logger).values()]
    try:
        return instantiate(
            settings,
            default_root_dir=str(folder),
            logger=[MetricsTable(folder / METRICS), *loggers],
            callbacks=callbacks,
            plugins=[AtomicCheckpointIO(), *([SyncedBatchNorm(on_cpu=on_cpu)] if cfg.sync_norms else [])],
            enable_progress_bar=run.progress_bar == "tqdm",
            _convert_="all",
        )
    except InstantiationException as error:
        if isinstance(error.__cause__, MisconfigurationException):
            raise ConfigError(_no_trainer(settings, error.__cause__)) from error
        raise


def _no_trainer(settings: Mapping[str, Any], error: Exception) -> str:
    """Return what to say of a Trainer that Lightning refuses to build."""
    asked = f"trainer.accelerator={settings['accelerator']} trainer.devices={settings['devices']}"
    if settings["accelerator"] not in ("gpu", "cuda"):
        return f"{asked} will not do: {' '.join(str(error).split())}"
    count = torch.cuda.device_count() if torch.cuda.is_available() else 0
    if count == 0:
        return (
            f"{asked} asks for a GPU, and torch {torch.__version__} finds none here: give trainer=cpu, or "
            "trainer=ddp_cpu for two processes"
        )
    return f"{asked} asks for more than is here, {count} GPUs: give trainer.devices={count} or fewer"


def _averaged_weights(cfg: DictConfig) -> list[pl.Callback]:
    """Return the callback that averages the weights, if there is to be one.

    Raises:
        ConfigError: the decay is no share.
    """
    decay = cfg.ema.decay
    if decay is None:
        return []
    if isinstance(decay, bool) or not isinstance(decay, int | float) or not 0 < decay < 1:
        raise ConfigError(f"ema.decay must be above 0 and below 1, or null for no average, got {decay}")
    return [AveragedWeights(decay=decay)]


def _judges(cfg: DictConfig, folder: Path) -> list[pl.Callback]:
    """Return Lightning's callbacks that keep the best weights, and end a run that gets no better.

    Raises:
        ConfigError: a setting has no meaning.
    """
    metric, mode = cfg.optimized_metric, cfg.optimized_mode
    patience, threshold = cfg.early_stopping.patience, cfg.early_stopping.threshold
    if metric is None:
        return []
    if mode not in ("max", "min"):
        raise ConfigError(f"unknown optimized_mode={mode}: choose max or min")
    if not isinstance(patience, int) or patience < 0:
        raise ConfigError(
            f"early_stopping.patience must be a number of validations or 0 for never, got {patience}"
        )
    if threshold is not None and (isinstance(threshold, bool) or not isinstance(threshold, int | float)):
        raise ConfigError(f"early_stopping.threshold must be a number or null for none, got {threshold}")
    best = BestCheckpoint(
        dirpath=(folder / LAST).parent,
        filename=Path(BEST_NAME).stem,
        monitor=metric,
        mode=mode,
        enable_version_counter=False,
        save_on_train_epoch_end=False,
    )
    if not patience and threshold is None:
        return [best]
    stopping = EarlyStopping(
        metric,
        mode=mode,
        patience=patience or sys.maxsize,
        stopping_threshold=threshold,
        strict=False,
        check_on_train_epoch_end=False,
    )
    return [best, stopping]


def _monitors(cfg: DictConfig, folder: Path, settings: dict[str, Any]) -> list[pl.Callback]:
    """Return the callbacks that log how a run goes; of these Health alone acts, by skipping steps."""
    max_skipped, pictures = cfg.watch.max_skipped, cfg.watch.pictures
    if not isinstance(max_skipped, int) or max_skipped < 1:
        raise ConfigError(f"watch.max_skipped must be a number of steps, at least 1, got {max_skipped}")
    if not isinstance(pictures, int) or pictures < 0:
        raise ConfigError(f"watch.pictures must be a number of scenes or 0 for none, got {pictures}")
    monitors = [
        Health(max_skipped=max_skipped),
        Telemetry(),
        LearningRateMonitor(),
        RunSettings(
            settings,
            metric=cfg.get("optimized_metric"),
            first=[*varied_settings(folder), "experiment", "preset", "seed"],
        ),
    ]
    return [*monitors, ScenePictures(folder / "pictures", scenes=pictures)] if pictures else monitors
