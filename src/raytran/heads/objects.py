# SPDX-License-Identifier: Apache-2.0
"""Object head: queries, decoded over the voxels into class, centre, size and yaw (RayTran §3.2)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import torch
from torch import Tensor, nn

from raytran.errors import ConfigError
from raytran.geometry.grid import VoxelGrid
from raytran.geometry.position import position_code
from raytran.heads.decoder import DecoderLayer
from raytran.heads.queries import LearnedQueries, ProposalQueries, Queries
from raytran.types import CLASSES, RawObjects, RawProposals


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
        grid_extent: sizes of the voxel grid, metres.

    Raises:
        ConfigError: ``queries`` or ``refines`` is unknown.
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
        grid_extent: Sequence[float] = (9.0, 9.0, 3.5),
    ) -> None:
        super().__init__()
        if queries not in ("learned", "proposal"):
            raise ConfigError(f"unknown queries={queries}: choose learned or proposal")
        if refines not in ("center", "box"):
            raise ConfigError(f"unknown refines={refines}: choose center or box")
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

    def forward(self, voxels: Tensor, grid: VoxelGrid) -> tuple[tuple[RawObjects, ...], RawProposals | None]:
        """Return the predictions of every layer, last layer last, and the proposals if queries are proposed.

        Args:
            voxels: ``(B, X, Y, Z, C)`` features.
            grid: the voxel grids, ``center`` ``(B, 3)``.
        """
        grid_center = grid.center.to(self.extent.dtype)
        at_origin = VoxelGrid(grid.resolution, grid.extent, torch.zeros_like(self.extent))
        voxel_position = at_origin.voxel_centers().flatten(0, 2)
        memory = voxels.flatten(1, 3) + self._locate(voxel_position)
        start: Queries = self.queries(voxels, grid)
        embedding, box = start.embedding, start
        outputs = []
        for layer, predictor in zip(self.layers, self.predictors, strict=True):
            embedding = layer(embedding, self._locate(box.reference), box.reference, memory, voxel_position)
            objects = predictor(embedding, box, grid_center)
            box = box._replace(reference=objects.center - grid_center[:, None])
            if self.refines == "box":
                box = box._replace(log_size=objects.log_size, yaw_vector=objects.yaw_vector)
            outputs.append(objects)
        return tuple(outputs), start.proposals

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


def _perceptron(channels: int, outputs: int) -> nn.Sequential:
    """Return a network of one hidden layer whose output is close to zero before training."""
    last = nn.Linear(channels, outputs)
    nn.init.normal_(last.weight, std=0.01)
    nn.init.zeros_(last.bias)
    return nn.Sequential(nn.Linear(channels, channels), nn.GELU(), last)
