# SPDX-License-Identifier: Apache-2.0
"""The three errors of the Scan2CAD benchmark (Avetisyan et al., 2019) between predicted and true objects."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from raytran.geometry.rotation import geodesic_angle
from raytran.structs import SYMMETRY_INFINITE, ObjectSet

SCAN2CAD_LIMITS = (0.2, 20.0, 0.2)
"""Largest translation, rotation and scale error of an object that counts as found: metres, degrees, ratio."""

_PAIRS_AT_ONCE = 65_536
"""Pairs whose intermediate values, about a kilobyte each, are in memory together."""


def row_blocks(num_rows: int, num_columns: int, *, pairs: int = _PAIRS_AT_ONCE) -> list[slice]:
    """Return parts of the rows of a table of pairs that are small enough to be worked on together.

    A table of ordinary size is one part, and so is one without rows.
    """
    step = max(pairs // max(num_columns, 1), 1)
    return [slice(start, start + step) for start in range(0, max(num_rows, 1), step)]


class AlignmentErrors(NamedTuple):
    """Errors of every prediction against every true object, each ``(P, M)``.

    Attributes:
        translation: distance of the box centres, metres.
        rotation: angle of the turn that remains, degrees, the least over the true object's symmetries.
        scale: ``|mean_k(size_k / true size_k) - 1|``; as in the benchmark, opposite errors of the axes
            cancel.
    """

    translation: Tensor
    rotation: Tensor
    scale: Tensor

    def within(self, max_translation: float, max_rotation: float, max_scale: float) -> Tensor:
        """Return where all three errors keep their limits (metres, degrees, ratio), ``(P, M)`` bool."""
        close = (self.translation <= max_translation) & (self.rotation <= max_rotation)
        return close & (self.scale <= max_scale)


def alignment_errors(predictions: ObjectSet, targets: ObjectSet) -> AlignmentErrors:
    """Return the three errors of every prediction against every true object, in the inputs' precision."""
    translation = (predictions.center[:, None] - targets.center).norm(dim=-1)
    scale = ((predictions.size[:, None] / targets.size).mean(dim=-1) - 1).abs()
    rotation = symmetric_rotation_error(predictions.rotation, targets.rotation, targets.symmetry)
    return AlignmentErrors(translation, rotation, scale)


def symmetric_rotation_error(predicted: Tensor, target: Tensor, symmetry: Tensor) -> Tensor:
    """Return the angle from each target to each prediction, least over the target's turns about its up axis.

    The angle is that of the full rotation, so a tilt counts. For infinite symmetry the least over all turns
    is the angle between the two up axes.

    Args:
        predicted: ``(P, 3, 3)`` world_from_object.
        target: ``(M, 3, 3)`` world_from_object.
        symmetry: ``(M,)`` int64: 1, 2, 4 equal turns, or ``SYMMETRY_INFINITE``.

    Returns:
        ``(P, M)`` degrees in [0, 180].
    """
    quarter = torch.arange(4, device=target.device)
    turned = target @ _turns_about_up(quarter * (math.pi / 2), target.dtype)[:, None]
    equal = (quarter[:, None] * symmetry) % 4 == 0

    def error(predicted: Tensor) -> Tensor:
        angle = geodesic_angle(predicted[:, None, None], turned)
        finite = torch.where(equal, angle, torch.inf).amin(dim=1)
        up_distance = (predicted[:, None, :, 1] - target[:, :, 1]).norm(dim=-1)
        between_up = 2 * torch.asin((up_distance / 2).clamp(max=1.0))
        return torch.rad2deg(torch.where(symmetry == SYMMETRY_INFINITE, between_up, finite))

    return torch.cat([error(predicted[part]) for part in row_blocks(len(predicted), len(target))])


def _turns_about_up(angle: Tensor, dtype: torch.dtype) -> Tensor:
    """Return rotations about the object's +Y, ``(n,)`` radians → ``(n, 3, 3)``."""
    sin, cos = torch.sin(angle).to(dtype), torch.cos(angle).to(dtype)
    zero, one = torch.zeros_like(sin), torch.ones_like(sin)
    return torch.stack([cos, zero, sin, zero, one, zero, -sin, zero, cos], dim=-1).unflatten(-1, (3, 3))
