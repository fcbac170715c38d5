# SPDX-License-Identifier: Apache-2.0
"""Traversal on whatever device the cameras are on, as pairs for the attention that is asked for."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal, get_args

import torch

from raytran.errors import ConfigError
from raytran.geometry.camera import Cameras
from raytran.geometry.grid import VoxelGrid
from raytran.ops.pairs import Pairs, interpreted, why_no_kernels
from raytran.ops.traverse import trace_pairs

Attention = Literal["auto", "fused", "sparse"]
"""By what ray-traced attention is computed: fused kernels where they run, fused kernels, or torch.sparse."""


class RayTracer:
    """Finds the pairs that rays join: block pairs for the fused kernels, a pair list for torch.sparse.

    Args:
        attention: ``auto`` chooses the fused kernels where they run, ``fused`` insists on them, ``sparse``
            does without.

    Raises:
        ConfigError: there is no such attention.
    """

    def __init__(self, attention: Attention = "auto") -> None:
        if attention not in get_args(Attention):
            raise ConfigError(
                f"unknown attention={attention}: choose one of {', '.join(get_args(Attention))}"
            )
        self.attention = attention

    @torch.compiler.disable
    def __call__(
        self, cameras: Cameras, grid: VoxelGrid, feature_size: tuple[int, int], rays_per_cell: int
    ) -> Pairs:
        """Return the pairs of ``trace_pairs``, with both orders made; arguments and errors are its own.

        Raises:
            ConfigError: ``attention`` is ``fused`` and the fused kernels do not run here.
        """
        pairs: Pairs
        if self._is_fused(cameras.intrinsics.device):
            # CPU installations of torch lack Triton: its module is imported only where it runs.
            from raytran.ops.triton.traverse import trace_blocks

            pairs, _ = trace_blocks(cameras, grid, feature_size, rays_per_cell)
        else:
            pairs = trace_pairs(cameras, grid, feature_size, rays_per_cell)
            pairs = pairs if self.attention == "auto" else replace(pairs, fused=False)
        # Their sizes depend on the data: better here than in code compiled for one size.
        pairs.by("pixels"), pairs.by("voxels")
        return pairs

    def _is_fused(self, device: torch.device) -> bool:
        reason = why_no_kernels(device)
        if self.attention == "fused" and reason is not None and not interpreted():
            raise ConfigError(f"attention=fused needs a GPU with Triton, but {reason}: set attention=auto")
        return self.attention == "fused" or (self.attention == "auto" and reason is None)
