# SPDX-License-Identifier: Apache-2.0
"""Normalisation that stays in 16 bits where its input is, under autocast."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn


class LayerNorm(nn.LayerNorm):
    """``nn.LayerNorm`` in the precision of its input.

    Autocast would take a 16-bit stream to float32 for it, and back for each of the products that read it. It
    sums in float32 in any case.
    """

    def forward(self, x: Tensor) -> Tensor:
        """Normalise ``(..., C)``."""
        with torch.autocast(x.device.type, enabled=False):
            return F.layer_norm(
                x, self.normalized_shape, self.weight.to(x.dtype), self.bias.to(x.dtype), self.eps
            )
