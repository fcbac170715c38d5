# SPDX-License-Identifier: Apache-2.0
"""Object head: learned queries, decoded over the voxels into class, centre, size and yaw (RayTran §3.2)."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.quasirandom import SobolEngine

from raytran.geometry.grid import VoxelGrid
from raytran.geometry.position import position_code
from raytran.heads.decoder import DecoderLayer
from raytran.types import CLASSES, RawObjects

QUERY_SCALE = 0.1
"""Standard deviation of the query embeddings before training: small, so that what they read outweighs it."""

TYPICAL_SIZE = 0.7
"""Side of an object before training, metres."""


class ObjectHead(nn.Module):
    """Predicts the objects of a scene in ``num_queries`` slots, after every decoder layer.

    Every query is a learned embedding and a learned reference point in the volume. A layer predicts the
    centre as an offset from the reference point, and hands it on as the reference of the next layer
    (Deformable DETR, Zhu et al., ICLR 2021, but with gradients: early layers learn to aim for late ones).

    Args:
        channels: C of the voxel features and queries.
        num_heads: attention heads.
        num_layers: decoder layers L.
        num_queries: Q.
        hidden: channels inside the decoder's feed-forward.
        windowed: attend to the voxels through a learned window around the reference point, which learns from
            few scenes; False attends to all voxels alike, as in DETR and the paper.
        grid_extent: sizes of the voxel grid, metres, over which the reference points spread at first.
    """

    extent: Tensor

    def __init__(
        self,
        *,
        channels: int = 256,
        num_heads: int = 8,
        num_layers: int = 6,
        num_queries: int = 64,
        hidden: int = 1024,
        windowed: bool = False,
        grid_extent: Sequence[float] = (9.0, 9.0, 3.5),
    ) -> None:
        super().__init__()
        self.grid_extent = tuple(float(length) for length in grid_extent)
        # Sobol's points cover the volume more evenly than random ones, and are the same in every run.
        spread = SobolEngine(3).draw(num_queries + 1)[1:] - 0.5
        self.register_buffer("extent", torch.tensor(self.grid_extent), persistent=False)
        self.reference = nn.Parameter(0.8 * spread)
        self.query = nn.Parameter(QUERY_SCALE * torch.randn(num_queries, channels))
        self.position = nn.Linear(channels, channels)
        self.layers = nn.ModuleList(
            DecoderLayer(channels=channels, num_heads=num_heads, hidden=hidden, windowed=windowed)
            for _ in range(num_layers)
        )
        self.predictors = nn.ModuleList(ObjectPredictor(channels=channels) for _ in range(num_layers))

    def forward(self, voxels: Tensor, grid: VoxelGrid) -> tuple[RawObjects, ...]:
        """Return the predictions of every layer, last layer last.

        Args:
            voxels: ``(B, X, Y, Z, C)`` features.
            grid: the voxel grids, ``center`` ``(B, 3)``.
        """
        scenes = voxels.shape[0]
        grid_center = grid.center.to(self.extent.dtype)
        at_origin = VoxelGrid(grid.resolution, grid.extent, torch.zeros_like(self.extent))
        voxel_position = at_origin.voxel_centers().flatten(0, 2)
        memory = voxels.flatten(1, 3) + self._locate(voxel_position)
        queries = self.query.expand(scenes, -1, -1)
        reference = (self.reference * self.extent).expand(scenes, -1, -1)
        outputs = []
        for layer, predictor in zip(self.layers, self.predictors, strict=True):
            queries = layer(queries, self._locate(reference), reference, memory, voxel_position)
            objects = predictor(queries, reference, grid_center)
            reference = objects.center - grid_center[:, None]
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
        self.offset = _perceptron(channels, [0.0] * 3)
        self.log_size = _perceptron(channels, [math.log(TYPICAL_SIZE)] * 3)
        self.yaw = _perceptron(channels, [0.0, 1.0])

    def forward(self, queries: Tensor, reference: Tensor, grid_center: Tensor) -> RawObjects:
        """Return the predictions for queries ``(B, Q, C)`` at reference points ``(B, Q, 3)``.

        Pose is float32 even under autocast: 16 bits resolve a centre at 4 m to no better than millimetres.
        """
        embedding = self.norm(queries)
        return RawObjects(
            class_logits=self.category(embedding).float(),
            center=reference + self.offset(embedding).float() + grid_center[:, None],
            log_size=self.log_size(embedding).float(),
            yaw_vector=self.yaw(embedding).float(),
            embedding=embedding,
        )


def _perceptron(channels: int, start: list[float]) -> nn.Sequential:
    """Return a network of one hidden layer whose output is close to ``start`` before training."""
    last = nn.Linear(channels, len(start))
    nn.init.normal_(last.weight, std=0.01)
    with torch.no_grad():
        last.bias.copy_(torch.tensor(start))
    return nn.Sequential(nn.Linear(channels, channels), nn.GELU(), last)
