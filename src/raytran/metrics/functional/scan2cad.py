# SPDX-License-Identifier: Apache-2.0
"""Matching of one scene as in Scan2CAD's EvaluateBenchmark.py (Avetisyan et al., 2019), quirks and all."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping

import torch
from torch import Tensor

from raytran.errors import ShapeError
from raytran.metrics.functional.alignment import AlignmentErrors
from raytran.metrics.functional.cad_errors import cad_errors, equal_names
from raytran.metrics.functional.detection import match_in_order
from raytran.structs import CadAlignments


def match_scan2cad(
    predictions: CadAlignments,
    targets: CadAlignments,
    symmetries: Mapping[str, int],
    limits: tuple[float, float, float],
) -> tuple[AlignmentErrors, Tensor]:
    """Give each prediction, in the order of the file, the first free model of its category that it fits.

    - The translation is compared with the place of the CAD point ``-center``, although neither the CAD's
      origin nor its box centre is there.
    - A CAD model may be tried as often as it stands in the scene; hits and misses use that up alike, and a
      model that does not stand there is never tried.
    - The category must agree, not the class: two kinds of ``other`` do not match. The model need not agree.
    - The symmetry is that of the predicted CAD model.

    Args:
        predictions: of one scene, in the order of the file.
        targets: the annotated models.
        symmetries: of each ``catid/id``, see ``cad_symmetries``.
        limits: metres, degrees, ratio; inclusive.

    Returns:
        the errors, each ``(P, M)``, and the model that each prediction takes, ``(P,)`` int64, or -1.

    Raises:
        ShapeError: ``targets`` lacks what annotations have.
    """
    if targets.pose is None or targets.center is None:
        raise ShapeError("protocol scan2cad needs the pose and the box centre of the annotated models")
    point = (targets.pose[:, :3, :3] @ -targets.center[..., None])[..., 0] + targets.pose[:, :3, 3]
    symmetry = torch.tensor([symmetries.get(name, 1) for name in predictions.model_id], dtype=torch.int64)
    errors = cad_errors(predictions, targets, point, symmetry[:, None].expand(-1, len(targets)))
    fits = equal_names(predictions.catid, targets.catid) & errors.within(*limits)
    allowed = fits & _tried(predictions.model_id, targets.model_id)[:, None]
    return errors, match_in_order(torch.arange(len(predictions)), allowed)


def _tried(predicted: tuple[str, ...], true: tuple[str, ...]) -> Tensor:
    """Return whether each prediction is among the first of its CAD model, as many as stand in the scene."""
    left = Counter(true)
    tried = []
    for name in predicted:
        tried.append(left[name] > 0)
        left[name] -= 1
    return torch.tensor(tried, dtype=torch.bool)
