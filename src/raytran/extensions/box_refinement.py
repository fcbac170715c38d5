# SPDX-License-Identifier: Apache-2.0
"""Iterative refinement of the whole box: each decoder layer corrects the box of the one before.

As in Deformable DETR (Zhu et al., ICLR 2021), where the paper's decoder hands on the centre alone.
"""

from __future__ import annotations

from torch import Tensor, nn

from raytran.heads.objects import Queries
from raytran.structs import RawObjects


class BoxRefinement(nn.Module):
    """The next layer starts from the predicted centre, size and yaw."""

    def forward(self, start: Queries, objects: RawObjects, grid_center: Tensor) -> Queries:
        """Return what the next layer starts from; arguments as those of ``CenterRefinement``."""
        return start._replace(
            reference=objects.center - grid_center[:, None],
            log_size=objects.log_size,
            yaw_vector=objects.yaw_vector,
        )
