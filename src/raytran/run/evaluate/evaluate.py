# SPDX-License-Identifier: Apache-2.0
"""How good a model is on annotated scenes, or how good anybody's predictions are."""

from __future__ import annotations

import json
import logging
import shlex
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any, cast

import torch
from hydra.core.hydra_config import HydraConfig
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf
from rich.console import Console
from rich.progress import track
from torch.utils.data import Dataset, Subset
from torchmetrics import Metric

from raytran.checkpoints.file import checkpoint_path, file_digest
from raytran.checkpoints.load import PredictionSettings, load_model, prediction_settings
from raytran.checkpoints.network import trusted_packages
from raytran.classes import Classes
from raytran.data.views import RepeatedFrames
from raytran.errors import ConfigError
from raytran.geometry.camera import Cameras
from raytran.model import RayTran
from raytran.postprocess import DUPLICATE_IOU
from raytran.run.device import choose_device, device_name, set_matmul_precision
from raytran.run.entry import compose, typed_settings
from raytran.run.evaluate.results import MAP, MARKER, Evaluation, read_curves, result_tables, write_evaluation
from raytran.run.evaluate.score import ProtocolScores, confidence, evaluate_predictions
from raytran.run.output import one_writer
from raytran.run.train.build import build_data, plain
from raytran.structs import SceneBatch
from raytran.training.datamodule import SceneDataModule
from raytran.training.scores import SceneScores

_log = logging.getLogger(__name__)

TASKS = ("objects", "occupancy", "foreground")
TASKS_WITH_SHAPE = (*TASKS, "shape")
PROTOCOLS_OF_CHECKPOINTS = ("strict", MAP)
"""What ``protocol`` may be with a checkpoint; ``strict`` is always told."""

TASKS_OF_STAGE = {"stage3": TASKS_WITH_SHAPE, "novel_view": ("view",)}
"""What checkpoints of a stage are asked for, if not for ``TASKS``: the others leave shapes untrained."""


def evaluate(cfg: DictConfig) -> dict[str, Any]:
    """Run ``raytran evaluate``; see ``conf/evaluate.yaml``.

    Returns:
        The content of ``metrics.json``.

    Raises:
        CheckpointError: the checkpoint is missing or damaged.
        DataError: the data or the predictions are missing or damaged.
        ConfigError: a setting is missing or does not go with the others, or ``output`` holds something that
            is no earlier result.
    """
    if (cfg.checkpoint is None) == (cfg.predictions is None):
        raise ConfigError("give either checkpoint=CKPT or predictions=DIR annotations=FILE, not both")
    if cfg.num_resamples < 1:
        raise ConfigError(f"num_resamples={cfg.num_resamples} is too few, give at least 1")
    other_curves = read_curves(cfg.draw_with)
    output = Path(cfg.output)
    with one_writer(output, marker=MARKER):
        evaluation, title = _of_files(cfg) if cfg.checkpoint is None else _of_checkpoint(cfg)
        files = write_evaluation(output, evaluation, other_curves=other_curves)
    console = Console()
    for table in result_tables(evaluation, title=title):
        console.print(table)
    _log.info("wrote %s: %s", output.resolve(), ", ".join(files))
    if cfg.checkpoint is not None:
        _log.info("next: raytran predict SCENE %s", shlex.quote(f"checkpoint={cfg.checkpoint}"))
    return evaluation.metrics


def _of_files(cfg: DictConfig) -> tuple[Evaluation, str]:
    """Return the scores of ``predictions=`` and what was measured."""
    if cfg.annotations is None:
        raise ConfigError(
            "predictions= needs annotations=FILE, Scan2CAD's full_annotations.json, or with protocol=map a "
            "folder of true boxes"
        )
    paths = {name: None if cfg[name] is None else Path(cfg[name]) for name in ("compare", "split", "scans")}
    evaluation = evaluate_predictions(
        Path(cfg.predictions),
        Path(cfg.annotations),
        cfg.protocol,
        boxes=cfg.boxes,
        compare_with=paths["compare"],
        split=paths["split"],
        scans=paths["scans"],
        volume_extent=list(cfg.volume_extent),
        num_resamples=cfg.num_resamples,
        seed=cfg.seed,
        classes=Classes.of(plain(cfg.classes)),
    )
    return evaluation, str(cfg.predictions)


def _of_checkpoint(cfg: DictConfig) -> tuple[Evaluation, str]:
    """Return the scores of ``checkpoint=`` and what was measured."""
    if cfg.protocol not in PROTOCOLS_OF_CHECKPOINTS:
        known = " or ".join(PROTOCOLS_OF_CHECKPOINTS)
        raise ConfigError(f"protocol={cfg.protocol} is for predictions=, with checkpoint= choose {known}")
    settings = prediction_settings(cfg.checkpoint)
    device = choose_device(cfg.device)
    set_matmul_precision(cfg.matmul_precision, device)
    model = load_model(cfg.checkpoint, attention=cfg.attention, trust=trusted_packages(cfg.trust)).to(device)
    tasks = TASKS_OF_STAGE.get(settings.stage, TASKS)
    # The checkpoint says of which preset it is and which data it wants: composed again with that.
    classes = _classes_of_checkpoint(cfg, model)
    cfg = compose("evaluate", _overrides_of_checkpoint(cfg, settings, model, tasks))
    OmegaConf.update(cfg, "classes", classes.settings(), merge=False)
    split = cfg.split or "val"
    data = build_data(cfg)
    data.prepare_data()
    scenes = first_of(cfg.max_scenes, with_at_most(cfg.max_objects, data.split(split)))
    _log.info(
        "%s (preset %s, %s) on %s: %d %s scenes of %s",
        checkpoint_path(cfg.checkpoint),
        *(settings.preset, settings.stage, device_name(device)),
        *(len(scenes), split, data.root),  # type: ignore[arg-type]
    )
    evaluation = evaluate_model(
        model,
        scenes,
        tasks=tasks,
        score_threshold=cfg.score_threshold,
        duplicate_iou=cfg.duplicate_iou,
        views_at_once=cfg.views_at_once,
        num_resamples=cfg.num_resamples,
        seed=cfg.seed,
        metrics=instantiate(cfg.metrics, _convert_="all"),
        map_boxes=cfg.boxes if cfg.protocol == MAP else None,
        about=about_data(data, split, cfg.views.num_views)
        | {"max_objects": cfg.max_objects, "max_scenes": cfg.max_scenes}
        | about_network(cfg.checkpoint, model),
    )
    return evaluation, f"{settings.preset}, {split} scenes of {data.root}, {cfg.views.num_views} frames each"


def _classes_of_checkpoint(cfg: DictConfig, model: RayTran) -> Classes:
    """Return the network's classes, with the colours and categories that were typed.

    Raises:
        ConfigError: other names were typed, or something that is none.
    """
    typed = [item.lstrip("+") for item in typed_settings(HydraConfig.get())]
    given: dict[str, Any] = plain(cfg.classes)
    is_group = any(item.startswith("classes=") for item in typed)
    chosen = {
        name: value
        for name, value in given.items()
        if is_group or any(item.startswith(f"classes.{name}=") for item in typed)
    }
    names = Classes.of({"names": chosen.get("names", model.classes.names)})
    difference = names.difference(model.classes)
    if difference is not None:
        raise ConfigError(
            f"the network of {cfg.checkpoint} has {difference}, which are others than those given: leave "
            "classes out, they come from the checkpoint"
        )
    return Classes.of(model.classes.settings() | chosen)


def _overrides_of_checkpoint(
    cfg: DictConfig, settings: PredictionSettings, model: RayTran, tasks: Collection[str]
) -> list[str]:
    """Return what was typed and, as if typed too, the preset and the data that a checkpoint wants."""
    typed = typed_settings(HydraConfig.get())
    preset = [] if any(item.startswith("preset=") for item in typed) else [f"preset={settings.preset}"]
    wanted: dict[str, Any] = {
        "views.image_size": list(settings.image_size),
        "views.num_views": cfg.num_views or settings.num_views,
        "model.grid_resolution": list(model.grid_resolution),
        "model.grid_extent": list(model.grid_extent),
        "data.dataset.input_mask": None,
    }
    if "view" in tasks:
        wanted["stage.targets"] = []
    else:
        wanted["stage.new_views"] = 0
    if "shape" in tasks:
        wanted["stage.targets"] = [*cfg.stage.targets, "shapes"]
    if model.backbone.encoder.input_channels == 4:
        # Trained with true masks as a fourth channel, it gets the same here, unless others are typed.
        wanted["data.dataset.input_mask"] = cfg.data.dataset.input_mask or settings.input_mask or "amodal"
    return [*typed, *preset, *(f"{key}={json.dumps(value)}" for key, value in wanted.items())]


def about_data(data: SceneDataModule, split: str, num_views: int) -> dict[str, Any]:
    """Return what ``metrics.json`` says of the scenes: data set, folder, split, and frames that went in."""
    return {"dataset": data.name, "data": str(data.root), "split": split, "num_views": num_views}


def about_network(checkpoint: str | Path, model: RayTran) -> dict[str, Any]:
    """Return what ``metrics.json`` says of the network: its file, and how it scales its scores."""
    scaling = model.score_scaling
    return {
        "checkpoint": str(checkpoint),
        "checkpoint_sha256": file_digest(checkpoint_path(checkpoint)),
        "score_scaling": None if scaling is None else scaling.settings(),
    }


def first_of(max_scenes: int | None, dataset: Dataset[SceneBatch]) -> Dataset[SceneBatch]:
    """Return the first so many scenes; all of them for None, or if there are fewer."""
    if max_scenes is None or max_scenes >= len(dataset):  # type: ignore[arg-type]
        return dataset
    return Subset(dataset, range(max_scenes))


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


@torch.no_grad()
def evaluate_model(
    model: RayTran,
    dataset: Dataset[SceneBatch],
    *,
    tasks: Collection[str] = TASKS,
    score_threshold: float | None = None,
    duplicate_iou: float | None = DUPLICATE_IOU,
    views_at_once: int | None = None,
    num_resamples: int = 2000,
    seed: int = 0,
    metrics: Mapping[str, Metric] | None = None,
    map_boxes: str | None = None,
    about: Mapping[str, Any] | None = None,
    progress: bool = True,
) -> Evaluation:
    """Predict every scene of a data set and compare with its annotation.

    Args:
        model: the network, on any device; put in evaluation mode.
        dataset: scenes with targets, each a ``SceneBatch`` with B = 1.
        tasks: what to compare: ``TASKS``; with the shapes of the objects found ``TASKS_WITH_SHAPE``, for
            which the scenes must have shapes; or ``view`` alone, for which they must have ``new_views``.
        score_threshold: objects with a lower score do not count as predicted; None: the network's own, see
            ``RayTran.score_threshold``.
        duplicate_iou: nor does one that overlaps a surer one of its class by more than this IoU.
        views_at_once: frames that pass through the network together, None for all.
        num_resamples: draws of the bootstrap.
        seed: of the bootstrap.
        metrics: further ones by name, see ``SceneScores``.
        map_boxes: also follow protocol ``map``, with which boxes, see ``SceneScores``.
        about: what to say beside the numbers, e.g. the checkpoint.
        progress: show a progress bar.

    Returns:
        per protocol (``strict``) what ``Scan2CADAccuracy`` and ``OrientedBoxF1`` return, with ``confidence``
        intervals, the accuracy ``by_scene_size``, the ``curves``, the error ``atlas``, and the
        ``calibration`` of what counts as predicted (``counted``) and of ``every_score``; ``map`` with
        ``confidence`` intervals if it is asked for; ``occupancy_iou``,
        ``foreground_iou``, under ``shape`` what ``MatchedShapeScores`` returns, under ``new_views`` what
        ``NewViewScores`` does, each of ``metrics`` by its name, and what ``about`` says.
    """
    device = next(model.parameters()).device
    score_threshold = model.score_threshold if score_threshold is None else score_threshold
    scores = SceneScores(
        tasks=tasks,
        score_threshold=score_threshold,
        duplicate_iou=duplicate_iou,
        volume_extent=model.grid_extent,
        metrics=metrics,
        classes=model.classes,
        map_boxes=map_boxes,
    ).to(device)
    model.eval()
    forward_tasks = [task for task in tasks if task != "shape"]  # shapes are decoded of chosen objects alone
    repeated_frames = RepeatedFrames()
    for index in track(range(len(dataset)), "evaluating", disable=not progress, transient=True):  # type: ignore[arg-type]
        batch = dataset[index].to(device)
        repeated_frames.look(batch)
        new = {} if batch.new_views is None else {"new_cameras": Cameras.of(batch.new_views)}
        raw = model(
            batch.views,
            tasks=forward_tasks,
            grid_center=batch.grid_center,
            views_at_once=views_at_once,
            **new,
        )
        scores.update(batch, model.decode(raw, batch.scene_id, with_shapes=False))
        if "shape" in tasks:
            counted = model.decode(raw, batch.scene_id, score_threshold=score_threshold)
            scores.update_shapes(batch, counted)
    results = scores.results()
    if "strict" not in results:
        return Evaluation({**(about or {}), **results}, {"per_view.csv": scores.new_view_rows()})
    strict = ProtocolScores(results["strict"], scores.rows("object"), scores.rows("scene"))
    strict.metrics["confidence"] = confidence(strict, num_resamples=num_resamples, seed=seed)
    if scores.mean_average_precision is not None:
        of_map = ProtocolScores(results[MAP], [], [], scores.mean_average_precision)
        of_map.metrics["confidence"] = confidence(of_map, num_resamples=num_resamples, seed=seed)
    settings = {"score_threshold": score_threshold, "duplicate_iou": duplicate_iou}
    return Evaluation(
        {**(about or {}), **settings, **results},
        tables={"per_scene.csv": strict.scenes, "per_object.csv": strict.objects},
        misses=strict.misses(),
    )
