# SPDX-License-Identifier: Apache-2.0
"""One-to-one matching of predictions to true objects, greedy in the order of the scores."""

from __future__ import annotations

import torch
from torch import Tensor


def score_order(score: Tensor) -> Tensor:
    """Return the order of descending scores, ``(P,)`` int64; equal scores stay in order, NaN comes last."""
    return score.nan_to_num(nan=-torch.inf).argsort(descending=True, stable=True)


def match_in_order(order: Tensor, allowed: Tensor, preference: Tensor | None = None) -> Tensor:
    """Give each prediction in turn one true object that is still free.

    Args:
        order: ``(P,)`` int64, the turn of the predictions.
        allowed: ``(P, M)`` bool, whether a prediction may take an object.
        preference: ``(P, M)``; a prediction takes the free object that it prefers most, the first among
            equals. None: the first free object.

    Returns:
        ``(P,)`` int64, the object of each prediction, or -1.
    """
    match = torch.full((allowed.shape[0],), -1, dtype=torch.int64, device=allowed.device)
    wish = allowed.double() if preference is None else preference.double()
    wish = torch.where(allowed, wish, -torch.inf)
    for index in order[allowed[order].any(dim=1)].tolist():
        best, choice = wish[index].max(dim=0)  # the first of equals
        if best > -torch.inf:
            match[index] = choice
            wish[:, choice] = -torch.inf
    return match
