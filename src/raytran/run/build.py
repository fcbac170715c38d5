# SPDX-License-Identifier: Apache-2.0
"""From a config to the objects that it describes."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import lightning.pytorch as pl
import torch
from hydra.utils import instantiate
from lightning.pytorch.callbacks import TQDMProgressBar
from omegaconf import DictConfig, OmegaConf

from raytran.run.folders import LAST
from raytran.run.settings import RunConfig
from raytran.training.callbacks.last_checkpoint import LastCheckpoint
from raytran.training.callbacks.stage_setup import StageSetup
from raytran.training.callbacks.step_progress import StepProgress
from raytran.training.checkpoint_io import AtomicCheckpointIO
from raytran.training.datamodule import SceneDataModule
from raytran.training.reconstruction import Reconstruction

if TYPE_CHECKING:
    from raytran.model import RayTran


def plain(node: Any) -> Any:
    """Return a config node as plain Python, interpolations resolved."""
    return OmegaConf.to_container(node, resolve=True)


def build_model(cfg: DictConfig, *, pretrained: bool = True) -> RayTran:
    """Return the network.

    Args:
        cfg: the root config.
        pretrained: False leaves out the image encoder's own weights, because a checkpoint will fill it.
    """
    config = plain(cfg.model)
    if not pretrained:
        config["backbone"]["resnet"]["weights"] = None
    return instantiate(config, _convert_="all")


def build_module(cfg: DictConfig, model: RayTran) -> Reconstruction:
    """Return the LightningModule around ``model``."""
    return Reconstruction(
        model=model,
        loss=instantiate(cfg.loss, _convert_="all"),
        stage=instantiate(cfg.stage, _convert_="all"),
        optimization=instantiate(cfg.optimizer, _convert_="all"),
        compiled=cfg.compile,
    )


def build_data(cfg: DictConfig) -> SceneDataModule:
    """Return the data module."""
    return instantiate(cfg.data, _convert_="all")


def build_trainer(cfg: DictConfig, run: RunConfig, card: dict[str, Any]) -> pl.Trainer:
    """Return Lightning's Trainer with the callbacks of every run.

    Args:
        cfg: the root config.
        run: the same config's switches.
        card: what each checkpoint carries.
    """
    settings = plain(cfg.trainer)
    if settings["precision"] == "auto":
        settings["precision"] = "16-mixed" if torch.cuda.is_available() else "32-true"
    folder = Path(run.output_dir)
    callbacks: list[pl.Callback] = [
        StageSetup(),
        LastCheckpoint(folder / LAST, every_n_steps=run.checkpoint_every, card=card),
    ]
    if run.progress_bar == "rich":
        callbacks.append(StepProgress(f"stage {card['stage']}"))
    elif run.progress_bar == "tqdm":
        callbacks.append(TQDMProgressBar())
    return instantiate(
        settings,
        default_root_dir=str(folder),
        logger=[instantiate(logger, _convert_="all") for logger in plain(cfg.logger).values()],
        callbacks=callbacks,
        plugins=[AtomicCheckpointIO()],
        enable_progress_bar=run.progress_bar == "tqdm",
        _convert_="all",
    )
