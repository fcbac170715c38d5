# SPDX-License-Identifier: Apache-2.0
"""Denoising: queries made of noisy true objects, which the decoder learns to correct in training.

DN-DETR (Li et al., CVPR 2022). These queries need no matching: from the first step on, each has a known true
object that it should become. Predictions never see them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from typing import Any

import torch
from torch import Tensor, nn

from raytran.errors import ConfigError
from raytran.geometry.grid import VoxelGrid
from raytran.geometry.rotation import yaw_from_rotation
from raytran.heads.objects import QUERY_SCALE, ObjectHead, ObjectOutputs, Queries
from raytran.losses.objects import Betas, Differences, Match, TrueObjects, object_losses
from raytran.losses.total import ExtensionLoss
from raytran.structs import ObjectSet, RawObjects, RawScene, sent_to

CENTER_NOISE = 0.5
"""Largest shift of a centre, as a multiple of the object's size along each of its axes: it stays inside."""

SIZE_NOISE, YAW_NOISE = 0.4, 0.5
"""Largest change of the logarithm of the size, and of the yaw in radians."""

WRONG_CLASS = 0.2
"""Probability that a copy is told a random class."""


class DenoisingObjectHead(ObjectHead):
    """An object head that in training also corrects ``num_copies`` noisy copies of the true objects.

    The copies change nothing of the other predictions.

    Args:
        num_copies: D for each scene.
        settings: those of ``ObjectHead``.

    Raises:
        ConfigError: there are to be no copies.
    """

    def __init__(self, *, num_copies: int, **settings: Any) -> None:
        super().__init__(**settings)
        if num_copies < 1:
            raise ConfigError(f"num_copies must be 1 or more, got {num_copies}")
        # Made last, so that the other parts start from the same weights with and without it.
        self.denoising_queries = NoisyCopies(
            channels=self.position.in_features, num_copies=num_copies, num_classes=self.num_classes
        )

    def forward(
        self, voxels: Tensor, grid: VoxelGrid, true_objects: Sequence[ObjectSet] | None = None
    ) -> ObjectOutputs:
        """Return the predictions of every layer, in training also those for the copies of ``true_objects``.

        Args:
            voxels: ``(B, X, Y, Z, C)`` features.
            grid: the voxel grids, ``center`` ``(B, 3)``.
            true_objects: of B scenes.
        """
        if true_objects is None or not self.training:
            return super().forward(voxels, grid)
        queries: Queries = self.queries(voxels, grid)
        num_queries = queries.embedding.shape[1]
        mask = attention_mask(num_queries, self.denoising_queries.num_copies, voxels.device)
        joined = join_queries(queries, self.denoising_queries(true_objects, queries, grid))
        layers = self.decode(joined, voxels, grid, mask)
        return ObjectOutputs(
            layers=tuple(_select_queries(layer, slice(num_queries)) for layer in layers),
            proposals=queries.proposals,
            denoising=tuple(_select_queries(layer, slice(num_queries, None)) for layer in layers),
        )


class NoisyCopies(nn.Module):
    """Makes queries of the true objects of each scene: query i is a copy of object i modulo M.

    A copy's embedding is that of its class, its reference point lies near the object's centre. Where queries
    are proposed, size and yaw start near the true ones too, as a proposal's do; learned queries start from
    the same size and yaw everywhere, and so do copies beside them.

    Args:
        channels: C.
        num_copies: D of each scene; if it has more objects the last ones get none.
        num_classes: K.
    """

    class_layers = ("embedding",)

    def __init__(self, *, channels: int, num_copies: int, num_classes: int) -> None:
        super().__init__()
        self.num_copies = num_copies
        self.embedding = nn.Parameter(QUERY_SCALE * torch.randn(num_classes, channels))

    @torch.compiler.disable
    def forward(self, true_objects: Sequence[ObjectSet], start: Queries, grid: VoxelGrid) -> Queries:
        """Return D queries for each of B scenes; those of a scene without objects stand in its middle.

        Args:
            true_objects: of B scenes.
            start: the other queries.
            grid: the voxel grids, ``center`` ``(B, 3)``.
        """
        center = grid.center.to(start.reference.dtype)
        copies = [
            self._copy(objects.to(center.device), middle)
            for objects, middle in zip(true_objects, center, strict=True)
        ]
        label, place, log_size, yaw = (torch.stack(values) for values in zip(*copies, strict=True))
        shape = label.shape
        told = torch.where(
            torch.rand(shape, device=label.device) < WRONG_CLASS,
            torch.randint(len(self.embedding), shape, device=label.device),
            label,
        )
        if start.proposals is None:
            log_size = start.log_size[:, :1].expand_as(log_size)
            yaw_vector = start.yaw_vector[:, :1].expand(*shape, 2)
        else:
            log_size = log_size + SIZE_NOISE * _noise(log_size)
            yaw = yaw + YAW_NOISE * _noise(yaw)
            yaw_vector = torch.stack([yaw.sin(), yaw.cos()], dim=-1)
        return Queries(self.embedding[told], place - center[:, None], log_size, yaw_vector, None)

    def _copy(self, objects: ObjectSet, middle: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return labels, noisy centres, logarithms of the sizes and yaws of D copies."""
        count = self.num_copies
        if not len(objects):
            return (
                torch.zeros(count, dtype=torch.int64, device=middle.device),
                middle.expand(count, 3),
                middle.new_zeros(count, 3),
                middle.new_zeros(count),
            )
        some = objects.select(copied_objects(len(objects), count, middle.device))
        shift = CENTER_NOISE * _noise(some.size) * some.size
        place = some.center + (some.rotation @ shift[..., None]).squeeze(-1)
        return some.label, place, some.size.log(), yaw_from_rotation(some.rotation)


def copied_objects(num_objects: int, num_copies: int, device: torch.device) -> Tensor:
    """Return which object each query is a copy of, ``(D,)`` int64."""
    return torch.arange(num_copies, device=device) % num_objects


def join_queries(queries: Queries, copies: Queries) -> Queries:
    """Return both, the copies behind."""
    both = [torch.cat([getattr(queries, name), getattr(copies, name)], dim=1) for name in Queries._fields[:4]]
    return Queries(both[0], both[1], both[2], both[3], queries.proposals)


def attention_mask(num_queries: int, num_copies: int, device: torch.device) -> Tensor:
    """Return who must not attend to whom, ``(Q + D, Q + D)`` bool, rows attend to columns.

    Queries must not see the truth in the copies, nor may two copies of an object average their noise away: a
    copy attends to itself and to the queries.
    """
    total = num_queries + num_copies
    is_copy = torch.arange(total, device=device) >= num_queries
    return is_copy.expand(total, total) & ~torch.eye(total, dtype=torch.bool, device=device)


def _noise(like: Tensor) -> Tensor:
    """Return numbers between -1 and 1."""
    return 2 * torch.rand_like(like) - 1


def _select_queries(objects: RawObjects, which: slice) -> RawObjects:
    return RawObjects(*(getattr(objects, field.name)[:, which] for field in fields(objects)))


class DenoisingLoss(ExtensionLoss):
    """The loss of the copies, a term of ``TotalLoss.extensions``."""

    reads = "denoising"

    def forward(
        self, raw: RawScene, targets: Sequence[ObjectSet], *, num_objects: Tensor, betas: Betas
    ) -> dict[str, Tensor]:
        """Return ``denoising_losses`` of what the network returned."""
        layers = [layer.in_float32() for layer in raw.denoising or ()]
        return denoising_losses(layers, targets, betas=betas)


def denoising_losses(
    layers: Sequence[RawObjects], targets: Sequence[ObjectSet], *, betas: Betas
) -> dict[str, Tensor]:
    """Return the class and pose losses of the copies, means over queries, sums over decoder layers.

    A scene without objects has queries that are copies of nothing: they count as queries without a loss.

    Args:
        layers: predictions ``(B, D, ...)`` of every layer.
        targets: true objects of B scenes.
        betas: of the poses' smooth L1.

    Returns:
        ``class``, ``center``, ``size`` and ``yaw``, scalars.
    """
    stacked = RawObjects.stack(layers)
    _, scenes, count = stacked.class_logits.shape[:3]
    copies = torch.arange(count, device="cpu")
    pairs, first = [copies.new_empty(2, 0)], 0
    for scene, objects in enumerate(targets):
        if len(objects):
            target = first + copied_objects(len(objects), count, copies.device)
            pairs.append(torch.stack([scene * count + copies, target]))
        first += len(objects)
    match = Match(
        *sent_to(stacked.center.device, torch.cat(pairs, dim=1))[:, None].expand(-1, len(layers), -1)
    )
    num_queries = stacked.center.new_full((), scenes * count)
    true = TrueObjects.of(*targets)
    found = object_losses(
        stacked,
        true,
        match,
        Differences.of_all(stacked, true),
        num_objects=num_queries,
        class_weight=num_queries,
        no_object_weight=0.0,
        betas=betas,
    )
    return {name: values.sum() for name, values in found.items()}
