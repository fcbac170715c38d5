# SPDX-License-Identifier: Apache-2.0
"""Shapes decoded from the voxels inside each predicted box, beside the query that the paper decodes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from raytran.geometry.grid import VoxelGrid
from raytran.geometry.rotation import rotation_from_yaw
from raytran.heads.shape import ShapeHead
from raytran.structs import RawObjects, constant

CELLS = 8
"""Cells a side of what is read in a box: the second resolution of the shape decoder."""


class BoxVoxelShapeHead(ShapeHead):
    """A ``ShapeHead`` that also reads the voxel features at ``CELLS``³ places in the predicted box.

    A query has one vector for all that it saw; where in the box something stands is told by the voxels. They
    are read between voxel centres (trilinear), along the box's own axes, and join the decoder at ``CELLS``
    cells a side. Boxes and voxels get no gradient: stage 3 trains the shape head alone.

    Args:
        channels: C of the query embedding and of the voxels.
        widths: as of ``ShapeHead``.

    Raises:
        ConfigError: as there.
    """

    def __init__(self, *, channels: int = 256, widths: Sequence[int] = (256, 128, 64, 32)) -> None:
        super().__init__(channels=channels, widths=widths)
        self.channels = channels
        self.read = nn.Conv3d(channels, self.widths[1], 1)

    @property
    def in_channels(self) -> int:
        """Numbers of each object that ``forward`` reads: C of its query, then C · ``CELLS``³ of its box."""
        return self.channels * (1 + CELLS**3)

    @torch.no_grad()
    def with_box_voxels(self, objects: RawObjects, voxels: Tensor, grid: VoxelGrid) -> RawObjects:
        """Return the objects with what the voxels hold in their boxes behind their embeddings.

        Args:
            objects: of Q queries in B scenes.
            voxels: ``(B, X, Y, Z, C)`` features.
            grid: of the voxels, ``center`` ``(B, 3)``.
        """
        points = box_points(objects, CELLS)
        features = read_voxels(voxels, grid, points.flatten(1, 2)).unflatten(1, points.shape[1:3])
        read = features.movedim(-1, -2).flatten(2)
        embedding = torch.cat([objects.embedding, read.to(objects.embedding.dtype)], dim=-1)
        return replace(objects, embedding=embedding)

    def forward(self, embedding: Tensor) -> Tensor:
        """Map ``(M, in_channels)`` to occupancy logits ``(M, 63, 63, 63)``, indexed [x, y, z]."""
        query, box = embedding.split([self.channels, self.in_channels - self.channels], dim=-1)
        start = self.start(query).view(-1, self.widths[0], 4, 4, 4)
        coarse = self.upsampler[:2](start)
        seen = self.read(box.unflatten(-1, (self.channels, CELLS, CELLS, CELLS)))
        return self.upsampler[2:](coarse + seen).squeeze(1)


def box_points(objects: RawObjects, cells: int) -> Tensor:
    """Return the centres of ``cells``³ cells of each box, ``(B, Q, cells³, 3)`` metres, z fastest."""
    log_size = objects.log_size
    axis = (torch.arange(cells, dtype=log_size.dtype, device=log_size.device) + 0.5) / cells - 0.5
    unit = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), dim=-1).reshape(-1, 3)
    rotation = rotation_from_yaw(torch.atan2(*objects.yaw_vector.unbind(dim=-1)))
    turned = (unit * log_size.exp()[..., None, :]) @ rotation.mT
    return turned + objects.center[..., None, :]


def read_voxels(voxels: Tensor, grid: VoxelGrid, points: Tensor) -> Tensor:
    """Return the features at world points, between voxel centres trilinear; zero outside of the grid.

    Args:
        voxels: ``(B, X, Y, Z, C)``.
        grid: ``center`` ``(B, 3)``.
        points: ``(B, n, 3)`` metres.

    Returns:
        ``(B, n, C)`` float32.
    """
    extent = constant(tuple(grid.extent), points.dtype, device=points.device)
    unit = (points - grid.center[:, None].to(points.dtype)) / extent * 2
    # grid_sample wants channels first and coordinates of the last dimension first.
    features = F.grid_sample(
        voxels.movedim(-1, 1).float(), unit.flip(-1)[:, :, None, None], align_corners=False
    )
    return features[..., 0, 0].mT
