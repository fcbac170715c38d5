# SPDX-License-Identifier: Apache-2.0
"""The pictures of one scene that training logs: masks, occupancy, boxes from above and over the frames."""

from __future__ import annotations

from pathlib import Path

from raytran.geometry.camera import Cameras
from raytran.pictures.overlay import overlays
from raytran.pictures.panels import contact_sheet, draw_masks, draw_new_views, draw_occupancy
from raytran.pictures.topdown import draw_topdown
from raytran.postprocess import object_meshes
from raytran.structs import SceneBatch, ScenePrediction

_FRAMES = 4
_MIN_HEIGHT = 240
"""Smaller frames are enlarged to this many rows, so that names can be read."""


_MAX_FACES = 80_000
"""More than the surface of any whole shape has, far fewer than that of noise, which takes minutes to draw."""


def draw_scene(
    folder: Path, batch: SceneBatch, prediction: ScenePrediction, *, grid_extent: tuple[float, float, float]
) -> dict[str, Path]:
    """Draw what was predicted, beside the truth where the batch has it.

    Args:
        folder: made if it is missing.
        batch: one scene.
        prediction: of that scene, on the CPU; with shapes, meshes are drawn into the frames, but for those
            that are nothing but noise yet.
        grid_extent: sizes of the voxel grid, metres.

    Returns:
        Name of each picture → its file: ``masks``, ``occupancy``, ``new_views``, and with true objects in the
        batch ``topdown`` and ``boxes``.
    """
    folder.mkdir(parents=True, exist_ok=True)
    pictures: dict[str, Path] = {}
    if prediction.foreground is not None:
        truth = None if batch.foreground is None else batch.foreground[0]
        path = folder / "masks.jpg"
        pictures["masks"] = draw_masks(path, batch.views, prediction.foreground, truth, count=_FRAMES)
    if prediction.occupancy is not None:
        truth = None if batch.occupancy is None else batch.occupancy[0]
        path = folder / "occupancy.png"
        pictures["occupancy"] = draw_occupancy(path, prediction.occupancy, truth, height=grid_extent[2])
    if prediction.new_views is not None and batch.new_views is not None:
        path = folder / "new_views.jpg"
        pictures["new_views"] = draw_new_views(
            path, batch.views, batch.new_views, prediction.new_views, count=_FRAMES
        )
    if batch.objects is not None:
        pictures["topdown"] = draw_topdown(
            folder / "topdown.png",
            prediction,
            truth=batch.objects[0],
            cameras=Cameras.of(batch.views.scene()),
        )
        pictures["boxes"] = _draw_boxes(folder / "boxes.jpg", batch, prediction)
    return pictures


def _draw_boxes(path: Path, batch: SceneBatch, prediction: ScenePrediction) -> Path:
    meshes = [
        mesh if mesh is not None and len(mesh.faces) <= _MAX_FACES else None
        for mesh in object_meshes(prediction)
    ]
    frames = overlays(batch.views, prediction.objects, meshes, count=_FRAMES, min_height=_MIN_HEIGHT)
    return contact_sheet(path, [picture for _, picture in frames], columns=2)
