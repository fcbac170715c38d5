# SPDX-License-Identifier: Apache-2.0
"""What of a prediction the viewer shows besides its objects: the voxels, and what they read."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from torch import Tensor

from raytran.backbone.observed import ObservedAttention
from raytran.data.scan2cad import read_annotations, scene_objects
from raytran.errors import DataError
from raytran.export import FORMAT, read_scene_json
from raytran.geometry.camera import Cameras
from raytran.geometry.grid import VoxelGrid
from raytran.model import RayTran
from raytran.ops.traverse import trace_pairs
from raytran.structs import ObjectSet, ScenePrediction, Views
from raytran.viewer.attention_weights import attention_weights
from raytran.viewer.view_data import ViewedVolume
from raytran.viewer.view_reads import VoxelReads


def viewed_volumes(
    model: RayTran,
    views: Views,
    prediction: ScenePrediction,
    observed: ObservedAttention | None,
    *,
    grid_extent: tuple[float, float, float],
    parts: Sequence[tuple[Tensor, Sequence[int]]] = (),
) -> list[ViewedVolume]:
    """Return the voxels of a prediction, and from which pixels the last block gathered what they hold.

    Args:
        model: the network that ran.
        views: B = 1, all frames.
        prediction: its result, on the CPU.
        observed: what was kept while it ran (``observe_attention``), or None.
        grid_extent: sizes of the prediction's voxel grid, metres.
        parts: centre ``(3,)`` and frames of each run of the network, if it was not one on all frames.

    Returns:
        the prediction's grid, and if there are several parts each of these with what it read; none if the
        prediction has no voxels.
    """
    if prediction.occupancy is None:
        return []
    x, y, z = prediction.occupancy.shape
    center, everything = prediction.grid_center, range(views.images.shape[1])
    whole = VoxelGrid((x, y, z), grid_extent, center)
    reads = [] if observed is None else _reads(model, views, observed, parts or [(center, everything)])
    if len(reads) == 1:
        return [ViewedVolume(whole, everything, prediction.occupancy, prediction.seen, reads[0].reads)]
    return [ViewedVolume(whole, everything, prediction.occupancy, prediction.seen), *reads]


def _reads(
    model: RayTran,
    views: Views,
    observed: ObservedAttention,
    parts: Sequence[tuple[Tensor, Sequence[int]]],
) -> list[ViewedVolume]:
    """Return the volume of each run of the network with what its voxels read."""
    stride, (height, width) = model.backbone.stride, views.image_size
    size = (height // stride, width // stride)
    runs = observed.runs([len(frames) * size[0] * size[1] for _, frames in parts])
    volumes = []
    for (center, frames), (query, key) in zip(parts, runs, strict=True):
        index = list(frames)
        pose = views.world_from_camera[0, index].cpu()
        cameras = Cameras(views.intrinsics[0, index].cpu(), pose, views.image_size)
        grid = VoxelGrid(model.grid_resolution, model.grid_extent, center.to(pose))
        pairs = trace_pairs(cameras, grid, size, model.rays_per_cell)
        reads = VoxelReads(pairs, attention_weights(query, key, pairs), size)
        volumes.append(ViewedVolume(grid, frames, reads=reads))
    return volumes


def read_truth(path: Path, scene_id: str) -> ObjectSet:
    """Read the true objects of one scene.

    Args:
        path: Scan2CAD's ``full_annotations.json``, or a file in the form of ``scene.json``.
        scene_id: name of the scene, by which it is found in the former.

    Raises:
        DataError: the file cannot be read, is of neither form, or does not have the scene.
    """
    if FORMAT in _beginning(path):
        return read_scene_json(path).objects
    annotations = read_annotations(path)
    if scene_id not in annotations:
        raise DataError(f"{path} has no scene {scene_id}: give the annotations of this scene as truth=")
    return scene_objects(annotations[scene_id])


def _beginning(path: Path) -> str:
    try:
        with path.open(encoding="utf-8", errors="replace") as file:
            return file.read(200)
    except OSError as error:
        raise DataError(f"cannot read truth={path} ({error.strerror}): check the path") from error
