# SPDX-License-Identifier: Apache-2.0
"""Yaw of upright objects, symmetry about the up axis, quaternions.

The object frame is ShapeNet's: +Y up, front -Z. An upright object has ``R = Rz(yaw) · B`` where ``B`` turns
by +90° about x, (x, y, z) → (x, -z, y), so its x axis points to (cos yaw, sin yaw, 0) in the world.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from raytran.errors import check_shape
from raytran.structs import SYMMETRY_INFINITE


def upright_basis(*, dtype: torch.dtype = torch.float32, device: torch.device | None = None) -> Tensor:
    """Return ``B``, ``(3, 3)``: world_from_object of an object that stands upright with yaw 0."""
    return torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]], dtype=dtype, device=device)


def rotation_from_yaw(yaw: Tensor) -> Tensor:
    """Return ``Rz(yaw) · B``.

    Args:
        yaw: ``(...)`` radians.

    Returns:
        ``(..., 3, 3)`` world_from_object.
    """
    sin, cos, zero = torch.sin(yaw), torch.cos(yaw), torch.zeros_like(yaw)
    rows = [cos, zero, sin, sin, zero, -cos, zero, torch.ones_like(yaw), zero]
    return torch.stack(rows, dim=-1).unflatten(-1, (3, 3))


def yaw_from_rotation(rotation: Tensor) -> Tensor:
    """Return the yaw of the upright rotation closest in least squares to ``rotation``.

    With ``N = R · Bᵀ`` the answer is ``atan2(N10 - N01, N00 + N11)``; a tilt is left out of account.

    Args:
        rotation: ``(..., 3, 3)`` world_from_object.

    Returns:
        ``(...)`` radians in (-π, π].
    """
    if rotation.shape[-2:] != (3, 3):
        check_shape(rotation, "... 3 3", "rotation")
    # Columns of R · Bᵀ: B swaps y and z up to a sign, so N01 = -R02 and N11 = -R12.
    return torch.atan2(rotation[..., 1, 0] + rotation[..., 0, 2], rotation[..., 0, 0] - rotation[..., 1, 2])


def wrap_angle(angle: Tensor) -> Tensor:
    """Return ``angle`` (radians, any shape) wrapped to [-π, π)."""
    return torch.remainder(angle + math.pi, 2 * math.pi) - math.pi


def symmetric_yaw_error(predicted: Tensor, target: Tensor, symmetry: Tensor) -> Tensor:
    """Return the smallest signed turn from ``target`` to ``predicted``, over the target's symmetries.

    Args:
        predicted: ``(...)`` radians.
        target: ``(...)`` radians.
        symmetry: ``(...)`` int64: 1, 2, 4 equal turns, or ``SYMMETRY_INFINITE``.

    Returns:
        ``(...)`` radians in [-π/symmetry, π/symmetry); zero where the symmetry is infinite.
    """
    step = 2 * math.pi / symmetry.clamp(min=1).to(predicted.dtype)
    error = torch.remainder(predicted - target + step / 2, step) - step / 2
    return torch.where(symmetry == SYMMETRY_INFINITE, torch.zeros_like(error), error)


def matrix_from_quaternion(quaternion: Tensor) -> Tensor:
    """Return rotation matrices of quaternions ``[w, x, y, z]`` of any length and either sign.

    Args:
        quaternion: ``(..., 4)``.

    Returns:
        ``(..., 3, 3)``.
    """
    check_shape(quaternion, "... 4", "quaternion")
    w, x, y, z = torch.nn.functional.normalize(quaternion, dim=-1).unbind(-1)
    rows = [
        1 - 2 * (y * y + z * z),
        2 * (x * y - w * z),
        2 * (x * z + w * y),
        2 * (x * y + w * z),
        1 - 2 * (x * x + z * z),
        2 * (y * z - w * x),
        2 * (x * z - w * y),
        2 * (y * z + w * x),
        1 - 2 * (x * x + y * y),
    ]
    return torch.stack(rows, dim=-1).unflatten(-1, (3, 3))


def quaternion_from_matrix(matrix: Tensor) -> Tensor:
    """Return the quaternions of the rotations closest in least squares to ``matrix``.

    They are the eigenvectors of the largest eigenvalue of Davenport's symmetric matrix (Bar-Itzhack, 2000).

    Args:
        matrix: ``(..., 3, 3)``, rotations up to errors; one that is not finite gives NaN.

    Returns:
        ``(..., 4)`` unit quaternions [w, x, y, z] of either sign.
    """
    check_shape(matrix, "... 3 3", "matrix")
    finite = matrix.isfinite().all(dim=-1).all(dim=-1)
    m = torch.where(finite[..., None, None], matrix, 0.0)
    trace = m.diagonal(dim1=-2, dim2=-1).sum(-1)
    twist = torch.stack(
        [m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]], dim=-1
    )
    eye = torch.eye(3, dtype=m.dtype, device=m.device)
    block = m + m.mT - trace[..., None, None] * eye
    top = torch.cat([trace[..., None], twist], dim=-1)[..., None, :]
    davenport = torch.cat([top, torch.cat([twist[..., None], block], dim=-1)], dim=-2)
    quaternion = torch.linalg.eigh(davenport).eigenvectors[..., -1]
    return torch.where(finite[..., None], quaternion, torch.nan)


def geodesic_angle(a: Tensor, b: Tensor) -> Tensor:
    """Return the angle of the turn from ``a`` to ``b``.

    Computed as ``2 asin(‖a - b‖_F / (2 √2))``, which unlike the arc cosine of the trace is exact near zero.

    Args:
        a: ``(..., 3, 3)`` rotation matrices.
        b: ``(..., 3, 3)`` rotation matrices.

    Returns:
        ``(...)`` radians in [0, π].
    """
    distance = (a - b).square().sum(dim=(-2, -1)).sqrt()
    return 2 * torch.asin((distance / (2 * math.sqrt(2))).clamp(max=1.0))
