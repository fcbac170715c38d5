# SPDX-License-Identifier: Apache-2.0
"""What a scene's annotation says the network should output: shapes, occupancy and amodal masks."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from raytran.data.cache import MaskCache, digest, file_digest
from raytran.data.shapenet import mesh_path, read_mesh
from raytran.data.voxelize import voxelize_solid
from raytran.geometry.camera import Cameras
from raytran.geometry.grid import VoxelGrid
from raytran.ops.rasterize import rasterize_mask
from raytran.types import SHAPE_SIZE, ObjectSet

_VERSION = 1
"""Part of every key; raise it when the way a target is computed changes."""


def shape_grids(model_ids: tuple[str, ...], *, shapenet_root: Path, cache: MaskCache) -> Tensor:
    """Return the solid shape of each CAD model over its own box.

    Args:
        model_ids: ``catid/id`` of M models.
        shapenet_root: folder of the categories.
        cache: keeps a grid under the content of its CAD file.

    Returns:
        ``(M, S, S, S)`` bool, indexed as ``ObjectSet.shape``.

    Raises:
        DataError: a CAD file is missing or cannot be read.
    """
    grids = np.zeros((len(model_ids), SHAPE_SIZE, SHAPE_SIZE, SHAPE_SIZE), dtype=bool)
    for grid, model_id in zip(grids, model_ids, strict=True):
        content = _content(shapenet_root, model_id)
        key = digest(_VERSION, SHAPE_SIZE, content)
        stored = cache.read("shape", key, grid.shape)
        if stored is None:
            stored = voxelize_solid(*_unit_mesh(shapenet_root, model_id, content), size=SHAPE_SIZE)
            cache.write("shape", key, stored)
        grid[:] = stored
    return torch.from_numpy(grids)


def scene_occupancy(objects: ObjectSet, grid: VoxelGrid) -> Tensor:
    """Return the voxels that hold part of an object.

    Each solid cell of an object's shape is filled with points at most half a voxel apart; a voxel is
    occupied if a point lies in it. So voxels may be smaller than cells.

    Args:
        objects: M objects with shapes.
        grid: of one scene, ``center`` ``(3,)``.

    Returns:
        ``(X, Y, Z)`` bool.
    """
    occupied = torch.zeros(grid.num_voxels, dtype=torch.bool)
    if objects.shape is not None:
        for shape, size, rotation, center in zip(
            objects.shape, objects.size, objects.rotation, objects.center, strict=True
        ):
            occupied[_voxels_of(shape, size, rotation, center, grid)] = True
    return occupied.reshape(grid.resolution)


def foreground_masks(
    objects: ObjectSet, cameras: Cameras, *, shapenet_root: Path, cache: MaskCache
) -> Tensor:
    """Return the amodal mask of all objects together: pixels on any object, occluded or not (RayTran §3.2).

    Args:
        objects: M objects with model names.
        cameras: of N images of ``H × W``, leading dimensions ``(N,)``.
        shapenet_root: folder of the categories.
        cache: keeps each mask under the objects' boxes, the content of their CAD files and the camera.

    Returns:
        ``(N, H, W)`` bool.

    Raises:
        DataError: a CAD file is missing or cannot be read.
    """
    contents = [_content(shapenet_root, model_id) for model_id in objects.model_id]
    scene = digest(_VERSION, contents, *(t.numpy() for t in (objects.center, objects.size, objects.rotation)))
    intrinsics, world_from_camera = cameras.intrinsics.numpy(), cameras.world_from_camera.numpy()
    keys = [
        digest(scene, cameras.image_size, *camera)
        for camera in zip(intrinsics, world_from_camera, strict=True)
    ]
    stored = [cache.read("foreground", key, cameras.image_size) for key in keys]
    masks = np.stack([np.zeros(cameras.image_size, dtype=bool) if mask is None else mask for mask in stored])
    if missing := [i for i, mask in enumerate(stored) if mask is None]:
        meshes = [
            _place(_unit_mesh(shapenet_root, model_id, content), objects, m)
            for m, (model_id, content) in enumerate(zip(objects.model_id, contents, strict=True))
        ]
        chosen = Cameras(cameras.intrinsics[missing], cameras.world_from_camera[missing], cameras.image_size)
        masks[missing] = rasterize_mask(meshes, chosen).numpy()
        for i in missing:
            cache.write("foreground", keys[i], masks[i])
    return torch.from_numpy(masks)


def _content(shapenet_root: Path, model_id: str) -> str:
    """Return a digest of a model's mesh file."""
    return file_digest(mesh_path(shapenet_root, *model_id.split("/")))


@lru_cache(maxsize=64)
def _unit_mesh(shapenet_root: Path, model_id: str, _content: str) -> tuple[NDArray, NDArray]:
    """Return vertices and faces of a CAD model, its box turned into the cube [-½, ½]³.

    The box is that of the vertices which faces use, as in Scan2CAD's annotation.
    """
    mesh = read_mesh(shapenet_root, *model_id.split("/"))
    used, faces = np.unique(mesh.faces, return_inverse=True)
    vertices = np.asarray(mesh.vertices, dtype=np.float64)[used]
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    extent = np.where(high > low, high - low, 1.0)
    return (vertices - (low + high) / 2) / extent, faces.reshape(-1, 3)


def _place(unit_mesh: tuple[NDArray, NDArray], objects: ObjectSet, m: int) -> tuple[NDArray, NDArray]:
    vertices, faces = unit_mesh
    size, rotation, center = (t[m].double().numpy() for t in (objects.size, objects.rotation, objects.center))
    return (vertices * size) @ rotation.T + center, faces


def _voxels_of(shape: Tensor, size: Tensor, rotation: Tensor, center: Tensor, grid: VoxelGrid) -> Tensor:
    """Return the number of the voxel of each point that fills an object's solid cells, inside the grid."""
    cell = size / shape.shape[0]
    spacing = float(grid.voxel_size.min()) / 2
    inner = torch.cartesian_prod(
        *((torch.arange(n) + 0.5) / n for n in (cell / spacing).ceil().int().tolist())
    )
    points = (shape.nonzero().T[:, :, None] + inner.T[:, None]).flatten(1)
    voxel_from_cell = rotation * cell / grid.voxel_size[:, None]
    origin = (center - rotation @ size / 2 - grid.lower) / grid.voxel_size
    # One row per axis, in floating point up to the end: a few hundred thousand points for every object.
    index = torch.addmm(origin[:, None], voxel_from_cell, points).floor_()
    inside = index[0] >= 0
    for axis, count in enumerate(grid.resolution):
        inside &= (index[axis] >= 0) & (index[axis] < count)
    return grid.flat_index(index[:, inside].T.long())
