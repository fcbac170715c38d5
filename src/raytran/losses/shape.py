# SPDX-License-Identifier: Apache-2.0
"""Loss of the objects' shapes (RayTran §3.2)."""

from __future__ import annotations

import torch.nn.functional as F
from torch import Tensor


def shape_loss(logits: Tensor, target: Tensor, *, num_objects: Tensor) -> Tensor:
    """Return the binary cross entropy, mean over cells, sum over objects divided by ``num_objects``.

    Args:
        logits: ``(M, S, S, S)``.
        target: ``(M, S, S, S)`` bool.
        num_objects: scalar.
    """
    entropy = F.binary_cross_entropy_with_logits(logits.float(), target.float(), reduction="none")
    return entropy.flatten(1).mean(dim=1).sum() / num_objects
