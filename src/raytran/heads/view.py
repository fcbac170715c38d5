# SPDX-License-Identifier: Apache-2.0
"""View head: voxel features and new cameras → what these cameras would see (RayTran appendix A)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from torch import Tensor, nn

from raytran.geometry.camera import Cameras
from raytran.geometry.grid import VoxelGrid, ray_code
from raytran.heads.auxiliary import image_upsampler
from raytran.ops.pairs import Pairs


class ViewHead(nn.Module):
    """One more 3D→2D block onto the new camera's cells, then transposed convolutions up to image size.

    A cell starts as the embedding of its ray and attends to the voxels that its rays cross; a ray that
    misses the volume keeps that embedding alone.

    Args:
        stream: the 3D→2D half of a backbone block (``raytran.backbone.block.Stream``) of the same C.
        channels: C of the voxel features.
        widths: channels at stride 8, 4 and 2 (4 and 2 for features of stride 8), each divisible by four.
    """

    def __init__(
        self, *, stream: nn.Module, channels: int = 256, widths: Sequence[int] = (128, 64, 32)
    ) -> None:
        super().__init__()
        self.stride = 2 ** (len(widths) + 1)
        self.ray_position = nn.Sequential(nn.Linear(6, channels), nn.GELU(), nn.Linear(channels, channels))
        self.ray_norm = nn.LayerNorm(channels)
        self.stream: Any = stream  # a Stream, which this folder does not import
        self.pixel_norm = nn.LayerNorm(channels)
        self.upsampler = image_upsampler(channels, widths, outputs=3)

    def forward(self, voxels: Tensor, cameras: Cameras, grid: VoxelGrid, pairs: Pairs) -> Tensor:
        """Return images as logits of red, green and blue, ``(B, V, 3, H, W)``.

        Args:
            voxels: ``(B, X, Y, Z, C)``, normalised.
            cameras: the new ones, of leading shape ``(B, V)`` and size ``(H, W)``.
            grid: the voxel grids, ``center`` ``(B, 3)``.
            pairs: of the new cameras' cells, ``H/stride × W/stride``, with the voxels of all B scenes.
        """
        height, width = cameras.image_size
        rays = self.ray_position(ray_code(cameras, grid, (height // self.stride, width // self.stride)))
        of_voxels = self.stream.keys_and_values(voxels)
        pixels = self.stream(rays, self.ray_norm(rays), [of_voxels], [pairs])
        logits = self.upsampler(self.pixel_norm(pixels).movedim(-1, 1))
        return logits.unflatten(0, cameras.intrinsics.shape[:2])
