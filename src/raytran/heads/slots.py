# SPDX-License-Identifier: Apache-2.0
"""From raw query slots to objects: the best class that is no padding, pose in the world, order by score."""

from __future__ import annotations

import torch
from torch import Tensor

from raytran.geometry.rotation import rotation_from_yaw
from raytran.structs import PADDING, ObjectSet, RawObjects


def objects_of_slots(
    raw: RawObjects, scene: int, *, score_threshold: float = 0.0
) -> tuple[ObjectSet, Tensor]:
    """Return one scene's objects, highest score first, and their embeddings.

    Args:
        raw: one decoder layer's output for B scenes.
        scene: which of them.
        score_threshold: slots whose best class has a lower probability are left out.

    Returns:
        M objects without shapes, and ``(M, C)`` embeddings.
    """
    probability = raw.class_logits[scene].softmax(dim=-1)[:, :PADDING]
    score, label = probability.max(dim=-1)
    order = score.argsort(descending=True, stable=True)
    order = order[score[order] >= score_threshold]
    sin, cos = raw.yaw_vector[scene, order].unbind(dim=-1)
    objects = ObjectSet(
        label=label[order],
        center=raw.center[scene, order],
        size=raw.log_size[scene, order].exp(),
        rotation=rotation_from_yaw(torch.atan2(sin, cos)),
        symmetry=torch.ones_like(label[order]),
        score=score[order],
    )
    return objects, raw.embedding[scene, order]
