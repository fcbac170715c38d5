# SPDX-License-Identifier: Apache-2.0
"""Scenes as Weights & Biases shows them: boxes in 3D, objects in a table. Imported where W&B is in use."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
import wandb
from torch import Tensor

from raytran.geometry.boxes import OrientedBoxes
from raytran.geometry.grid import VoxelGrid
from raytran.geometry.rotation import yaw_from_rotation
from raytran.structs import ObjectSet, SceneBatch, ScenePrediction

_TRUE = (255, 255, 255)
_CAMERA = (255, 200, 0)
_OCCUPIED = (120, 130, 145)
_SHOWN_VOXELS = 5000

COLUMNS = (*("scene", "kind", "class", "score", "x", "y", "z", "width", "height", "depth", "yaw_deg"),)


def scene_in_3d(
    batch: SceneBatch, prediction: ScenePrediction, grid_extent: tuple[float, float, float]
) -> Any:
    """Return predicted boxes in their class colours and true ones in white, cameras and occupied voxels.

    Args:
        batch: one scene.
        prediction: of that scene, on the CPU.
        grid_extent: sizes of the voxel grid, metres.
    """
    truth = ObjectSet.empty() if batch.objects is None else batch.objects[0]
    boxes = [_box(truth, i, f"true {name}", _TRUE) for i, name in enumerate(truth.category)]
    found = prediction.objects
    for i, label in enumerate(found.label.tolist()):
        text = f"{found.classes.names[label]} {float(found.score[i]):.2f}"
        boxes.append(_box(found, i, text, found.classes.colors[label]))
    points = np.vstack(
        [
            _colored(batch.views.world_from_camera[0, :, :3, 3], _CAMERA),
            _colored(_occupied(prediction, grid_extent), _OCCUPIED),
        ]
    )
    return wandb.Object3D({"type": "lidar/beta", "points": points, "boxes": np.array(boxes)})


def object_table(scenes: Sequence[tuple[SceneBatch, ScenePrediction]]) -> Any:
    """Return a row per predicted and true object: class, score, centre and size in metres, yaw."""
    table = wandb.Table(columns=list(COLUMNS))
    for batch, prediction in scenes:
        truth = () if batch.objects is None else (("true", batch.objects[0]),)
        for kind, objects in (("predicted", prediction.objects), *truth):
            yaw = yaw_from_rotation(objects.rotation).rad2deg()
            for i in range(len(objects)):
                numbers = torch.cat([objects.center[i], objects.size[i], yaw[i, None]]).double()
                label, score = objects.category[i], float(objects.score[i])
                table.add_data(prediction.scene_id, kind, label, score, *numbers.tolist())
    return table


def _box(objects: ObjectSet, index: int, label: str, color: tuple[int, int, int]) -> dict[str, Any]:
    one = objects.select(torch.tensor([index]))
    # Corners in our order, which is that of `wandb.box3d`; so are colours from 0 to 1.
    corners = OrientedBoxes(one.center, one.size, one.rotation).corners()[0]
    return {"corners": corners.double().tolist(), "label": label, "color": [part / 255 for part in color]}


def _occupied(prediction: ScenePrediction, extent: tuple[float, float, float]) -> Tensor:
    """Return the centres of the voxels that are rather occupied than not, ``(n, 3)``, the surest ones."""
    if prediction.occupancy is None:
        return torch.zeros(0, 3)
    x, y, z = prediction.occupancy.shape
    centers = VoxelGrid((x, y, z), extent, prediction.grid_center).voxel_centers().reshape(-1, 3)
    probability, order = prediction.occupancy.flatten().sort(descending=True)
    return centers[order[probability > 0.5][:_SHOWN_VOXELS]]


def _colored(points: Tensor, color: tuple[int, int, int]) -> np.ndarray:
    """Return ``(n, 6)`` points with their colour."""
    return np.hstack([points.double().numpy(), np.tile(np.array(color, float), (len(points), 1))])
