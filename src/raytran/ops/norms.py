# SPDX-License-Identifier: Apache-2.0
"""What is in 16 bits under autocast: norms of 16-bit streams, and what several products read."""

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


def in_product_dtype(x: Tensor) -> Tensor:
    """Return ``x`` as autocast's products take it: cast once for all that read it."""
    kind = x.device.type
    return x.to(torch.get_autocast_dtype(kind)) if torch.is_autocast_enabled(kind) else x
