# SPDX-License-Identifier: Apache-2.0
"""Matching of one scene as ROCA's vid2cad_evaluation.py does it (Gümeli et al., 2022), quirks and all."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import torch
from torch import Tensor

from raytran.errors import ShapeError
from raytran.metrics.functional.alignment import AlignmentErrors
from raytran.metrics.functional.cad_errors import cad_errors, equal_names
from raytran.metrics.functional.detection import match_in_order
from raytran.structs import CLASS_BY_CATID, CadAlignments

VID2CAD_CLASS_BY_CATID: dict[str, str] = {**CLASS_BY_CATID, "02818832": "bed"}
"""The nine classes of the script: bed instead of ``other``."""

_DUPLICATE_LIMITS = (0.4, 60.0, 0.6)
"""Two detections are one object within these metres, degrees and ratio of scale."""


def match_vid2cad(
    predictions: CadAlignments, targets: CadAlignments, limits: tuple[float, float, float]
) -> tuple[AlignmentErrors, Tensor]:
    """Give each prediction that is kept, by score, the first free model of its category that it fits.

    - Models and predictions of other categories than the nine match nothing.
    - Predicted values are rounded to float32, and translations and scales are compared in it.
    - A prediction that is close to a better one of its category is a duplicate and left out; for this alone
      quaternions are brought to length one.
    - Of each category the best are kept, as many as stand in the scene; they use that up matched or not.
    - The symmetry counts only if the predicted CAD model has the same one as the true model. It is looked up
      in the scene; a CAD model that is not there, at which the script fails, has none.

    Args:
        predictions: of one scene.
        targets: the annotated models.
        limits: metres, degrees, ratio; inclusive.

    Returns:
        the errors, each ``(P, M)``, and the model that each prediction takes, ``(P,)`` int64, or -1.

    Raises:
        ShapeError: ``targets`` lacks what annotations have.
    """
    if targets.symmetry is None:
        raise ShapeError("protocol vid2cad needs the symmetry of the annotated models")
    rounded = _in_float32(predictions)
    symmetry_of: dict[str, int] = {}
    for name, value in zip(targets.model_id, targets.symmetry.tolist(), strict=True):
        symmetry_of.setdefault(name, value)
    symmetry = torch.tensor([symmetry_of.get(name, 1) for name in rounded.model_id], dtype=torch.int64)
    shared = torch.where(symmetry[:, None] == targets.symmetry, targets.symmetry, 1)
    errors = cad_errors(rounded, targets, targets.translation, shared, torch.float32)
    order = rounded.score.argsort(descending=True, stable=True)
    counts = _counts(rounded.select(order), symmetry[order], Counter(targets.catid))
    named = torch.tensor([catid in VID2CAD_CLASS_BY_CATID for catid in targets.catid], dtype=torch.bool)
    fits = equal_names(rounded.catid, targets.catid) & named & errors.within(*limits)
    return errors, match_in_order(order[counts], fits)


def _in_float32(alignments: CadAlignments) -> CadAlignments:
    """Return float64 values that float32 can hold."""
    names = ("translation", "quaternion", "scale", "score")
    return replace(alignments, **{name: getattr(alignments, name).float().double() for name in names})


def _counts(ranked: CadAlignments, symmetry: Tensor, left: Counter[str]) -> Tensor:
    """Return which predictions are neither duplicates nor too many of their category, best first."""
    close = _close(ranked, symmetry)
    alive = torch.ones(len(ranked), dtype=torch.bool)
    for index in range(len(ranked)):
        if alive[index]:
            alive[index + 1 :] &= ~close[index, index + 1 :]
    left = left.copy()
    counts = []
    for catid, is_alive in zip(ranked.catid, alive.tolist(), strict=True):
        counts.append(is_alive and left[catid] > 0)
        left[catid] -= is_alive
    return torch.tensor(counts, dtype=torch.bool)


def _close(ranked: CadAlignments, symmetry: Tensor) -> Tensor:
    """Return whether the second is a duplicate of the first, ``(P, P)``, by the symmetry of the first."""
    unit = torch.nn.functional.normalize(ranked.quaternion.float(), dim=-1).double()
    turned = replace(ranked, quaternion=unit)
    turns = symmetry[:, None].expand(-1, len(ranked))
    errors = cad_errors(turned, turned, ranked.translation, turns, torch.float32)
    return equal_names(ranked.catid, ranked.catid) & errors.within(*_DUPLICATE_LIMITS)
