# SPDX-License-Identifier: Apache-2.0
"""Training targets made from a scene's annotation: shapes, occupancy, masks and which objects are seen."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch
import trimesh
from numpy.typing import NDArray
from torch import Tensor

from raytran.data.cache import MaskCache, digest, file_digest
from raytran.data.shapenet.models import is_boxed, mesh_path, read_mesh
from raytran.data.shapenet.voxelize import voxelize_solid
from raytran.errors import DataError
from raytran.geometry.camera import Cameras
from raytran.geometry.grid import VoxelGrid
from raytran.geometry.rasterize import rasterize_ids, rasterize_mask, rasterize_visible
from raytran.limits import POSITION
from raytran.structs import SHAPE_SIZE, ObjectSet

_MAX_POINTS = 1 << 25
"""Most points that may fill one object's box; with more it is far larger than any room."""

MAX_SURFACE_OFFSET = 0.2
"""Depth by which the scan's surface may be nearer than the CAD model aligned to it, metres: the error that
Scan2CAD's benchmark allows."""

_UNIT_BOX = (-0.5, 0.5)
"""Of a boxed model, along each axis."""

_VERSION = 1
"""Part of every key; raise it when the way a target is computed changes."""


def shape_grids(model_ids: tuple[str, ...], *, shapenet_root: Path, cache: MaskCache) -> Tensor:
    """Return the solid shape of each CAD model over its own box; of a boxed one over the object's.

    Args:
        model_ids: ``catid/id`` of M models.
        shapenet_root: folder of the categories.
        cache: keeps a grid under the content of its CAD file.

    Returns:
        ``(M, S, S, S)`` bool, indexed as ``ObjectSet.shape``.

    Raises:
        DataError: a CAD file is missing or cannot be read.
    """
    contents = [_content(shapenet_root, model_id) for model_id in model_ids]
    keys = [digest(_VERSION, SHAPE_SIZE, content) for content in contents]
    grids, missing = cache.read_stack("shape", keys, (SHAPE_SIZE,) * 3)
    for i in missing:
        # The same model may come several times: its shape is made once.
        first = keys.index(keys[i])
        if first < i:
            grids[i] = grids[first]
        else:
            box = _UNIT_BOX if is_boxed(shapenet_root, *model_ids[i].split("/")) else None
            mesh = _unit_mesh(shapenet_root, model_ids[i], contents[i])
            grids[i] = voxelize_solid(*mesh, size=SHAPE_SIZE, box=box)
            cache.write("shape", keys[i], grids[i])
    return torch.from_numpy(grids)


def scene_occupancy(objects: ObjectSet, grid: VoxelGrid) -> Tensor:
    """Return the voxels that hold part of an object.

    Each solid cell of an object's shape is filled with points at most half a voxel apart; a voxel is
    occupied if a point lies in it. Voxels may therefore be smaller than the cells of a shape.

    Args:
        objects: M objects with shapes.
        grid: of one scene, ``center`` ``(3,)``.

    Returns:
        ``(X, Y, Z)`` bool.

    Raises:
        DataError: an object is too large for the voxels, as if given in another unit.
    """
    occupied = np.zeros(grid.num_voxels, dtype=bool)
    if objects.shape is not None:
        lower, voxel = grid.lower.double().numpy(), grid.voxel_size.double().numpy()
        for m, shape in enumerate(objects.shape.numpy()):
            size, rotation, center = _box_of(objects, m)
            cell = size / len(shape) / voxel.min()
            if not np.ceil(2 * cell).clip(1).prod() * shape.size <= _MAX_POINTS:
                width, height, depth = size.tolist()
                raise DataError(
                    f"an object of {width:.4g} × {height:.4g} × {depth:.4g} m is too large for voxels of "
                    f"{voxel.min():.4g} m: check the unit and the scale of the annotation"
                )
            # Continuous voxel coordinates of the object's cells: origin + voxel_from_cell @ (i, j, k).
            voxel_from_cell = rotation * (size / len(shape)) / voxel[:, None]
            origin = (center - rotation @ size / 2 - lower) / voxel
            occupied[_voxels_of(shape, cell, voxel_from_cell, origin, grid.resolution)] = True
    return torch.from_numpy(occupied.reshape(grid.resolution))


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

    def draw(missing: Cameras) -> NDArray[np.bool_]:
        return rasterize_mask(cad_meshes(objects, shapenet_root=shapenet_root), missing).numpy()

    key = _scene_key(objects, shapenet_root)
    return _cached_per_camera("foreground", key, cameras, cameras.image_size, cache, draw)


def visible_masks(
    objects: ObjectSet, cameras: Cameras, *, scan_mesh: Path, shapenet_root: Path, cache: MaskCache
) -> Tensor:
    """Return the pixels on which an object is seen: the amodal mask without what the scan's surface hides.

    Where objects hide each other the pixel stays, because the mask is of all objects together. What else
    hides them is known from the scan's own mesh, which has the real surfaces of the objects too: a pixel is
    hidden where the mesh is nearer than the CAD model by more than ``MAX_SURFACE_OFFSET``.

    Args:
        objects: M objects with model names.
        cameras: of N images of ``H × W``, leading dimensions ``(N,)``.
        scan_mesh: the scan's mesh in the world of its poses, ScanNet's ``<scan>_vh_clean_2.ply``.
        shapenet_root: folder of the categories.
        cache: keeps each mask under the objects' boxes, the content of all mesh files and the camera.

    Returns:
        ``(N, H, W)`` bool.

    Raises:
        DataError: a mesh is missing or cannot be read.
    """
    if not scan_mesh.is_file():
        raise DataError(
            f"there is no mesh {scan_mesh}, which tells what hides objects: copy it from ScanNet's release, "
            "or set data.dataset.input_mask=amodal"
        )

    content = file_digest(scan_mesh)

    def draw(missing: Cameras) -> NDArray[np.bool_]:
        meshes = cad_meshes(objects, shapenet_root=shapenet_root)
        scan = scan_surface(scan_mesh, content)
        return rasterize_visible(meshes, [scan], missing, tolerance=MAX_SURFACE_OFFSET).numpy()

    key = digest(MAX_SURFACE_OFFSET, content, _scene_key(objects, shapenet_root))
    return _cached_per_camera("visible", key, cameras, cameras.image_size, cache, draw)


def seen_objects(objects: ObjectSet, cameras: Cameras, *, shapenet_root: Path, cache: MaskCache) -> Tensor:
    """Return which objects each view sees: those that are the nearest object in at least one of its pixels.

    Objects hide each other, by the surfaces of their CAD models at the centres of the pixels. Nothing else
    hides them here, neither walls nor furniture that is not annotated.

    Args:
        objects: M objects with model names.
        cameras: of N images of ``H × W``, leading dimensions ``(N,)``.
        shapenet_root: folder of the categories.
        cache: keeps the result of each view as ``foreground_masks`` does.

    Returns:
        ``(N, M)`` bool.

    Raises:
        DataError: a CAD file is missing or cannot be read.
    """

    def draw(missing: Cameras) -> NDArray[np.bool_]:
        ids, _ = rasterize_ids(cad_meshes(objects, shapenet_root=shapenet_root), missing)
        seen = np.zeros((len(ids), len(objects)), dtype=bool)
        for is_seen, nearest in zip(seen, ids.numpy(), strict=True):
            is_seen[np.unique(nearest[nearest >= 0])] = True
        return seen

    key = _scene_key(objects, shapenet_root)
    return _cached_per_camera("seen", key, cameras, (len(objects),), cache, draw)


def _scene_key(objects: ObjectSet, shapenet_root: Path) -> str:
    """Return a digest of the objects' boxes and of the content of their CAD files."""
    contents = [_content(shapenet_root, model_id) for model_id in objects.model_id]
    return digest(_VERSION, contents, *(t.numpy() for t in (objects.center, objects.size, objects.rotation)))


def _cached_per_camera(
    kind: str,
    scene_key: str,
    cameras: Cameras,
    shape: tuple[int, ...],
    cache: MaskCache,
    draw: Callable[[Cameras], NDArray[np.bool_]],
) -> Tensor:
    """Return an array for each of N cameras, ``(N, *shape)``; ``draw`` makes those that the cache lacks."""
    facts = [cameras.intrinsics.numpy(), cameras.world_from_camera.numpy()]
    facts += [] if cameras.picture is None else [cameras.picture.numpy()]
    keys = [digest(scene_key, cameras.image_size, *camera) for camera in zip(*facts, strict=True)]
    arrays, missing = cache.read_stack(kind, keys, shape)
    if missing:
        arrays[missing] = draw(cameras[missing])
        for i in missing:
            cache.write(kind, keys[i], arrays[i])
    return torch.from_numpy(arrays)


@lru_cache(maxsize=2)
def scan_surface(path: Path, _content: str) -> tuple[NDArray, NDArray]:
    """Return vertices ``(V, 3)`` and faces ``(F, 3)`` of a scan's mesh, in the world of its poses.

    Raises:
        DataError: it cannot be read.
    """
    try:
        with np.errstate(all="ignore"):  # what numbers there are is looked at below
            mesh = trimesh.load(path, process=False, skip_materials=True)
    except Exception as error:  # a damaged file can fail anywhere in trimesh
        raise DataError(f"cannot read the mesh {path} ({str(error)[:80]!r}): copy it again") from error
    if not isinstance(mesh, trimesh.Trimesh) or not len(mesh.faces):
        raise DataError(f"{path} holds no triangles: copy the scan's mesh again")
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    if not (np.abs(vertices) <= POSITION.high).all() or faces.min() < 0 or faces.max() >= len(vertices):
        raise DataError(f"{path} has triangles of points that are nowhere: copy the scan's mesh again")
    return vertices, faces


def cad_meshes(objects: ObjectSet, *, shapenet_root: Path) -> list[tuple[NDArray, NDArray]]:
    """Return vertices ``(V, 3)`` in the world and faces ``(F, 3)`` of the CAD model of each of M objects.

    Raises:
        DataError: a CAD file is missing or cannot be read.
    """
    return [
        _posed(_unit_mesh(shapenet_root, model_id, _content(shapenet_root, model_id)), objects, m)
        for m, model_id in enumerate(objects.model_id)
    ]


def _content(shapenet_root: Path, model_id: str) -> str:
    """Return a digest of a model's mesh file."""
    return file_digest(mesh_path(shapenet_root, *model_id.split("/")))


@lru_cache(maxsize=64)
def _unit_mesh(shapenet_root: Path, model_id: str, _content: str) -> tuple[NDArray, NDArray]:
    """Return vertices and faces of a CAD model, its box stretched to the cube [-½, ½]³.

    The box is that of the vertices which faces use, as in Scan2CAD's annotation. A boxed model comes in such
    a cube: it may leave parts of it empty.
    """
    mesh = read_mesh(shapenet_root, *model_id.split("/"))
    if is_boxed(shapenet_root, *model_id.split("/")):
        return np.asarray(mesh.vertices, dtype=np.float64).clip(*_UNIT_BOX), np.asarray(mesh.faces)
    used, faces = np.unique(mesh.faces, return_inverse=True)
    vertices = np.asarray(mesh.vertices, dtype=np.float64)[used]
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    extent = np.where(high > low, high - low, 1.0)
    return (vertices - (low + high) / 2) / extent, faces.reshape(-1, 3)


def _posed(unit_mesh: tuple[NDArray, NDArray], objects: ObjectSet, m: int) -> tuple[NDArray, NDArray]:
    """Return the mesh with its unit cube stretched and moved to the box of object ``m``."""
    vertices, faces = unit_mesh
    size, rotation, center = _box_of(objects, m)
    return (vertices * size) @ rotation.T + center, faces


def _box_of(objects: ObjectSet, m: int) -> tuple[NDArray, NDArray, NDArray]:
    """Return size ``(3,)``, rotation ``(3, 3)`` and center ``(3,)`` of object ``m``, float64."""
    size, rotation, center = (t[m].double().numpy() for t in (objects.size, objects.rotation, objects.center))
    return size, rotation, center


def _voxels_of(
    shape: NDArray[np.bool_],
    cell: NDArray[np.float64],
    voxel_from_cell: NDArray[np.float64],
    origin: NDArray[np.float64],
    resolution: tuple[int, int, int],
) -> NDArray[np.int64]:
    """Return the numbers of the voxels, inside the grid, of points that fill an object's solid cells.

    Args:
        shape: ``(S, S, S)`` solid cells.
        cell: ``(3,)`` sides of a cell in units of the shortest side of a voxel.
        voxel_from_cell: ``(3, 3)``, as ``origin`` ``(3,)``: the map from cells to voxels.
        origin: voxel coordinates of the corner of cell (0, 0, 0).
        resolution: of the grid.
    """
    # Cells larger than half a voxel are split along each axis; of very small ones a part is enough.
    splits = np.maximum(np.ceil(2 * cell), 1).astype(np.int64)
    if splits.max() > 1:
        for axis, count in enumerate(splits.tolist()):
            shape = shape.repeat(count, axis=axis)
    elif (cell <= 0.25).all():
        shape = _sufficient_cells(shape, cell)
    row, k = np.divmod(np.flatnonzero(shape), shape.shape[2])
    along = [(np.arange(n) + 0.5) / count for n, count in zip(shape.shape, splits, strict=True)]
    number = np.zeros(len(k))
    inside = np.ones(len(k), dtype=bool)
    # Axis by axis of the grid: the sums over x and y are made once a row of cells, not once a cell.
    for (x, y, z), start, count in zip(voxel_from_cell, origin, resolution, strict=True):
        position = np.add.outer(along[0] * x + start, along[1] * y).ravel()[row] + (along[2] * z)[k]
        inside &= (position >= 0) & (position < count)
        number *= count
        number += np.floor(position, out=position)
    return number[inside].astype(np.int64)


def _sufficient_cells(shape: NDArray[np.bool_], cell: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return some of the solid cells that meet the same voxels as all of them do, if cells are small.

    These are the outer cells, which have a neighbour that is not solid, and of the inner cells those on a
    lattice of half a voxel. A voxel that meets an inner but no outer cell is filled with solid cells, as it
    is convex and several cells wide. So it contains a point of the lattice, as every ball of its width does.
    """
    core = shape
    for axis in range(3):
        low, middle, high = (
            core[(slice(None),) * axis + (cut,)] for cut in (slice(None, -2), slice(1, -1), slice(2, None))
        )
        core = low & middle & high
    chosen = shape.copy()
    chosen[1:-1, 1:-1, 1:-1] &= ~core
    steps = np.clip(0.5 / np.maximum(cell, 1e-9), 1, len(shape)).astype(np.int64)
    lattice = tuple(slice(int(step) // 2, None, int(step)) for step in steps)
    chosen[lattice] = shape[lattice]
    return chosen
