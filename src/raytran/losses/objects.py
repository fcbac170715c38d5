# SPDX-License-Identifier: Apache-2.0
"""Class and pose of the objects: the errors that matching and loss add up, and the loss (RayTran §3.2)."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from raytran.errors import ConfigError
from raytran.geometry.rotation import symmetric_yaw_error, yaw_from_rotation
from raytran.structs import ObjectSet, RawObjects, constant


class Match(NamedTuple):
    """Matched pairs of queries and true objects, of L decoder layers; P of each, those of B scenes together.

    Attributes:
        query: ``(L, P)`` int64, the query of each pair, counted scene-major from 0 to B · Q.
        target: ``(L, P)`` int64, its true object, counted through all scenes as in ``TrueObjects``.
    """

    query: Tensor
    target: Tensor


class TrueObjects(NamedTuple):
    """Class and pose of the true objects of all scenes, one scene after another; M in all.

    Attributes:
        label: ``(M,)`` int64.
        center: ``(M, 3)`` metres.
        log_size: ``(M, 3)``.
        yaw: ``(M,)`` radians.
        symmetry: ``(M,)`` int64, see ``ObjectSet``.
    """

    label: Tensor
    center: Tensor
    log_size: Tensor
    yaw: Tensor
    symmetry: Tensor

    @classmethod
    def of(cls, *scenes: ObjectSet) -> TrueObjects:
        """Join the objects of scenes, at least one."""
        label, center, size, rotation, symmetry = (
            getattr(scenes[0], name) if len(scenes) == 1 else torch.cat([getattr(s, name) for s in scenes])
            for name in ("label", "center", "size", "rotation", "symmetry")
        )
        return cls(label, center, size.log(), yaw_from_rotation(rotation), symmetry)

    def select(self, index: Tensor) -> TrueObjects:
        """Return the objects at ``index``, int64 of any shape."""
        return TrueObjects(*(values[index] for values in self))


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


class Differences(NamedTuple):
    """By how much the poses of predictions differ from those of true objects.

    Attributes:
        center: ``(..., 3)`` metres.
        log_size: ``(..., 3)``.
        yaw: ``(...)`` radians, wrapped and the least over the symmetries of the true object.
    """

    center: Tensor
    log_size: Tensor
    yaw: Tensor

    @classmethod
    def of(cls, center: Tensor, log_size: Tensor, yaw_vector: Tensor, target: TrueObjects) -> Differences:
        """Compare predictions with true objects.

        Args:
            center: ``(..., M or 1, 3)`` metres.
            log_size: ``(..., M or 1, 3)``.
            yaw_vector: ``(..., M or 1, 2)`` (sin, cos), of any length.
            target: the true objects, ``(M,)`` or one for each prediction.
        """
        yaw = symmetric_yaw_error(yaw_from_vector(yaw_vector), target.yaw, target.symmetry)
        return cls(center - target.center, log_size - target.log_size, yaw)

    @classmethod
    def of_all(cls, layers: RawObjects, targets: TrueObjects) -> Differences:
        """Compare every query with every true object of all scenes, ``(L, B, Q, M, ...)``."""
        center, log_size, yaw_vector = (
            values[..., None, :] for values in (layers.center, layers.log_size, layers.yaw_vector)
        )
        return cls.of(center, log_size, yaw_vector, targets)

    def of_pairs(self, match: Match) -> Differences:
        """Return those of ``of_all`` that are of matched pairs, ``(L, P, ...)``."""
        pair = match.query * self.yaw.shape[-1] + match.target
        center, log_size, yaw = (
            pick_queries(values.flatten(2, 3), pair)
            for values in (self.center, self.log_size, self.yaw[..., None])
        )
        return Differences(center, log_size, yaw[..., 0])


def pose_errors(differences: Differences, betas: Betas) -> dict[str, Tensor]:
    """Return the pose losses of ``differences``, not reduced over objects.

    Smooth L1 of the centre and L1 of the logarithm of the size, each summed over the three axes, and smooth
    L1 of the yaw.

    Args:
        differences: of any number of pairs ``(...)``.
        betas: of smooth L1.

    Returns:
        ``center``, ``size`` and ``yaw``, each ``(...)``.
    """
    return {
        "center": _smooth_l1(differences.center, betas.center).sum(dim=-1),
        "size": differences.log_size.abs().sum(dim=-1),
        "yaw": _smooth_l1(differences.yaw, betas.yaw),
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
    layers: RawObjects,
    targets: TrueObjects,
    match: Match,
    differences: Differences,
    *,
    num_objects: Tensor,
    class_weight: Tensor,
    no_object_weight: float,
    betas: Betas,
) -> dict[str, Tensor]:
    """Return the class and pose losses of some decoder layers.

    Args:
        layers: predictions ``(L, B, Q, ...)``.
        targets: true objects of the B scenes.
        match: pairs of queries and true objects.
        differences: ``Differences.of_all`` of both.
        num_objects: scalar by which the pose losses' sums are divided.
        class_weight: scalar by which the cross entropies' weighted sum over queries is divided; the sum of
            the weights gives their mean.
        no_object_weight: weight of the padding class in the cross entropy.
        betas: of the poses' smooth L1.

    Returns:
        ``class``, ``center``, ``size`` and ``yaw`` of each layer, ``(L,)``; zero pose losses without objects.
    """
    logits = layers.class_logits.float().flatten(1, 2)
    padding = logits.shape[-1] - 1
    label = torch.full(logits.shape[:2], padding, device=logits.device)
    label.scatter_(1, match.query, targets.label[match.target])
    weights = constant((*[1.0] * padding, no_object_weight), logits.dtype, device=logits.device)
    entropy = F.cross_entropy(logits.flatten(0, 1), label.flatten(), weights, reduction="none")
    losses = {"class": entropy.view(label.shape).sum(dim=-1) / class_weight}
    errors = pose_errors(differences.of_pairs(match), betas)
    return losses | {name: error.sum(dim=-1) / num_objects for name, error in errors.items()}


def pick_queries(values: Tensor, query: Tensor) -> Tensor:
    """Return values ``(L, B, Q, n)`` at ``Match.query``, ``(L, P, n)``."""
    flat = values.flatten(1, 2)
    return flat.gather(1, query[..., None].expand(-1, -1, flat.shape[-1]))
