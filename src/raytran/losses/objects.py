# SPDX-License-Identifier: Apache-2.0
"""Class and pose of the objects: the errors that matching and loss add up, and the loss (RayTran §3.2)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from raytran.errors import ConfigError
from raytran.geometry.rotation import symmetric_yaw_error, yaw_from_rotation
from raytran.structs import PADDING, ObjectSet, RawObjects


class Match(NamedTuple):
    """Matched pairs of one scene.

    Attributes:
        query: ``(m,)`` int64, query of each pair.
        target: ``(m,)`` int64, true object of each pair; m = min(Q, M).
    """

    query: Tensor
    target: Tensor


class Betas(NamedTuple):
    """Errors at which smooth L1 turns from a square to a line; 0 makes it a line throughout.

    Attributes:
        center: along each axis, metres.
        yaw: radians.
    """

    center: float = 0.1
    yaw: float = 0.1

    def checked(self) -> Betas:
        """Return them as numbers.

        Raises:
            ConfigError: one is negative or not finite.
        """
        for name, beta in self._asdict().items():
            if not 0 <= beta < math.inf:
                raise ConfigError(f"loss.{name}_beta={beta}: give a length or an angle, at least 0")
        return Betas(float(self.center), float(self.yaw))


def pose_errors(
    center: Tensor, log_size: Tensor, yaw_vector: Tensor, target: ObjectSet, betas: Betas
) -> dict[str, Tensor]:
    """Return the pose losses of predictions against true objects, not reduced over objects.

    Smooth L1 of the centre and L1 of the logarithm of the size, each summed over the three axes, and smooth
    L1 of the yaw, wrapped and taken as the least over the target's symmetries.

    Args:
        center: ``(..., M or 1, 3)`` metres.
        log_size: ``(..., M or 1, 3)``.
        yaw_vector: ``(..., M or 1, 2)`` (sin, cos), of any length.
        target: M true objects.
        betas: of smooth L1.

    Returns:
        ``center``, ``size`` and ``yaw``, each ``(..., M)``.
    """
    yaw = yaw_from_vector(yaw_vector)
    yaw_error = symmetric_yaw_error(yaw, yaw_from_rotation(target.rotation), target.symmetry)
    return {
        "center": _smooth_l1(center - target.center, betas.center).sum(dim=-1),
        "size": (log_size - target.size.log()).abs().sum(dim=-1),
        "yaw": _smooth_l1(yaw_error, betas.yaw),
    }


def _smooth_l1(error: Tensor, beta: float) -> Tensor:
    return F.smooth_l1_loss(error, torch.zeros_like(error), reduction="none", beta=beta)


def yaw_from_vector(yaw_vector: Tensor) -> Tensor:
    """Return the angle of ``(..., 2)`` (sin, cos), ``(...)`` radians, with a gradient of length one.

    The true gradient is as long as one over the vector's length: it explodes near zero and fades far away.
    This one is that of the vector on the unit circle, whatever its length; it only turns the vector.
    """
    length = torch.linalg.vector_norm(yaw_vector.detach(), dim=-1, keepdim=True)
    # (sin, cos) of no rotation, (0, 1), made on the device: a copy to it would make the host wait.
    no_yaw = torch.arange(2, dtype=yaw_vector.dtype, device=yaw_vector.device)
    unit = torch.where(length > 0, yaw_vector.detach() / length, no_yaw)
    sin, cos = (unit + (yaw_vector - yaw_vector.detach())).unbind(dim=-1)
    return torch.atan2(sin, cos)


def object_losses(
    raw: RawObjects,
    targets: Sequence[ObjectSet],
    matches: Sequence[Match],
    *,
    num_objects: Tensor,
    class_weight: Tensor,
    no_object_weight: float,
    betas: Betas,
) -> dict[str, Tensor]:
    """Return the class and pose losses of one decoder layer.

    Args:
        raw: predictions of B scenes.
        targets: true objects of B scenes.
        matches: pairs of queries and true objects.
        num_objects: scalar by which the pose losses' sums are divided.
        class_weight: scalar by which the cross entropies' weighted sum over queries is divided; the sum of
            the weights gives their mean.
        no_object_weight: weight of the padding class in the cross entropy.
        betas: of the poses' smooth L1.

    Returns:
        ``class``, ``center``, ``size`` and ``yaw``, scalars; zero pose losses without objects.
    """
    label = torch.full(raw.class_logits.shape[:2], PADDING, device=raw.class_logits.device)
    losses = {name: raw.center.new_zeros(()) for name in ("class", "center", "size", "yaw")}
    for scene, (objects, match) in enumerate(zip(targets, matches, strict=True)):
        label[scene, match.query] = objects.label[match.target]
        errors = pose_errors(
            raw.center[scene, match.query],
            raw.log_size[scene, match.query],
            raw.yaw_vector[scene, match.query],
            objects.select(match.target),
            betas,
        )
        for name, error in errors.items():
            losses[name] = losses[name] + error.sum() / num_objects
    weight_of = torch.ones(PADDING + 1, device=label.device)
    weight_of[PADDING] = no_object_weight
    logits = raw.class_logits.float().flatten(0, 1)
    entropy = F.cross_entropy(logits, label.flatten(), weight=weight_of, reduction="sum")
    losses["class"] = entropy / class_weight
    return losses
