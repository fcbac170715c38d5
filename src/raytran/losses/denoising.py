# SPDX-License-Identifier: Apache-2.0
"""Losses of the noisy copies of true objects that the decoder corrects in training (DN-DETR)."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from raytran.heads.denoising import copied_objects
from raytran.losses.matcher import Match
from raytran.losses.objects import object_losses
from raytran.losses.pose import Betas
from raytran.structs import ObjectSet, RawObjects


def denoising_losses(
    layers: Sequence[RawObjects], targets: Sequence[ObjectSet], *, betas: Betas
) -> dict[str, Tensor]:
    """Return the class and pose losses of the copies, means over slots, sums over decoder layers.

    A scene without objects has slots that are copies of nothing: they count as slots without a loss.

    Args:
        layers: predictions ``(B, D, ...)`` of every layer.
        targets: true objects of B scenes.
        betas: of the poses' smooth L1.

    Returns:
        ``class``, ``center``, ``size`` and ``yaw``, scalars.
    """
    scenes, count = layers[-1].class_logits.shape[:2]
    device = layers[-1].center.device
    copied, matches = [], []
    for objects in targets:
        slots = torch.arange(count if len(objects) else 0, device=device)
        copied.append(
            objects.select(copied_objects(len(objects), count, device)) if len(objects) else objects
        )
        matches.append(Match(slots, slots))
    slots_in_all = layers[-1].center.new_tensor(float(scenes * count))
    totals: dict[str, Tensor] = {}
    for layer in layers:
        found = object_losses(
            layer,
            copied,
            matches,
            num_objects=slots_in_all,
            class_weight=slots_in_all,
            no_object_weight=0.0,
            betas=betas,
        )
        totals = {name: totals.get(name, 0.0) + value for name, value in found.items()}
    return totals
