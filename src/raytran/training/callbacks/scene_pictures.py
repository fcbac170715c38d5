# SPDX-License-Identifier: Apache-2.0
"""Pictures of the same scenes after every validation, in the run's folder and in loggers that show images."""

from __future__ import annotations

import contextlib
import logging
import shutil
from pathlib import Path
from typing import Any

import lightning.pytorch as pl
import torch
from lightning.pytorch.loggers import TensorBoardLogger, WandbLogger
from scipy.spatial import QhullError

from raytran.data.collate import collate_scenes
from raytran.data.files import disk_full, finished_folder
from raytran.data.images import decode_image
from raytran.data.views import choose_even
from raytran.heads.score_scaling import SCORE_THRESHOLD
from raytran.model import inputs_of
from raytran.pictures.scene_pictures import draw_scene
from raytran.postprocess import DUPLICATE_IOU, select_objects
from raytran.structs import SceneBatch, ScenePrediction
from raytran.training.lightning_module import Reconstruction
from raytran.training.loggers import ContinuedMLFlow

_log = logging.getLogger(__name__)


class ScenePictures(pl.Callback):
    """Draws a few validation scenes, spread evenly over the split, after every validation.

    The first rank alone predicts and draws them; the other ranks wait for it in the next step. Files go to
    ``<folder>/step-000300/<scene>``. TensorBoard gets the images; W&B those, the boxes in 3D, and a table of
    predicted and true objects.

    Args:
        folder: for the pictures.
        scenes: how many scenes.
    """

    def __init__(self, folder: Path, *, scenes: int) -> None:
        self._folder = folder
        self._scenes = scenes

    def on_validation_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Draw and log."""
        dataset = getattr(trainer.val_dataloaders, "dataset", None)
        if not isinstance(pl_module, Reconstruction) or dataset is None:
            return
        if trainer.sanity_checking or not trainer.is_global_zero:
            return
        step, found = trainer.global_step, self._predict(pl_module, dataset)
        grid_extent = pl_module.model.grid_extent
        try:
            pictures = self._draw(found, step, grid_extent)
        except OSError as error:
            if disk_full(error) is None:
                raise
            _log.warning("no pictures of step %d (%s): make room in %s", step, error.strerror, self._folder)
            return
        except (ValueError, ArithmeticError, QhullError) as error:
            # Early in training boxes may have no extent, for instance: no reason to end a run.
            _log.warning("no pictures of step %d: %s", step, str(error).splitlines()[0])
            return
        logged_at = step - 1  # where Lightning, which counts logged steps from 0, puts the scores
        for logger in trainer.loggers:
            if isinstance(logger, TensorBoardLogger):
                with contextlib.suppress(OSError):  # the logger says so
                    _log_tensorboard(logger, pictures, logged_at)
            elif isinstance(logger, WandbLogger):
                _log_wandb(logger, pictures, found, logged_at, grid_extent)
            elif isinstance(logger, ContinuedMLFlow):
                logger.log_pictures(pictures, step)

    @torch.no_grad()
    def _predict(self, module: Reconstruction, dataset: Any) -> list[tuple[SceneBatch, ScenePrediction]]:
        """Return the scenes, always the same ones, and the network's present predictions for them."""
        chosen = dict.fromkeys(choose_even(len(dataset), min(self._scenes, len(dataset))).tolist())
        stage, found = module.stage, []
        for index in chosen:
            batch = collate_scenes([dataset[index]])
            with module.trainer.precision_plugin.val_step_context():
                raw = module.model(**inputs_of(batch.to(module.device)), tasks=stage.tasks)
            (prediction,) = module.model.decode(raw, batch.scene_id, with_shapes="shape" in stage.terms)
            prediction = select_objects(
                prediction, score_threshold=SCORE_THRESHOLD, duplicate_iou=DUPLICATE_IOU
            )
            found.append((batch, prediction.to("cpu")))
        return found

    def _draw(
        self,
        found: list[tuple[SceneBatch, ScenePrediction]],
        step: int,
        grid_extent: tuple[float, float, float],
    ) -> dict[str, Path]:
        """Return the file of each picture by name, ``<scene>/masks`` and so on."""
        final = self._folder / f"step-{step:06d}"
        self._folder.mkdir(parents=True, exist_ok=True)
        if final.is_dir():
            shutil.rmtree(final)  # a resumed run repeats this validation
        pictures: dict[str, Path] = {}
        with finished_folder(final) as folder:
            for batch, prediction in found:
                name = prediction.scene_id
                drawn = draw_scene(folder / name, batch, prediction, grid_extent=grid_extent)
                pictures |= {f"{name}/{kind}": final / name / path.name for kind, path in drawn.items()}
        return pictures


def _log_tensorboard(logger: TensorBoardLogger, pictures: dict[str, Path], step: int) -> None:
    for name, path in pictures.items():
        image = decode_image(path, name=str(path)).permute(1, 2, 0).numpy()
        logger.experiment.add_image(f"pictures/{name}", image, step, dataformats="HWC")
    logger.experiment.flush()


def _log_wandb(
    logger: WandbLogger,
    pictures: dict[str, Path],
    found: list[tuple[SceneBatch, ScenePrediction]],
    step: int,
    grid_extent: tuple[float, float, float],
) -> None:
    # Here, so that runs without W&B do not wait for its import.
    import wandb

    from raytran.training.wandb_scene import object_table, scene_in_3d

    values: dict[str, Any] = {f"pictures/{name}": wandb.Image(str(path)) for name, path in pictures.items()}
    with_objects = [pair for pair in found if pair[0].objects is not None]
    for batch, prediction in with_objects:
        values[f"pictures/{prediction.scene_id}/scene"] = scene_in_3d(batch, prediction, grid_extent)
    if with_objects:
        values["pictures/objects"] = object_table(with_objects)
    logger.log_metrics(values, step=step)
