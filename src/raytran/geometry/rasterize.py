# SPDX-License-Identifier: Apache-2.0
"""Meshes seen by cameras: masks, object numbers and depths, by rays through the pixel centres.

Rays need no clipping at the near plane and no pixel rule; Embree casts about ten million of them a second.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import combinations

import numpy as np
import torch
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from raytran.errors import check_shape
from raytran.geometry.camera import Cameras

Mesh = tuple[ArrayLike, ArrayLike]
"""``(V, 3)`` vertices in the world, metres, and ``(F, 3)`` vertex numbers of the triangles."""

_NEAR = 1e-3
"""Depth, metres, at which boxes are clipped before they are projected."""


def rasterize_mask(meshes: Sequence[Mesh], cameras: Cameras) -> Tensor:
    """Return the pixels whose centre ray meets any of the meshes, whatever else is in front or behind.

    Args:
        meshes: triangle meshes in the world; none at all give an empty mask.
        cameras: of N images of ``H × W``, leading dimensions ``(N,)``.

    Returns:
        ``(N, H, W)`` bool.

    Raises:
        ShapeError: the cameras' tensors are not ``(N, ...)``.
    """
    check_shape(cameras.intrinsics, "N 3 3", "intrinsics")
    masks = torch.zeros(len(cameras.intrinsics), *cameras.image_size, dtype=torch.bool)
    caster = _Caster(meshes)
    for mask, camera in zip(masks, _each(cameras), strict=True):
        seen = caster.near_pixels(camera)
        mask[seen] = torch.from_numpy(caster.cast(camera, seen, query="OCCLUDED") != -1)
    return masks


def rasterize_ids(meshes: Sequence[Mesh], cameras: Cameras) -> tuple[Tensor, Tensor]:
    """Return which mesh is nearest in every pixel, and how far away it is.

    Args:
        meshes: triangle meshes in the world.
        cameras: of N images of ``H × W``, leading dimensions ``(N,)``.

    Returns:
        ids ``(N, H, W)`` int64, position in ``meshes`` or -1; and depths ``(N, H, W)`` float32 along the
        camera's z axis, metres, infinite where there is no mesh.

    Raises:
        ShapeError: the cameras' tensors are not ``(N, ...)``.
    """
    check_shape(cameras.intrinsics, "N 3 3", "intrinsics")
    size = (len(cameras.intrinsics), *cameras.image_size)
    ids, depths = torch.full(size, -1), torch.full(size, torch.inf)
    caster = _Caster(meshes)
    for index, depth, camera in zip(ids, depths, _each(cameras), strict=True):
        seen = caster.near_pixels(camera)
        hit = caster.cast(camera, seen, output=True)
        found = torch.from_numpy(hit["primID"] != -1)
        index[seen] = torch.from_numpy(hit["geomID"]).long().where(found, -1)
        depth[seen] = torch.from_numpy(hit["tfar"]).where(found, torch.inf)
    return ids, depths


def rasterize_visible(
    meshes: Sequence[Mesh], occluders: Sequence[Mesh], cameras: Cameras, *, tolerance: float
) -> Tensor:
    """Return the pixels whose centre ray meets any of the meshes and, before it, none of the occluders.

    Which of the meshes is in front does not matter for all of them together: so the meshes of all objects
    hide none of their own pixels, only what is no object does.

    Args:
        meshes: triangle meshes in the world.
        occluders: triangle meshes that may be in front, e.g. of a whole scan, surfaces of objects included.
        cameras: of N images of ``H × W``, leading dimensions ``(N,)``.
        tolerance: depth by which an occluder must be nearer to hide a mesh, metres.

    Returns:
        ``(N, H, W)`` bool, part of ``rasterize_mask``.

    Raises:
        ShapeError: the cameras' tensors are not ``(N, ...)``.
    """
    _, depth = rasterize_ids(meshes, cameras)
    visible = depth < torch.inf
    caster = _Caster(occluders)
    for mask, distance, camera in zip(visible, depth, _each(cameras), strict=True):
        # Only where there is a mesh to be hidden.
        hit = caster.cast(camera, mask, output=True)
        nearest = torch.from_numpy(hit["tfar"]).where(torch.from_numpy(hit["primID"] != -1), torch.inf)
        mask[mask.clone()] = nearest >= distance[mask] - tolerance
    return visible


class _Caster:
    """Meshes prepared for ray casting, each with the box around it."""

    def __init__(self, meshes: Sequence[Mesh]) -> None:
        self._scene = EmbreeScene()
        boxes = []
        for vertices, faces in meshes:
            triangles = np.asarray(vertices, dtype=np.float32)[np.asarray(faces, dtype=np.int64)]
            TriangleMesh(
                self._scene, triangles
            )  # An empty mesh too, so that numbers stay positions in the list.
            corners = triangles.reshape(-1, 3)
            if len(corners):
                boxes.append(_box_corners(corners.min(axis=0), corners.max(axis=0)))
        self._boxes = boxes

    def near_pixels(self, camera: Cameras) -> Tensor:
        """Return the pixels of the picture inside the projection of any mesh's box, ``(H, W)`` bool."""
        height, width = camera.image_size
        near = torch.zeros(height, width, dtype=torch.bool)
        for corners in self._boxes:
            in_front = _clip_to_front(torch.from_numpy(corners), camera)
            if len(in_front):
                pixels, _ = camera.project(in_front.to(camera.intrinsics))
                # One pixel more on each side, for rounding.
                left, top = (pixels.amin(dim=0).floor() - 1).clamp(min=0).long().tolist()
                right, bottom = (pixels.amax(dim=0).ceil() + 1).clamp(min=0).long().tolist()
                near[top:bottom, left:right] = True
        in_picture = camera.cells_in_picture(camera.image_size)
        return near if in_picture is None else near & in_picture[..., 0]

    def cast(self, camera: Cameras, pixels: Tensor, **options: str | bool) -> NDArray | dict[str, NDArray]:
        """Cast the centre rays of ``pixels``, ``(H, W)`` bool; a ray's parameter is a depth in metres."""
        origin, directions = camera.cell_rays(camera.image_size)
        chosen = directions[pixels].reshape(-1, 3).numpy().astype(np.float32)
        start = np.ascontiguousarray(
            np.broadcast_to(origin.reshape(3).numpy().astype(np.float32), chosen.shape)
        )
        if not self._boxes or not len(chosen):
            nothing = np.full(len(chosen), -1, dtype=np.int32)
            far = np.zeros(len(chosen), dtype=np.float32)
            return {"primID": nothing, "geomID": nothing, "tfar": far} if options.get("output") else nothing
        return self._scene.run(start, chosen, **options)


def _each(cameras: Cameras) -> Iterator[Cameras]:
    exact = cameras.to(torch.float64).to("cpu")
    for n in range(len(exact.intrinsics)):
        yield exact[n]


def _box_corners(low: NDArray, high: NDArray) -> NDArray:
    return (
        np.stack(np.meshgrid(*zip(low, high, strict=True), indexing="ij"), axis=-1)
        .reshape(8, 3)
        .astype(float)
    )


def _clip_to_front(corners: Tensor, camera: Cameras) -> Tensor:
    """Return points whose hull is the part of a box's hull in front of the camera, ``(n, 3)``.

    These are the corners in front and the points where the lines between any two corners cross the plane.
    """
    axis, position = camera.world_from_camera[:3, 2], camera.position
    depth = (corners - position) @ axis - _NEAR
    front = depth > 0
    if front.all() or not front.any():
        return corners[front]
    pairs = torch.tensor(list(combinations(range(8), 2)))
    first, second = pairs[front[pairs[:, 0]] != front[pairs[:, 1]]].unbind(1)
    part = (depth[first] / (depth[first] - depth[second]))[:, None]
    return torch.cat([corners[front], corners[first] + part * (corners[second] - corners[first])])
