# SPDX-License-Identifier: Apache-2.0
"""Matching of one scene as ROCA's vid2cad_evaluation.py does it (Gümeli et al., 2022), quirks and all."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import torch
from torch import Tensor

from raytran.classes import SCAN2CAD_CLASS_BY_CATID
from raytran.errors import ShapeError
from raytran.metrics.functional.alignment import AlignmentErrors, row_blocks
from raytran.metrics.functional.cad_errors import (
    cad_errors,
    comb_of_turns,
    equal_names,
    least_comb_angle,
    scale_error,
    shift_error,
)
from raytran.metrics.functional.detection import match_in_order
from raytran.structs import CadAlignments

VID2CAD_CLASS_BY_CATID: dict[str, str] = {**SCAN2CAD_CLASS_BY_CATID, "02818832": "bed"}
"""The nine classes of the script: bed instead of ``other``."""

_DUPLICATE_LIMITS = (0.4, 60.0, 0.6)
"""Two detections are one object within these metres, degrees and ratio of scale."""

_ROWS_AT_ONCE = (16, 128)
"""Rows of the table of all pairs that are made first, when most may still be duplicates, and at most."""


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
    groups: dict[str, list[int]] = {}
    for index, catid in enumerate(ranked.catid):
        groups.setdefault(catid, []).append(index)
    alive = torch.ones(len(ranked), dtype=torch.bool)
    for group in groups.values():
        members = torch.tensor(group)
        alive[members] = _without_duplicates(ranked.select(members), symmetry[members])
    left = left.copy()
    counts = []
    for catid, is_alive in zip(ranked.catid, alive.tolist(), strict=True):
        counts.append(is_alive and left[catid] > 0)
        left[catid] -= is_alive
    return torch.tensor(counts, dtype=torch.bool)


def _without_duplicates(ranked: CadAlignments, symmetry: Tensor) -> Tensor:
    """Return which of one category are no duplicate of a better one that is none itself, ``(P,)`` bool.

    Some rows of the table of all pairs are made at a time, and angles, the greatest work, only of pairs that
    are near and alike in size: a file may have any number of rows.
    """
    translation, scale = ranked.translation.float(), ranked.scale.float()
    unit = torch.nn.functional.normalize(ranked.quaternion.float(), dim=-1).double()
    alive = torch.ones(len(ranked), dtype=torch.bool)
    begin, (count, most) = 0, _ROWS_AT_ONCE
    while len(rows := begin + alive[begin:].nonzero().squeeze(1)[:count]):
        begin, count = int(rows[-1]) + 1, min(2 * count, most)
        later = int(rows[0]) + alive[rows[0] :].nonzero().squeeze(1)
        near = shift_error(translation[rows], translation[later]) <= _DUPLICATE_LIMITS[0]
        near &= scale_error(scale[rows], scale[later]) <= _DUPLICATE_LIMITS[2]
        near &= later > rows[:, None]
        row, column = near.nonzero().unbind(dim=1)
        for part in row_blocks(len(row), 1):
            first, second = rows[row[part]], later[column[part]]
            angle = least_comb_angle(unit[first], comb_of_turns(unit[second]), symmetry[first])
            near[row[part], column[part]] = angle <= _DUPLICATE_LIMITS[1]
        for index, duplicates in zip(rows.tolist(), near, strict=True):
            if alive[index]:
                alive[later[duplicates]] = False
    return alive
