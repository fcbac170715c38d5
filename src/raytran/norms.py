# SPDX-License-Identifier: Apache-2.0
"""Layer and group normalisation in the precision of their input.

Autocast would take a 16-bit input to float32 for them, and back for each of the products that read it. They
sum in float32 in any case.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn


class LayerNorm(nn.LayerNorm):
    """``nn.LayerNorm`` in the precision of its input."""

    def forward(self, x: Tensor) -> Tensor:
        """Normalise ``(..., C)``."""
        with torch.autocast(x.device.type, enabled=False):
            return F.layer_norm(
                x, self.normalized_shape, self.weight.to(x.dtype), self.bias.to(x.dtype), self.eps
            )


class GroupNorm(nn.GroupNorm):
    """``nn.GroupNorm`` in the precision of its input."""

    def forward(self, x: Tensor) -> Tensor:
        """Normalise ``(n, C, ...)``."""
        with torch.autocast(x.device.type, enabled=False):
            return F.group_norm(x, self.num_groups, self.weight.to(x.dtype), self.bias.to(x.dtype), self.eps)
