# SPDX-License-Identifier: Apache-2.0
"""How good a model is on annotated scenes: numbers in all, by scene and by object."""

from __future__ import annotations

import json
import logging
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any, cast

import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig
from rich.console import Console
from rich.progress import track
from rich.table import Table
from torch.utils.data import Dataset, Subset

from raytran.checkpoints.checkpoint import PredictionSettings, load_model, prediction_settings
from raytran.checkpoints.network import trusted_packages
from raytran.data.views import RepeatedFrames
from raytran.errors import ConfigError
from raytran.metrics.accuracy_curves import accuracy_by_scene_size
from raytran.model import RayTran
from raytran.pictures.accuracy_curves import FILE as FIGURE
from raytran.run.device import choose_device, set_matmul_precision
from raytran.run.entry import compose
from raytran.run.evaluate.figure import Curves, draw_figure, read_curves
from raytran.run.evaluate.score import score, write_csv
from raytran.run.evaluate.views import FILES, evaluate_views, views_table
from raytran.run.output import check_replaceable, replaced_folder
from raytran.run.train.build import build_data
from raytran.structs import SceneBatch
from raytran.training.datamodule import SceneDataModule
from raytran.training.scores import DUPLICATE_IOU, SCORE_THRESHOLD, SceneScores

_log = logging.getLogger(__name__)

MARKER = "metrics.json"
TASKS = ("objects", "occupancy", "foreground")
TASKS_WITH_SHAPE = (*TASKS, "shape")


def evaluate(cfg: DictConfig) -> dict[str, Any]:
    """Run ``python -m raytran.evaluate``; see ``conf/evaluate.yaml``.

    Returns:
        The content of ``metrics.json``.

    Raises:
        CheckpointError: the checkpoint is missing or damaged.
        DataError: the data are missing or damaged.
        ConfigError: ``output`` holds something that is no earlier result.
    """
    if (cfg.checkpoint is None) == (cfg.predictions is None):
        raise ConfigError("give either checkpoint=CKPT or predictions=DIR annotations=FILE, not both")
    beside = read_curves(cfg.draw_with)
    if cfg.predictions is not None:
        return score(cfg, beside)
    output = Path(cfg.output)
    check_replaceable(output.resolve(), marker=MARKER)
    settings = prediction_settings(cfg.checkpoint)
    model = _network(cfg)
    cfg = _in_its_preset(cfg, settings)
    # The stages before it leave the shape head untrained.
    tasks = TASKS_WITH_SHAPE if settings.stage == "shape" else TASKS
    _make_data_fit(cfg, settings, model, tasks)
    data = build_data(cfg)
    data.prepare_data()
    scenes = with_at_most(cfg.max_objects, data.split(cfg.split))
    title = f"{cfg.split} scenes of {data.root}, {cfg.views.num_views} frames each"
    about = about_data(data, cfg.split, cfg.views.num_views) | {
        "checkpoint": str(cfg.checkpoint),
        "max_objects": cfg.max_objects,
    }
    if settings.stage == "view":
        metrics = evaluate_views(model, scenes, output=output, views_at_once=cfg.views_at_once, about=about)
        Console().print(views_table(metrics, title=f"{settings.preset}, {title}"))
        _log.info("wrote %s: %s", output.resolve(), ", ".join(FILES))
        return metrics
    metrics = evaluate_model(
        model,
        scenes,
        tasks=tasks,
        output=output,
        score_threshold=cfg.score_threshold,
        duplicate_iou=cfg.duplicate_iou,
        views_at_once=cfg.views_at_once,
        about=about,
        beside=beside,
    )
    Console().print(metrics_table(metrics, title=f"{settings.preset}, {title}"))
    _log.info("wrote %s: metrics.json, per_scene.csv, per_object.csv, %s", output.resolve(), FIGURE)
    return metrics


def about_data(data: SceneDataModule, split: str, num_views: int) -> dict[str, Any]:
    """Return what ``metrics.json`` says of the scenes: data set, folder, split, and frames that went in."""
    return {"dataset": data.name, "data": str(data.root), "split": split, "num_views": num_views}


def _network(cfg: DictConfig) -> RayTran:
    """Return the network of the checkpoint on its device."""
    device = choose_device(cfg.device)
    set_matmul_precision(cfg.matmul_precision, device)
    model = load_model(cfg.checkpoint, attention=cfg.attention, trust=trusted_packages(cfg.trust))
    return model.to(device)


def _in_its_preset(cfg: DictConfig, settings: PredictionSettings) -> DictConfig:
    """Return the config in the checkpoint's preset, unless another was typed."""
    overrides = list(HydraConfig.get().overrides.task)
    if not any(item.startswith("preset=") for item in overrides):
        cfg = compose("evaluate", [*overrides, f"preset={settings.preset}"])
    cfg.split = cfg.split or "val"
    return cfg


def _make_data_fit(
    cfg: DictConfig, settings: PredictionSettings, model: RayTran, tasks: Collection[str]
) -> None:
    """Ask for the data that a model wants: the checkpoint, not the preset, says which it was made for."""
    cfg.views.image_size = list(settings.image_size)
    cfg.views.num_views = cfg.num_views or settings.num_views
    if "shape" in tasks:
        cfg.stage.targets = [*cfg.stage.targets, "shapes"]
    if settings.stage == "view":
        cfg.stage.targets = []
    else:
        cfg.stage.new_views = 0
    cfg.model.grid_resolution, cfg.model.grid_extent = list(model.grid_resolution), list(model.grid_extent)
    # One that was trained with true masks as a fourth channel gets the same here, unless another is typed.
    mask = cfg.data.dataset.input_mask or settings.input_mask or "amodal"
    cfg.data.dataset.input_mask = mask if model.backbone.resnet.input_channels == 4 else None


def with_at_most(max_objects: int | None, dataset: Any) -> Dataset[SceneBatch]:
    """Return the scenes with at most so many objects; all of them for None.

    Args:
        max_objects: largest number of annotated objects.
        dataset: scenes, with ``num_objects(index)``.

    Raises:
        ConfigError: no scene has so few.
    """
    if max_objects is None:
        return cast("Dataset[SceneBatch]", dataset)
    chosen = [index for index in range(len(dataset)) if dataset.num_objects(index) <= max_objects]
    if not chosen:
        raise ConfigError(f"no scene has at most {max_objects} objects: choose a larger max_objects")
    _log.info("%d of %d scenes have at most %d objects", len(chosen), len(dataset), max_objects)
    return Subset(dataset, chosen)


def evaluate_model(
    model: RayTran,
    dataset: Dataset[SceneBatch],
    *,
    tasks: Collection[str] = TASKS,
    output: Path | None = None,
    score_threshold: float = SCORE_THRESHOLD,
    duplicate_iou: float | None = DUPLICATE_IOU,
    views_at_once: int | None = None,
    about: Mapping[str, Any] | None = None,
    beside: Mapping[str, Curves] | None = None,
    progress: bool = True,
) -> dict[str, Any]:
    """Predict every scene of a data set and compare with its annotation.

    Args:
        model: the network, on any device; put in evaluation mode.
        dataset: scenes with targets, each a ``SceneBatch`` with B = 1.
        tasks: what to compare: ``TASKS``, or with the shapes of the objects found ``TASKS_WITH_SHAPE``, for
            which the scenes must have shapes.
        output: folder for ``metrics.json``, ``per_scene.csv``, ``per_object.csv`` and
            ``accuracy_curves.png``, which appear together or not at all; None writes nothing.
        score_threshold: objects with a lower score do not count as predicted.
        duplicate_iou: nor does one that overlaps a surer one of its class by more than this IoU.
        views_at_once: views that pass through the network together, None for all.
        about: what to say beside the numbers, e.g. the checkpoint.
        beside: accuracy curves of other results for the figure, by name.
        progress: show a progress bar.

    Returns:
        per protocol (``strict``) what ``Scan2CADAccuracy`` and ``OrientedBoxF1`` return, with the accuracy
        ``by_scene_size``, the ``curves`` and the error ``atlas``; ``occupancy_iou``, ``foreground_iou``,
        under ``shape`` what ``MatchedShapeScores`` returns, and what ``about`` says.
    """
    device = next(model.parameters()).device
    scores = SceneScores(
        tasks=tasks,
        score_threshold=score_threshold,
        duplicate_iou=duplicate_iou,
        volume_extent=model.grid_extent,
    ).to(device)
    model.eval()
    repeated = RepeatedFrames()
    for index in track(range(len(dataset)), "evaluating", disable=not progress, transient=True):  # type: ignore[arg-type]
        batch = dataset[index]
        repeated.look(batch)
        _predict_and_compare(model, batch.to(device), scores, score_threshold, views_at_once)
    settings = {"score_threshold": score_threshold, "duplicate_iou": duplicate_iou}
    metrics = {**(about or {}), **settings, **_by_protocol(scores)}
    if output is not None:
        with replaced_folder(output, marker=MARKER) as folder:
            (folder / MARKER).write_text(json.dumps(metrics, indent=2) + "\n")
            write_csv(folder / "per_scene.csv", scores.rows("scene"))
            write_csv(folder / "per_object.csv", scores.rows("object"))
            draw_figure(folder, output.name, metrics["strict"]["curves"], beside or {})
    return metrics


@torch.no_grad()
def _predict_and_compare(
    model: RayTran,
    batch: SceneBatch,
    scores: SceneScores,
    score_threshold: float,
    views_at_once: int | None,
) -> None:
    raw = model(batch.views, tasks=TASKS, grid_center=batch.grid_center, views_at_once=views_at_once)
    scores.update(batch, model.decode(raw, batch.scene_id, with_shapes=False))
    if scores.shape is not None:
        scores.update_shapes(batch, model.decode(raw, batch.scene_id, score_threshold=score_threshold))


def _by_protocol(scores: SceneScores) -> dict[str, Any]:
    """Return what all metrics say in the layout of ``metrics.json``."""
    found = scores.results()
    strict = found["accuracy"] | {"per_threshold": found["box_f1"]["per_threshold"]}
    strict["by_scene_size"] = accuracy_by_scene_size(scores.rows("object"))
    strict |= {"curves": found["curves"], "atlas": found["atlas"]}
    metrics: dict[str, Any] = {"strict": strict}
    metrics |= {f"{task}_iou": found[task] for task in ("occupancy", "foreground") if task in found}
    return metrics | ({"shape": found["shape"]} if "shape" in found else {})


def metrics_table(metrics: Mapping[str, Any], *, title: str) -> Table:
    """Return the numbers as a table for the terminal."""
    table = Table("class", "found", "objects", "accuracy", title=title)
    accuracy = metrics["strict"]
    for name, entry in accuracy["per_class"].items():
        if entry["n_total"]:
            table.add_row(name, str(entry["n_good"]), str(entry["n_total"]), f"{entry['accuracy']:.1%}")
    table.add_section()
    table.add_row("mean of classes", "", "", f"{accuracy['class_average']:.1%}")
    table.add_row(
        "all objects", str(accuracy["n_good"]), str(accuracy["n_total"]), f"{accuracy['global_average']:.1%}"
    )
    table.add_section()
    for threshold, entry in metrics["strict"]["per_threshold"].items():
        table.add_row(
            f"F1 at IoU {threshold}", str(entry["n_matched"]), str(entry["n_true"]), f"{entry['f1']:.3f}"
        )
    for task in ("occupancy", "foreground"):
        if f"{task}_iou" in metrics:
            table.add_row(f"IoU of {task}", "", "", f"{metrics[f'{task}_iou']:.3f}")
    if metrics.get("shape", {}).get("n_matched"):
        shape, iou = metrics["shape"], f"{metrics['shape']['iou']:.3f}"
        table.add_row("IoU of found objects' shapes", str(shape["n_matched"]), "", iou)
        if shape["chamfer_distance"] is not None:
            table.add_row("chamfer distance of these", "", "", f"{100 * shape['chamfer_distance']:.1f} cm")
    return table
