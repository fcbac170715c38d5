# SPDX-License-Identifier: Apache-2.0
"""Loss of the amodal foreground masks (RayTran §3.2)."""

from __future__ import annotations

import torch.nn.functional as F
from torch import Tensor


def foreground_loss(logits: Tensor, target: Tensor) -> Tensor:
    """Return the binary cross entropy of logits and bool target, both ``(B, N, H, W)``; mean over pixels."""
    return F.binary_cross_entropy_with_logits(logits.float(), target.float())
