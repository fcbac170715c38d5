# SPDX-License-Identifier: Apache-2.0
"""Object head: queries, decoded over the voxels into class, centre, size and yaw (RayTran §3.2)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from typing import Literal

import torch
from torch import Tensor, nn

from raytran.errors import ConfigError
from raytran.geometry.grid import VoxelGrid
from raytran.geometry.position import position_code
from raytran.heads.decoder import DecoderLayer
from raytran.heads.denoising import NoisyCopies, attention_mask, join_queries
from raytran.heads.queries import LearnedQueries, ProposalQueries, Queries
from raytran.structs import CLASSES, ObjectSet, RawObjects, RawProposals


class ObjectHead(nn.Module):
    """Predicts the objects of a scene in ``num_queries`` slots, after every decoder layer.

    Every query is an embedding and a reference point in the volume. A layer predicts the centre as an offset
    from the reference point, and hands it on as the reference of the next layer (Deformable DETR, Zhu et al.,
    ICLR 2021, but with gradients: early layers learn to aim for late ones).

    Args:
        channels: C of the voxel features and queries.
        num_heads: attention heads.
        num_layers: decoder layers L.
        num_queries: Q.
        queries: ``"learned"``, the same for every scene as in the paper, or ``"proposal"``, the voxels most
            likely to hold an object's centre, which learns from few scenes.
        hidden: channels inside the decoder's feed-forward.
        windowed: attend to the voxels through a learned window around the reference point, which learns from
            few scenes; False attends to all voxels alike, as in DETR and the paper.
        refines: what a layer hands on to the next, which predicts the difference: ``"center"``, or ``"box"``,
            size and yaw too (iterative box refinement in Deformable DETR).
        num_copies: noisy copies of the true objects that a scene's queries are joined by in training, to be
            corrected (``raytran.heads.denoising``); 0 for none, as in the paper.
        grid_extent: sizes of the voxel grid, metres.

    Raises:
        ConfigError: ``queries`` or ``refines`` is unknown, or ``num_copies`` is negative.
    """

    extent: Tensor

    def __init__(
        self,
        *,
        channels: int = 256,
        num_heads: int = 8,
        num_layers: int = 6,
        num_queries: int = 64,
        queries: Literal["learned", "proposal"] = "learned",
        hidden: int = 1024,
        windowed: bool = False,
        refines: Literal["center", "box"] = "center",
        num_copies: int = 0,
        grid_extent: Sequence[float] = (9.0, 9.0, 3.5),
    ) -> None:
        super().__init__()
        if queries not in ("learned", "proposal"):
            raise ConfigError(f"unknown queries={queries}: choose learned or proposal")
        if refines not in ("center", "box"):
            raise ConfigError(f"unknown refines={refines}: choose center or box")
        if num_copies < 0:
            raise ConfigError(f"num_copies must be 0 or more, got {num_copies}")
        self.refines = refines
        self.grid_extent = tuple(float(length) for length in grid_extent)
        self.register_buffer("extent", torch.tensor(self.grid_extent), persistent=False)
        self.queries: nn.Module = (
            LearnedQueries(channels=channels, num_queries=num_queries, extent=self.grid_extent)
            if queries == "learned"
            else ProposalQueries(channels=channels, num_queries=num_queries)
        )
        self.position = nn.Linear(channels, channels)
        self.layers = nn.ModuleList(
            DecoderLayer(channels=channels, num_heads=num_heads, hidden=hidden, windowed=windowed)
            for _ in range(num_layers)
        )
        self.predictors = nn.ModuleList(ObjectPredictor(channels=channels) for _ in range(num_layers))
        # Last, so that the other parts start from the same weights with and without.
        self.copies = NoisyCopies(channels=channels, num_copies=num_copies) if num_copies else None

    def forward(self, voxels: Tensor, grid: VoxelGrid) -> tuple[tuple[RawObjects, ...], RawProposals | None]:
        """Return the predictions of every layer, last layer last, and the proposals if queries are proposed.

        Args:
            voxels: ``(B, X, Y, Z, C)`` features.
            grid: the voxel grids, ``center`` ``(B, 3)``.
        """
        start: Queries = self.queries(voxels, grid)
        return self._decode(start, voxels, grid), start.proposals

    @property
    def makes_copies(self) -> bool:
        """Whether ``forward_with_copies`` has any: in training mode, if there are to be any."""
        return self.copies is not None and self.training

    def forward_with_copies(
        self, voxels: Tensor, grid: VoxelGrid, known: Sequence[ObjectSet]
    ) -> tuple[tuple[RawObjects, ...], RawProposals | None, tuple[RawObjects, ...]]:
        """Return what ``forward`` does, and the predictions of every layer for noisy copies of true objects.

        The copies change nothing of the others.

        Args:
            voxels: ``(B, X, Y, Z, C)`` features.
            grid: the voxel grids, ``center`` ``(B, 3)``.
            known: the true objects of B scenes.

        Raises:
            ConfigError: the head makes no copies.
        """
        if self.copies is None:
            raise ConfigError("this object head makes no copies: set model.heads.objects.num_copies")
        start: Queries = self.queries(voxels, grid)
        count = start.embedding.shape[1]
        mask = attention_mask(count, self.copies.num_copies, voxels.device)
        joined = join_queries(start, self.copies(known, start, grid))
        layers = self._decode(joined, voxels, grid, mask)
        own = tuple(_slots(layer, slice(count)) for layer in layers)
        return own, start.proposals, tuple(_slots(layer, slice(count, None)) for layer in layers)

    def _decode(
        self, start: Queries, voxels: Tensor, grid: VoxelGrid, mask: Tensor | None = None
    ) -> tuple[RawObjects, ...]:
        """Return the predictions of every layer for the queries of ``start``."""
        grid_center = grid.center.to(self.extent.dtype)
        at_origin = VoxelGrid(grid.resolution, grid.extent, torch.zeros_like(self.extent))
        voxel_position = at_origin.voxel_centers().flatten(0, 2)
        memory = voxels.flatten(1, 3) + self._locate(voxel_position)
        embedding, box = start.embedding, start
        outputs = []
        for layer, predictor in zip(self.layers, self.predictors, strict=True):
            position = self._locate(box.reference)
            embedding = layer(embedding, position, box.reference, memory, voxel_position, mask)
            objects = predictor(embedding, box, grid_center)
            box = box._replace(reference=objects.center - grid_center[:, None])
            if self.refines == "box":
                box = box._replace(log_size=objects.log_size, yaw_vector=objects.yaw_vector)
            outputs.append(objects)
        return tuple(outputs)

    def _locate(self, points: Tensor) -> Tensor:
        """Return the code ``(..., C)`` of points ``(..., 3)``, metres from the centre of the volume."""
        return self.position(position_code(points, self.grid_extent, self.position.in_features))


class ObjectPredictor(nn.Module):
    """Class and pose of each query, one small network each.

    Args:
        channels: C of the queries.
    """

    def __init__(self, *, channels: int) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(channels)
        self.category = nn.Linear(channels, len(CLASSES) + 1)
        self.offset = _perceptron(channels, 3)
        self.log_size = _perceptron(channels, 3)
        self.yaw = _perceptron(channels, 2)

    def forward(self, embedding: Tensor, start: Queries, grid_center: Tensor) -> RawObjects:
        """Return the predictions for query embeddings ``(B, Q, C)``, added to the boxes of ``start``.

        Pose is float32 even under autocast: 16 bits resolve a centre at 4 m to no better than millimetres.
        """
        embedding = self.norm(embedding)
        return RawObjects(
            class_logits=self.category(embedding).float(),
            center=start.reference + self.offset(embedding).float() + grid_center[:, None],
            log_size=start.log_size + self.log_size(embedding).float(),
            yaw_vector=start.yaw_vector + self.yaw(embedding).float(),
            embedding=embedding,
        )


def _slots(objects: RawObjects, some: slice) -> RawObjects:
    return RawObjects(*(getattr(objects, field.name)[:, some] for field in fields(objects)))


def _perceptron(channels: int, outputs: int) -> nn.Sequential:
    """Return a network of one hidden layer whose output is close to zero before training."""
    last = nn.Linear(channels, outputs)
    nn.init.normal_(last.weight, std=0.01)
    nn.init.zeros_(last.bias)
    return nn.Sequential(nn.Linear(channels, channels), nn.GELU(), last)
