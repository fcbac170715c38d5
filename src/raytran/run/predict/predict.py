# SPDX-License-Identifier: Apache-2.0
"""Predict one scene from a folder of posed frames, and write everything a user looks at."""

from __future__ import annotations

import contextlib
import logging
import shlex
import time
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import torch
from omegaconf import DictConfig

from raytran.capture.open import open_scene, parse_intrinsics
from raytran.capture.orientation import WorldSettings
from raytran.capture.recording import Intrinsics
from raytran.capture.sample_scene import scene_path
from raytran.checkpoints.file import checkpoint_path, shipped_weights
from raytran.checkpoints.load import PredictionSettings, load_model, prediction_settings
from raytran.checkpoints.network import trusted_packages
from raytran.data.shapenet.models import shapenet_version
from raytran.errors import ConfigError, DataError
from raytran.export.rerun_file import check_rerun
from raytran.export.simplify import MESH_ERROR
from raytran.model import RayTran
from raytran.postprocess import count_object_views, merge_volumes, select_objects
from raytran.run.device import choose_device, device_name, set_matmul_precision
from raytran.run.output import one_writer
from raytran.run.predict.new_views import cameras_to_render, render_views
from raytran.run.predict.room import RoomViews, check_choice, read_room
from raytran.run.predict.write_scene import MARKER, PredictedScene, check_pictures, write_scene
from raytran.structs import ScenePrediction
from raytran.viewer import has_viser
from raytran.viewer.attention_record import observe_attention
from raytran.viewer.data import predicted_volumes
from raytran.viewer.truth import read_truth

_LOG = logging.getLogger(__name__)

PREDICTIONS = Path("outputs") / "predictions"
"""Where results go if nothing else is said, each by the name of its scene."""

ONLY_ROOMS = (
    "these weights have seen generated rooms alone: in a real room expect most chairs and tables about where "
    "they are, other furniture now and then, and some that is not there"
)

_UNTRAINED = {
    "stage1": "its objects mean nothing yet; predict with a checkpoint of stage3",
    "stage2": "it has learned no shapes yet, so there are boxes but no meshes: those need stage3",
    "novel_view": "it renders new views; its objects mean nothing unless stage.trainable left the backbone "
    "alone",
}
"""Stage of the curriculum that is not the last → what to expect of its checkpoints."""

_WITHOUT_SHAPES = ("stage1", "stage2")
"""Stages before that of the shapes. The surface of their noise has a quarter of a million triangles."""

RGB = 3
"""Channels of the images that a scene without annotation has."""

_SAME_PLACE = 1e-4
"""Metres within which a volume counts as centred on its cameras."""


def predict(cfg: DictConfig) -> Path:
    """Run ``raytran predict``; see ``conf/predict.yaml``.

    Returns:
        The folder of results.

    Raises:
        ConfigError: a setting is unknown or ``output`` must not be replaced.
        CheckpointError: the checkpoint is missing or damaged.
        DataError: the scene's folder is missing or damaged.
    """
    began = time.monotonic()
    recording = scene_path(cfg.scene)
    output = Path(cfg.output) if cfg.output else PREDICTIONS / _scene_id(recording)
    world = WorldSettings(up=cfg.up, scale=cfg.scale, convention=cfg.convention, check=cfg.check)
    intrinsics = parse_intrinsics(cfg.intrinsics)
    check_choice(cfg.frames, cfg.num_views)
    if cfg.rerun:
        check_rerun()
    check_pictures(num_overlays=cfg.num_overlays, turntable=cfg.turntable)
    try:
        recording.stat()  # before the network is loaded
    except FileNotFoundError as error:
        raise DataError(f"there is no scene {recording}: check the path") from error
    try:
        with one_writer(output, marker=MARKER):
            device, scene = _predict(cfg, recording, output, world, intrinsics)
    except BaseException:
        if not cfg.output:
            with contextlib.suppress(OSError):
                PREDICTIONS.rmdir()  # if nothing else is there
                PREDICTIONS.parent.rmdir()
        raise
    _report(output, scene, f"in {time.monotonic() - began:.0f} s on {device_name(device)}")
    return output


def _predict(
    cfg: DictConfig, recording: Path, output: Path, world: WorldSettings, intrinsics: Intrinsics | None
) -> tuple[torch.device, PredictedScene]:
    """Predict with settings that were checked, into a folder that nobody else writes."""
    if cfg.cads:
        shapenet_version(Path(cfg.cads))  # It raises where there are none, before the network runs.
    settings = prediction_settings(cfg.checkpoint)
    if settings.stage in _UNTRAINED:
        _LOG.warning("%s is of %s: %s", cfg.checkpoint, settings.stage, _UNTRAINED[settings.stage])
    device = choose_device(cfg.device)
    set_matmul_precision(cfg.matmul_precision, device)
    model = load_model(cfg.checkpoint, attention=cfg.attention, trust=trusted_packages(cfg.trust))
    model = model.to(device)
    _introduce(cfg.checkpoint, settings, device)
    _check_channels(model, cfg.checkpoint)
    new_cameras = cameras_to_render(cfg.views, model, cfg.checkpoint)
    scene_id = _scene_id(recording)
    truth = read_truth(Path(cfg.truth), scene_id, model.classes) if cfg.truth else None
    _LOG.info("reading %s …", recording)
    room = _read_room(cfg, world, intrinsics, settings, model)
    _LOG.info("predicting from %d frames …", len(room.frame_ids))
    scene = predict_scene(
        model,
        room,
        scene_id=scene_id,
        score_threshold=cfg.score_threshold,
        duplicate_iou=cfg.duplicate_iou,
        views_at_once=cfg.views_at_once,
        with_shapes=settings.stage not in _WITHOUT_SHAPES,
        for_viewer=cfg.viewer,
        mesh_error=cfg.mesh_error,
    )
    if cfg.cads:
        scene = scene.with_cads(Path(cfg.cads))
    _LOG.info("writing meshes and pictures …")
    write_scene(
        output,
        scene,
        room.views,
        room.frame_ids,
        num_overlays=cfg.num_overlays,
        turntable=cfg.turntable,
        obj=cfg.obj,
        rerun=cfg.rerun,
        truth=truth,
    )
    if new_cameras is not None:
        render_views(model, room, new_cameras, output, views_at_once=cfg.views_at_once)
    return device, scene


def _scene_id(recording: Path) -> str:
    return recording.stem if recording.is_file() else recording.name


def _introduce(checkpoint: str, settings: PredictionSettings, device: torch.device) -> None:
    """Say which weights predict, and where; of those that raytran carries, what they do not know."""
    path = checkpoint_path(checkpoint)
    is_shipped = path == shipped_weights()
    name = f"raytran's own weights, {path.name}" if is_shipped else str(path)
    _LOG.info("%s (preset %s, %s) on %s", name, settings.preset, settings.stage, device_name(device))
    if is_shipped:
        _LOG.warning("%s", ONLY_ROOMS)


def predict_scene(
    model: RayTran,
    room: RoomViews,
    *,
    scene_id: str,
    score_threshold: float | None,
    duplicate_iou: float | None,
    views_at_once: int | None = None,
    with_shapes: bool = True,
    for_viewer: bool = True,
    mesh_error: float = MESH_ERROR,
) -> PredictedScene:
    """Predict a room, and make of it what ``write_scene`` writes.

    Args:
        model: the network, on any device.
        room: frames and volumes.
        scene_id: name to give the result.
        score_threshold: objects with a lower score are left out; None: the network's own threshold counts,
            ``RayTran.score_threshold``.
        duplicate_iou: of two objects of a class with a higher box IoU, the weaker is left out; None: neither.
        views_at_once: frames that pass through the network together, None for all; fewer need less memory.
        with_shapes: decode the objects' shapes.
        for_viewer: keep for the viewer how the network read the frames.
        mesh_error: farthest that a mesh may lie from the surface of its shape, metres; 0: every triangle.

    Returns:
        The result, on the CPU.
    """
    with observe_attention(model) if for_viewer else nullcontext() as observed:
        prediction = predict_room(
            model,
            room,
            scene_id=scene_id,
            score_threshold=score_threshold,
            duplicate_iou=duplicate_iou,
            views_at_once=views_at_once,
            with_shapes=with_shapes,
        )
    volumes = None
    if for_viewer:
        several = len(room.volumes) > 1
        parts = tuple(zip(room.volumes.center, room.members, strict=True)) if several else ()
        volumes = predicted_volumes(model, room.views, prediction, observed, parts=parts)
    return PredictedScene.of(prediction, mesh_error=mesh_error, volumes=volumes)


def predict_room(
    model: RayTran,
    room: RoomViews,
    *,
    scene_id: str,
    score_threshold: float | None,
    duplicate_iou: float | None,
    views_at_once: int | None = None,
    with_shapes: bool = True,
) -> ScenePrediction:
    """Run the network in each volume of a room; arguments as of ``predict_scene``.

    Returns:
        The objects that count, each once, with the number of views that saw it, and the voxels over
        ``room.volumes.joint()``, on the CPU.
    """
    device = next(model.parameters()).device
    score_threshold = model.score_threshold if score_threshold is None else score_threshold
    predictions = []
    for volume, center in enumerate(room.volumes.center):
        views = room.views_of(volume)
        mean_position = views.world_from_camera[0, :, :3, 3].double().mean(dim=0)
        # The network centres a volume on its cameras itself: asked to, it gives the same to the last bit.
        is_centered = float((center - mean_position).abs().max()) <= _SAME_PLACE
        grid_center = None if len(room.volumes) == 1 and is_centered else center.float().to(device)
        prediction = model.predict(
            views.to(device),
            scene_id=scene_id,
            score_threshold=score_threshold,
            views_at_once=views_at_once,
            with_shapes=with_shapes,
            grid_center=grid_center,
        ).to("cpu")
        prediction = select_objects(prediction, score_threshold=score_threshold, duplicate_iou=duplicate_iou)
        objects = count_object_views(prediction)
        predictions.append(replace(prediction, objects=objects))
    return predictions[0] if len(predictions) == 1 else merge_volumes(predictions, room.volumes)


def _read_room(
    cfg: DictConfig,
    world: WorldSettings,
    intrinsics: Intrinsics | None,
    settings: PredictionSettings,
    model: RayTran,
) -> RoomViews:
    """Return the frames that the network is given, and its volumes."""
    scene = scene_path(cfg.scene)
    with open_scene(scene, format=cfg.format, settings=world, intrinsics=intrinsics) as scan:
        return read_room(
            scan,
            frames=cfg.frames,
            num_views=cfg.num_views or settings.num_views,
            image_size=settings.image_size,
            resolution=model.grid_resolution,
            extent=model.grid_extent,
        )


def _check_channels(model: RayTran, checkpoint: str) -> None:
    """Raise if the network wants masks beside the images."""
    if model.backbone.encoder.input_channels != RGB:
        raise ConfigError(
            f"{checkpoint} was trained with the true masks as a fourth channel, which only annotated scenes "
            "have: use it with raytran evaluate, or give a checkpoint that was trained without"
        )


def _report(output: Path, scene: PredictedScene, how_long: str) -> None:
    """Say what was found, where it is, and how to look at it."""
    count, meshes = len(scene.prediction.objects), sum(mesh is not None for mesh in scene.meshes)
    if count:
        _LOG.info(
            "%s: %d objects, %d of them with a mesh, %s", scene.prediction.scene_id, count, meshes, how_long
        )
    else:
        _LOG.info(
            "%s: no object has a score above the threshold, %s; lower score_threshold to see weaker ones",
            scene.prediction.scene_id,
            how_long,
        )
    _LOG.info("wrote %s: %s", output.resolve(), ", ".join(sorted(path.name for path in output.iterdir())))
    if scene.volumes is not None and has_viser():
        _LOG.info("look at it: raytran view %s", shlex.quote(str(output)))
    elif scene.volumes is not None:
        _LOG.info("no prediction.html to look at it: pip install 'raytran[viewer]'")
