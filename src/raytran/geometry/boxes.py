# SPDX-License-Identifier: Apache-2.0
"""Oriented boxes with nine degrees of freedom, and their exact intersection over union."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from raytran.errors import ShapeError, check_shape
from raytran.geometry.box_clip import cube_intersection
from raytran.geometry.double import widest

_PAIRS_PER_CHUNK_CPU = 512  # keeps the arrays of a chunk in the cache
_PAIRS_PER_CHUNK = 65_536  # about 1.5 GB


@dataclass(frozen=True)
class OrientedBoxes:
    """A set of boxes: each is ``center + rotation · diag(size) · u`` with |u_i| ≤ ½.

    Attributes:
        center: ``(..., 3)`` metres.
        size: ``(..., 3)`` full extents along the box's own axes, metres.
        rotation: ``(..., 3, 3)`` world_from_box.

    Raises:
        ShapeError: a tensor has another shape, or the leading shapes differ.
    """

    center: Tensor
    size: Tensor
    rotation: Tensor

    def __post_init__(self) -> None:
        check_shape(self.center, "... 3", "center")
        check_shape(self.size, "... 3", "size")
        check_shape(self.rotation, "... 3 3", "rotation")
        if not self.center.shape[:-1] == self.size.shape[:-1] == self.rotation.shape[:-2]:
            raise ShapeError(
                "expected as many centers as sizes and rotations, got "
                f"{tuple(self.center.shape)}, {tuple(self.size.shape)} and {tuple(self.rotation.shape)}"
            )

    def corners(self) -> Tensor:
        """Return the corners in the world, ``(..., 8, 3)``, numbered x-major, z fastest.

        Corner ``4i + 2j + k`` has the signs ``(2i - 1, 2j - 1, 2k - 1)`` along the box's own axes: 0 is the
        lowest along all three, 7 the highest.
        """
        half = torch.tensor([-0.5, 0.5], dtype=self.size.dtype, device=self.size.device)
        signs = torch.cartesian_prod(half, half, half)
        local = signs * self.size[..., None, :]
        return self.center[..., None, :] + local @ self.rotation.transpose(-1, -2)

    def volume(self) -> Tensor:
        """Return the volumes, ``(...)`` cubic metres."""
        return self.size.prod(dim=-1)

    def axis_aligned(self) -> OrientedBoxes:
        """Return the smallest boxes along the world's axes around these, their rotations the identity."""
        size = (self.rotation.abs() @ self.size[..., None])[..., 0]
        identity = torch.eye(3, dtype=self.rotation.dtype, device=self.rotation.device)
        return OrientedBoxes(self.center, size, identity.expand_as(self.rotation))


class _Frames(NamedTuple):
    """Boxes as affine frames, box last; ``matrix`` maps [-1, 1]³ onto a box moved to the origin."""

    center: Tensor  # (3, n)
    matrix: Tensor  # (3, 3, n)
    inverse: Tensor  # (3, 3, n)
    determinant: Tensor  # (n,) absolute value, an eighth of the volume
    solid: Tensor  # (n,) bool: finite and of positive volume

    def take(self, index: Tensor) -> _Frames:
        """Return the frames at ``index``, ``(m,)`` int64."""
        return _Frames(*(value.index_select(-1, index) for value in self))


def box_iou(a: OrientedBoxes, b: OrientedBoxes) -> tuple[Tensor, Tensor]:
    """Return the exact intersection over union of all pairs of two sets of oriented boxes.

    The intersection is that of the two convex bodies, for any rotations and sizes. It is differentiable in
    all six tensors, with finite gradients. No value raises: a box without volume, or with a number that is
    not finite, has IoU 0 with every box. Rotations need not be orthonormal to the last bit: a box is taken
    as the parallelepiped that its rotation and size span.

    Args:
        a: boxes of leading shape ``(A,)``; A may be 0.
        b: boxes of leading shape ``(B,)``; B may be 0.

    Returns:
        IoU in [0, 1], and volume of the intersection in cubic metres; both ``(A, B)`` and float64 whatever
        the input (float32 on MPS, which has no float64: within 1e-6, 2e-5 for plates a millimetre thick).

    Raises:
        ShapeError: a set of boxes has no or more than one leading dimension.
    """
    check_shape(a.center, "A 3", "center of the first boxes")
    check_shape(b.center, "B 3", "center of the second boxes")
    return _box_iou(a, b, widest(a.center.device))


def axis_aligned_iou(a: OrientedBoxes, b: OrientedBoxes) -> Tensor:
    """Return the intersection over union of all pairs of two sets of boxes along the world's axes.

    Args:
        a: boxes of leading shape ``(A,)``; A may be 0. A box that is turned is replaced by the one around it,
            see ``OrientedBoxes.axis_aligned``.
        b: boxes of leading shape ``(B,)``; B may be 0.

    Returns:
        ``(A, B)`` in [0, 1]; 0 for a box without volume, or with a number that is not finite.

    Raises:
        ShapeError: a set of boxes has no or more than one leading dimension.
    """
    check_shape(a.center, "A 3", "center of the first boxes")
    check_shape(b.center, "B 3", "center of the second boxes")
    a, b = a.axis_aligned(), b.axis_aligned()
    upper = torch.minimum((a.center + a.size / 2)[:, None], b.center + b.size / 2)
    lower = torch.maximum((a.center - a.size / 2)[:, None], b.center - b.size / 2)
    intersection = (upper - lower).clamp(min=0).prod(dim=-1)
    union = a.volume()[:, None] + b.volume() - intersection
    return torch.where(intersection > 0, intersection / union, 0.0).nan_to_num()


def _box_iou(first: OrientedBoxes, second: OrientedBoxes, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    a, b = _frames(first, second, dtype)
    pair_a, pair_b = _near_pairs(a, b)
    chunk = _PAIRS_PER_CHUNK_CPU if pair_a.device.type == "cpu" else _PAIRS_PER_CHUNK
    shared = [
        _shared_volume(a.take(some_a), b.take(some_b))
        for some_a, some_b in zip(pair_a.split(chunk), pair_b.split(chunk), strict=True)
    ]
    zeros = a.center.new_zeros(a.center.shape[-1], b.center.shape[-1])
    intersection = zeros.index_put((pair_a, pair_b), torch.cat(shared))
    union = 8 * (a.determinant[:, None] + b.determinant) - intersection
    return intersection / union, intersection


def _frames(first: OrientedBoxes, second: OrientedBoxes, dtype: torch.dtype) -> tuple[_Frames, _Frames]:
    """Return the frames of two sets of boxes. A box that is not solid becomes a cube without gradient."""
    center = torch.cat([first.center, second.center]).to(dtype)
    size = torch.cat([first.size, second.size]).to(dtype)
    rotation = torch.cat([first.rotation, second.rotation]).to(dtype)
    matrix, inverse, determinant = _affine(size, rotation)
    finite = torch.cat([center.T, inverse.flatten(0, 1), determinant[None]]).isfinite().all(dim=0)
    solid = finite & (determinant != 0)
    if not solid.all():
        # Replaced before any arithmetic: a gradient of 0 times infinity would be NaN.
        keep, cube = solid[:, None], torch.eye(3, dtype=dtype, device=center.device)
        center, size = torch.where(keep, center, 0.0), torch.where(keep, size, 1.0)
        matrix, inverse, determinant = _affine(size, torch.where(keep[:, None], rotation, cube))
    both = _Frames(center.T, matrix, inverse, determinant.abs(), solid)
    count = first.center.shape[0]
    return _Frames(*(value[..., :count] for value in both)), _Frames(*(value[..., count:] for value in both))


def _affine(size: Tensor, rotation: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return ``rotation · diag(size / 2)``, ``(3, 3, n)``, its inverse by cross products and determinant.

    The true inverse and not the transpose, so that rotations rounded to float32 are taken as they are.
    """
    matrix = (rotation * (size / 2)[:, None, :]).permute(1, 2, 0)
    x, y, z = matrix.unbind(dim=1)
    rows = [torch.linalg.cross(first, second, dim=0) for first, second in ((y, z), (z, x), (x, y))]
    determinant = (x * rows[0]).sum(dim=0)
    return matrix, torch.stack(rows) / determinant, determinant


def _near_pairs(a: _Frames, b: _Frames) -> tuple[Tensor, Tensor]:
    """Return the indices ``(n,)`` into a and b of the pairs that no face of either box keeps apart."""
    with torch.no_grad():
        reach_a, reach_b = a.matrix.abs().sum(dim=1), b.matrix.abs().sum(dim=1)
        apart = (a.center[:, :, None] - b.center[:, None]).abs() >= reach_a[:, :, None] + reach_b[:, None]
        near = ~apart.any(dim=0) & a.solid[:, None] & b.solid
        pair_a, pair_b = near.nonzero().unbind(dim=-1)
        some_a, some_b = a.take(pair_a), b.take(pair_b)
        kept = _reaches(*_seen_from(some_a, some_b)) & _reaches(*_seen_from(some_b, some_a))
        return pair_a[kept], pair_b[kept]


def _seen_from(a: _Frames, b: _Frames) -> tuple[Tensor, Tensor]:
    """Return offset ``(3, n)`` and half edges ``(3, 3, n)`` of boxes b in frames a, pair by pair."""
    offset = (a.inverse * (b.center - a.center)).sum(dim=1)
    edges = (a.inverse[:, :, None] * b.matrix).sum(dim=1)
    return offset, edges


def _reaches(offset: Tensor, edges: Tensor) -> Tensor:
    """Return whether a box reaches into all three slabs of the cube [-1, 1]³, ``(n,)``."""
    return (offset.abs() < 1 + edges.abs().sum(dim=1)).all(dim=0)


def _shared_volume(a: _Frames, b: _Frames) -> Tensor:
    """Return the volume ``(n,)`` of the intersection, pair by pair."""
    volume = cube_intersection(*_seen_from(a, b)) * a.determinant
    return torch.minimum(volume, 8 * torch.minimum(a.determinant, b.determinant))
