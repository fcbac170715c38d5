# SPDX-License-Identifier: Apache-2.0
"""Loss of rendered views (RayTran appendix A)."""

from __future__ import annotations

import torch.nn.functional as F
from torch import Tensor

from raytran.structs import Views


def view_loss(logits: Tensor, target: Views) -> Tensor:
    """Return the mean squared error of colours in [0, 1].

    Args:
        logits: ``(B, V, 3, H, W)``.
        target: ``V`` photographs of each scene, taken by the cameras that were rendered.
    """
    return F.mse_loss(logits.float().sigmoid(), target.colors())
