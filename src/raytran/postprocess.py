# SPDX-License-Identifier: Apache-2.0
"""From predictions to the objects one shows: score threshold, duplicates, joined volumes, views, meshes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import torch
import trimesh
from numpy.typing import NDArray
from scipy import ndimage
from skimage.measure import marching_cubes
from torch import Tensor

from raytran.geometry.boxes import OrientedBoxes, box_iou
from raytran.geometry.grid import VoxelGrid
from raytran.geometry.room_tiles import Volumes
from raytran.heads.score_scaling import SCORE_THRESHOLD
from raytran.setting_limits import check_settings
from raytran.structs import ObjectSet, ScenePrediction

DUPLICATE_IOU = 0.25
"""Of two objects of one class whose boxes overlap more, the one with the lower score does not count."""

_POINTS_PER_SIDE = 4
"""A box is sampled at so many points along each side to see how many views saw it."""

_SAME_IOU, _SAME_PLACE_IOU = 0.25, 0.5
"""Objects of two volumes whose boxes overlap by more than this IoU are one: the first if they are of one
class, the second whatever they are."""

_OBJECTS_AT_ONCE = 256
"""Objects that are compared with all others together, so that memory grows with their number."""

_SPECK = 8
"""A piece of a shape of fewer cells is noise, unless it is the largest, and so is a hollow inside of one."""

_NEARLY_OWN = 0.25
"""How far on another volume's side of the border an object still counts, if nothing else is there, metres."""


def select_objects(
    prediction: ScenePrediction,
    *,
    score_threshold: float = SCORE_THRESHOLD,
    duplicate_iou: float | None = None,
) -> ScenePrediction:
    """Keep the objects that are sure enough, highest score first.

    Args:
        prediction: a scene.
        score_threshold: objects with a lower score are left out.
        duplicate_iou: leave out an object whose box overlaps one of the same class and of higher score by
            more than this IoU. None: leave out none, since the network is trained to predict each object
            once (RayTran §3.2).

    Raises:
        ConfigError: one of these is no share.
    """
    check_settings({"score_threshold": score_threshold, "duplicate_iou": duplicate_iou})
    objects = prediction.objects
    kept = (objects.score >= score_threshold).nonzero().squeeze(1)
    objects = objects.select(kept[objects.score[kept].argsort(descending=True, stable=True)])
    if duplicate_iou is not None:
        objects = objects.select(_first_of_duplicates(objects, duplicate_iou))
    return replace(prediction, objects=objects)


def _first_of_duplicates(objects: ObjectSet, duplicate_iou: float) -> Tensor:
    """Return which objects are no duplicates of an earlier one that is kept, ``(K,)`` int64."""

    def duplicates(some: slice, others: slice) -> Tensor:
        same_class = objects.label[some, None] == objects.label[others]
        return (_iou(objects, some, others) > duplicate_iou) & same_class

    return _first_of(objects, duplicates)


def _iou(objects: ObjectSet, some: slice, others: slice) -> Tensor:
    """Return the IoU of some of the boxes with others of them, ``(A, B)``."""
    first, second = (
        OrientedBoxes(objects.center[part], objects.size[part], objects.rotation[part])
        for part in (some, others)
    )
    return box_iou(first, second)[0]


def _first_of(objects: ObjectSet, duplicates: Callable[[slice, slice], Tensor]) -> Tensor:
    """Return which objects have no duplicate among those kept before them, ``(K,)`` int64.

    Args:
        objects: M objects.
        duplicates: says which of some objects are the same as which others, ``(A, B)`` bool.
    """
    kept: list[int] = []
    for start in range(0, len(objects), _OBJECTS_AT_ONCE):
        stop = min(start + _OBJECTS_AT_ONCE, len(objects))
        # Each depends on those before: gone through on the host, so that a GPU is waited for once.
        of_earlier = duplicates(slice(start, stop), slice(stop)).cpu().numpy()
        for index, row in enumerate(of_earlier, start=start):
            if not row[kept].any():
                kept.append(index)
    return torch.tensor(kept, dtype=torch.int64, device=objects.label.device)


def count_object_views(prediction: ScenePrediction) -> ObjectSet:
    """Return the objects with the number of views that saw their boxes, the mean over points in each box.

    Args:
        prediction: with ``seen`` and ``grid_extent``; places outside the voxel grid count as unseen.
    """
    objects, seen = prediction.objects, prediction.seen
    if seen is None or prediction.grid_extent is None:
        return objects
    side = (torch.arange(_POINTS_PER_SIDE, device=objects.size.device) + 0.5) / _POINTS_PER_SIDE - 0.5
    local = torch.cartesian_prod(side, side, side).to(objects.size.dtype) * objects.size[:, None]
    points = local @ objects.rotation.transpose(1, 2) + objects.center[:, None]
    x, y, z = seen.shape
    grid = VoxelGrid((x, y, z), prediction.grid_extent, prediction.grid_center.to(points))
    voxel = grid.voxel_from_world(points.flatten(0, 1)).floor().long()
    axes = zip(voxel.unbind(dim=1), seen.shape, strict=True)
    inside = torch.stack([(index >= 0) & (index < count) for index, count in axes]).all(dim=0)
    counts = seen.flatten()[grid.flat_index(voxel).where(inside, 0)].float().where(inside, 0.0)
    return replace(objects, num_views=counts.view(len(objects), _POINTS_PER_SIDE**3).mean(dim=1))


def merge_volumes(predictions: Sequence[ScenePrediction], volumes: Volumes) -> ScenePrediction:
    """Return one prediction of a room that was predicted in several overlapping volumes, each object once.

    An object belongs to the volume whose middle is nearest to its centre, and so does each voxel. One that
    another volume found just across the border stays if no other object is there, so that none falls
    between two.

    Args:
        predictions: one for each of the T volumes, all on one device.
        volumes: where they are.

    Returns:
        the objects, highest score first, and ``occupancy`` and ``seen`` over ``volumes.joint()``; no
        ``foreground``, which is of other frames in each volume.
    """
    parts = [prediction.objects for prediction in predictions]
    volume = torch.cat(
        [torch.full((len(part),), index, device=part.label.device) for index, part in enumerate(parts)]
    )
    objects = ObjectSet.join(parts)
    volumes = replace(volumes, center=volumes.center.to(objects.center.device))
    owned = volumes.owner(objects.center) == volume
    to_middle = volumes.center[volume] - objects.center
    moved = objects.center + to_middle.clamp(-_NEARLY_OWN, _NEARLY_OWN)
    candidate = owned | (volumes.owner(moved) == volume)
    # A volume's own objects come first, then by score.
    order = torch.argsort(objects.score + 2 * owned, descending=True, stable=True)
    order = order[candidate[order]]
    objects, volume = objects.select(order), volume[order]

    def same_thing(some: slice, others: slice) -> Tensor:
        iou = _iou(objects, some, others)
        same_class = objects.label[some, None] == objects.label[others]
        alike = same_class & (iou > _SAME_IOU) | (iou > _SAME_PLACE_IOU)
        return alike & (volume[some, None] != volume[others])

    objects = objects.select(_first_of(objects, same_thing))
    return ScenePrediction(
        scene_id=predictions[0].scene_id,
        objects=objects.select(objects.score.argsort(descending=True, stable=True)),
        grid_center=volumes.joint().center.to(predictions[0].grid_center),
        occupancy=_join_voxels([prediction.occupancy for prediction in predictions], volumes),
        seen=_join_voxels([prediction.seen for prediction in predictions], volumes),
        grid_extent=volumes.joint().extent,
    )


def _join_voxels(values: Sequence[Tensor | None], volumes: Volumes) -> Tensor | None:
    """Return values ``(X, Y, Z)`` of each volume over the joint grid; 0 where there is none."""
    present = [value for value in values if value is not None]
    if len(present) < len(volumes):
        return None
    joint, device = volumes.joint(), present[0].device
    one = VoxelGrid(volumes.resolution, volumes.extent, torch.zeros(3, device=device))
    size = torch.tensor(volumes.extent, device=device)
    from_middle = (one.voxel_centers() / size).square().sum(dim=-1)
    result = present[0].new_zeros(joint.resolution)
    nearest = torch.full(joint.resolution, torch.inf, device=device)
    for value, corner in zip(present, volumes.corner_index().tolist(), strict=True):
        place = tuple(
            slice(start, start + count) for start, count in zip(corner, volumes.resolution, strict=True)
        )
        closer = from_middle < nearest[place]
        result[place] = torch.where(closer, value, result[place])
        nearest[place] = torch.where(closer, from_middle, nearest[place])
    return result


def object_meshes(prediction: ScenePrediction) -> list[trimesh.Trimesh | None]:
    """Return the surface of each object's shape, in the world.

    Marching cubes (Lewiner) at probability ½ on the shape grid, whose cells fill the object's box, without
    loose pieces and closed hollows of fewer than eight cells.

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
    padded = _without_specks(np.pad(probability, 1))
    vertices, faces, _, _ = marching_cubes(padded, level=0.5, method="lewiner", gradient_direction="ascent")
    return (vertices.astype(np.float64) - 0.5) / probability.shape[0] - 0.5, faces.astype(np.int64)


def _without_specks(probability: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return probabilities in which small pieces, and small hollows, are just below, and above, one half."""
    solid = probability > 0.5
    pieces, _ = ndimage.label(solid)
    cells = np.bincount(pieces.ravel())
    # Number 0 is everything else. The largest piece stays; the space around is at least 26 cells.
    cells[0] = _SPECK
    cells[1:][cells[1:].argmax()] = _SPECK
    hollows, _ = ndimage.label(~solid)
    holes = np.bincount(hollows.ravel())
    holes[0] = _SPECK
    cleaned = np.where((cells < _SPECK)[pieces], np.float32(0.499), probability)
    return np.where((holes < _SPECK)[hollows], np.float32(0.501), cleaned)
