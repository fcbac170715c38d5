# SPDX-License-Identifier: Apache-2.0
"""Predict one scene from a folder of posed frames, and write everything a user looks at."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path

from omegaconf import DictConfig

from raytran.data.importers.open import open_scene
from raytran.data.importers.orient import WorldSettings
from raytran.data.scannet import even_views
from raytran.model import RayTran
from raytran.postprocess import object_meshes, select_objects
from raytran.run.checkpoint import load_model, prediction_settings
from raytran.run.device import choose_device
from raytran.run.output import check_replaceable
from raytran.run.scene_files import MARKER, PredictedScene, write_scene
from raytran.types import Views

_LOG = logging.getLogger(__name__)

_UNTRAINED = {
    "occupancy": "its objects mean nothing yet; predict with a checkpoint of stage shape",
    "joint": "its meshes mean nothing yet; predict with a checkpoint of stage shape",
}
"""Stage of the curriculum that is not the last → what to expect of its checkpoints."""


def predict(cfg: DictConfig) -> Path:
    """Run ``python -m raytran.predict``; see ``conf/predict.yaml``.

    Returns:
        The folder of results.

    Raises:
        ConfigError: a setting is unknown or ``output`` must not be replaced.
        CheckpointError: the checkpoint is missing or damaged.
        DataError: the scene's folder is missing or damaged.
    """
    scene, output = Path(cfg.scene).resolve(), Path(cfg.output)
    world = WorldSettings(up=cfg.up, scale=cfg.scale, convention=cfg.convention, check=cfg.check)
    check_replaceable(output.resolve(), marker=MARKER)
    settings = prediction_settings(cfg.checkpoint)
    if settings.stage in _UNTRAINED:
        _LOG.warning("%s is of stage %s: %s", cfg.checkpoint, settings.stage, _UNTRAINED[settings.stage])
    num_views = cfg.num_views or settings.num_views
    with open_scene(scene, format=cfg.format, settings=world) as scan:
        views, frame_ids = _without_repeats(
            *even_views(scan, image_size=settings.image_size, num_views=num_views)
        )
    model = load_model(cfg.checkpoint).to(choose_device(cfg.device))
    found = predict_scene(
        model,
        views,
        scene_id=scene.stem if scene.is_file() else scene.name,
        score_threshold=cfg.score_threshold,
        duplicate_iou=cfg.duplicate_iou,
        views_at_once=cfg.views_at_once,
    )
    write_scene(output, found, views, frame_ids, grid_extent=model.grid_extent, num_overlays=cfg.num_overlays)
    _report(output, found)
    return output


def predict_scene(
    model: RayTran,
    views: Views,
    *,
    scene_id: str,
    score_threshold: float,
    duplicate_iou: float | None,
    views_at_once: int | None = None,
) -> PredictedScene:
    """Run the network on the views of one scene and make meshes of the objects it found.

    Args:
        model: the network, on any device.
        views: B = 1.
        scene_id: name to give the result.
        score_threshold: objects with a lower score are left out.
        duplicate_iou: of two objects of a class with a higher box IoU, the weaker is left out; None: neither.
        views_at_once: views that pass through the network together, None for all; fewer need less memory.

    Returns:
        The result, on the CPU.
    """
    device = next(model.parameters()).device
    raw = model.predict(
        views.to(device), scene_id=scene_id, score_threshold=score_threshold, views_at_once=views_at_once
    )
    prediction = select_objects(raw.to("cpu"), score_threshold=score_threshold, duplicate_iou=duplicate_iou)
    return PredictedScene(prediction, object_meshes(prediction))


def _without_repeats(views: Views, frame_ids: Sequence[str]) -> tuple[Views, tuple[str, ...]]:
    """Leave out second appearances of frames, which come when more are asked for than there are."""
    first = {name: n for n, name in reversed(list(enumerate(frame_ids)))}
    kept = sorted(first.values())
    views = Views(views.images[:, kept], views.intrinsics[:, kept], views.world_from_camera[:, kept])
    return views, tuple(frame_ids[n] for n in kept)


def _report(output: Path, found: PredictedScene) -> None:
    count, meshes = len(found.prediction.objects), sum(mesh is not None for mesh in found.meshes)
    if count:
        _LOG.info("%s: %d objects, %d of them with a mesh", found.prediction.scene_id, count, meshes)
    else:
        _LOG.info(
            "%s: no object has a score above the threshold; lower score_threshold to see weaker ones",
            found.prediction.scene_id,
        )
    _LOG.info("wrote %s: scene.json, scene.glb, meshes/, topdown.png, overlays/", output.resolve())
