# SPDX-License-Identifier: Apache-2.0
"""From a prediction to the objects one shows: a score threshold, duplicates, meshes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
import trimesh
from numpy.typing import NDArray
from skimage.measure import marching_cubes
from torch import Tensor

from raytran.geometry.boxes import OrientedBoxes, box_iou
from raytran.types import ObjectSet, ScenePrediction


def select_objects(
    prediction: ScenePrediction, *, score_threshold: float = 0.5, duplicate_iou: float | None = None
) -> ScenePrediction:
    """Keep the objects that are sure enough, highest score first.

    Args:
        prediction: a scene.
        score_threshold: objects with a lower score are left out.
        duplicate_iou: leave out an object whose box overlaps one of the same class and of higher score by
            more than this IoU. None: leave out none, since the network is trained to predict each object
            once (RayTran §3.2).
    """
    objects = prediction.objects
    kept = (objects.score >= score_threshold).nonzero().squeeze(1)
    objects = objects.select(kept[objects.score[kept].argsort(descending=True, stable=True)])
    if duplicate_iou is not None:
        objects = objects.select(_first_of_duplicates(objects, duplicate_iou))
    return replace(prediction, objects=objects)


def _first_of_duplicates(objects: ObjectSet, duplicate_iou: float) -> Tensor:
    """Return where an object is no duplicate of an earlier one that is kept, ``(M,)`` bool."""
    boxes = OrientedBoxes(objects.center, objects.size, objects.rotation)
    duplicates = (box_iou(boxes, boxes)[0] > duplicate_iou) & (objects.label[:, None] == objects.label)
    keep = torch.ones_like(objects.label, dtype=torch.bool)
    for index in range(len(objects)):
        keep[index] = not bool((duplicates[index, :index] & keep[:index]).any())
    return keep


def object_meshes(prediction: ScenePrediction) -> list[trimesh.Trimesh | None]:
    """Return the surface of each object's shape, in the world.

    Marching cubes (Lewiner) at probability ½ on the shape grid, whose cells fill the object's box.

    Returns:
        One mesh for each object, in metres, faces counter-clockwise from outside; None where the shape is
        empty or was not decoded.
    """
    objects = prediction.objects
    if objects.shape is None:
        return [None] * len(objects)
    meshes: list[trimesh.Trimesh | None] = []
    for index, shape in enumerate(objects.shape):
        surface = _unit_surface(shape.detach().float().cpu().numpy())
        if surface is None:
            meshes.append(None)
            continue
        vertices, faces = surface
        size, rotation, center = (
            value[index].detach().double().cpu().numpy()
            for value in (objects.size, objects.rotation, objects.center)
        )
        meshes.append(trimesh.Trimesh((vertices * size) @ rotation.T + center, faces, process=False))
    return meshes


def _unit_surface(probability: NDArray[np.float32]) -> tuple[NDArray[np.float64], NDArray[np.int64]] | None:
    """Return vertices in [-½, ½]³ and faces of the surface of an ``(S, S, S)`` grid, or None if empty."""
    if not (probability > 0.5).any():
        return None
    # One layer of empty cells around the grid closes a shape that reaches the sides of its box.
    # "ascent": values grow towards the object, which makes its faces counter-clockwise from outside.
    padded = np.pad(probability, 1)
    vertices, faces, _, _ = marching_cubes(padded, level=0.5, method="lewiner", gradient_direction="ascent")
    return (vertices.astype(np.float64) - 0.5) / probability.shape[0] - 0.5, faces.astype(np.int64)
