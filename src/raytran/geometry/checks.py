# SPDX-License-Identifier: Apache-2.0
"""What must hold for posed images before a network is given them, whoever made them."""

from __future__ import annotations

import torch
from torch import Tensor

from raytran.errors import DataError, check_shape
from raytran.geometry.camera import FARTHEST_CENTER
from raytran.geometry.double import widest
from raytran.structs import Views

_SKEWED = 0.01
"""Largest entry of R·Rᵀ - 1 of a rotation: files hold few digits."""

_ROUNDING = 0.01
"""Colours this far outside of [0, 1] come from resizing; more than that is another range."""


def rigid_motions(pose: Tensor) -> Tensor:
    """Return which of ``(..., 4, 4)`` matrices are finite and hold a rotation, ``(...)`` bool.

    Reflections are none: their determinant is -1. Nothing here makes the host wait for a GPU.
    """
    finite = pose.isfinite().all(dim=-1).all(dim=-1)
    rotation = pose[..., :3, :3].where(finite[..., None, None], 0.0).to(widest(pose.device))
    eye = torch.eye(3, dtype=rotation.dtype, device=rotation.device)
    error = (rotation @ rotation.mT - eye).abs().amax(dim=(-2, -1))
    x, y, z = rotation.unbind(dim=-2)
    determinant = (torch.linalg.cross(x, y) * z).sum(dim=-1)
    return finite & (error < _SKEWED) & (determinant > 0)


def check_views(
    views: Views, *, channels: int = 3, grid_center: Tensor | None = None, values: bool = True
) -> None:
    """Raise unless views are such as the commands give a network.

    Args:
        views: posed images of one scene, B = 1.
        channels: of the images.
        grid_center: ``(3,)`` centre of the voxel grid, metres, if it is given.
        values: check what is in the tensors too, for which the host waits for a GPU once; False checks types
            and shapes alone.

    Raises:
        ShapeError: a tensor does not have the documented shape, or there is no view.
        DataError: a tensor is of the wrong type or on another device than the images; a pose is not finite or
            no rigid motion; intrinsics are not finite, have no positive focal lengths, another last row than
            0, 0, 1, or a principal point farther from the middle than ``FARTHEST_CENTER``; colours are not
            numbers from 0 to 1; a picture is empty or leaves its image; or the grid's centre is not finite.
    """
    images = views.images
    check_shape(images, f"1 N {channels} H W", "images")
    count = max(images.shape[1], 1)  # with no view at all, the shape below says so
    check_shape(images, f"1 {count} {channels} H W", "images")
    check_shape(views.intrinsics, f"1 {count} 3 3", "intrinsics")
    check_shape(views.world_from_camera, f"1 {count} 4 4", "world_from_camera")
    cameras = {"intrinsics": views.intrinsics, "world_from_camera": views.world_from_camera}
    if views.picture is not None:
        check_shape(views.picture, f"1 {count} 4", "picture")
        cameras["picture"] = views.picture
    if images.dtype != torch.uint8 and not images.is_floating_point():
        raise DataError(
            f"images are of type {images.dtype}: give uint8 from 0 to 255, or floating point from 0 to 1"
        )
    for name, tensor in cameras.items():
        if not tensor.is_floating_point():
            raise DataError(f"{name} are of type {tensor.dtype}: give them in floating point")
    if grid_center is not None:
        check_shape(grid_center, "3", "grid_center")
        cameras["grid_center"] = grid_center
    for name, tensor in cameras.items():
        if tensor.device != images.device:
            raise DataError(f"{name} are on {tensor.device} and images on {images.device}: bring both to one")
    if values:
        _check_values(views, grid_center)


def _check_values(views: Views, grid_center: Tensor | None) -> None:
    """Raise unless the values in the tensors of one scene are possible."""
    faults = _faults(views)
    rows = list(faults.values())
    if grid_center is not None:
        rows.append((~grid_center.isfinite()).any().expand_as(rows[0]))
    found = torch.stack(rows).cpu()  # all in one copy: the host waits once
    for text, bad in zip(faults, found[: len(faults), 0], strict=True):
        if bad.any():
            index = int(bad.int().argmax())
            others = f" (and {int(bad.sum()) - 1} more)" if bad.sum() > 1 else ""
            raise DataError(f"view {index}{others} has {text}")
    if grid_center is not None and found[-1].any():
        raise DataError("grid_center is not finite: give three numbers in metres")


def _faults(views: Views) -> dict[str, Tensor]:
    """Return which views have each of some faults, ``(1, N)`` bool, by what to say of it."""
    height, width = views.image_size
    matrix, images = views.intrinsics, views.images
    focal, middle = matrix.diagonal(dim1=-2, dim2=-1)[..., :2], matrix[..., :2, 2]
    size = torch.stack([torch.full_like(middle[..., 0], side) for side in (width, height)], dim=-1)
    last_row = torch.stack([torch.full_like(middle[..., 0], value) for value in (0.0, 0.0, 1.0)], dim=-1)
    faults = {
        "a pose that is not finite or no rigid motion: give rotation and position, camera to world": (
            ~rigid_motions(views.world_from_camera)
        ),
        "intrinsics that are not finite or have no positive focal lengths: give fx, fy, cx, cy in pixels": (
            ~(matrix.isfinite().flatten(-2).all(dim=-1) & (focal > 0).all(dim=-1))
        ),
        "intrinsics without the last row 0, 0, 1: give K as [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]": (
            (matrix[..., 2, :] != last_row).any(dim=-1)
        ),
        f"a principal point far outside of {width}x{height}: give the intrinsics of these images": (
            ((middle / size - 0.5).abs() > FARTHEST_CENTER).any(dim=-1)
        ),
    }
    if images.is_floating_point():
        low, high = images.flatten(2).amin(dim=-1), images.flatten(2).amax(dim=-1)
        # Comparisons with what is not a number are false.
        inside = (low >= -_ROUNDING) & (high <= 1 + _ROUNDING)
        faults["colours that are no numbers from 0 to 1: divide by 255, or give uint8"] = ~inside
    if views.picture is not None:
        begin, end = views.picture[..., :2], views.picture[..., 2:]
        inside = (begin >= 0) & (begin < end) & (end <= size)
        faults[
            f"a picture that is empty or leaves the image of {width}x{height}: give left < right"
        ] = ~inside.all(dim=-1)
    return faults
