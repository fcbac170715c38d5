# SPDX-License-Identifier: Apache-2.0
"""The errors between CAD alignments as the published Scan2CAD scripts compute them, rounding and all."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import torch
from torch import Tensor

from raytran.metrics.functional.alignment import AlignmentErrors
from raytran.structs import SYMMETRY_INFINITE, CadAlignments

_COMB = 36
"""The scripts try an infinite symmetry at every ten degrees."""


def cad_errors(
    predictions: CadAlignments,
    targets: CadAlignments,
    target_point: Tensor,
    symmetry: Tensor,
    dtype: torch.dtype = torch.float64,
) -> AlignmentErrors:
    """Return the three errors of every prediction against every true model.

    The scale error is that of the mean of the three ratios, in which opposite errors cancel.

    Args:
        predictions: of one scene.
        targets: of the same scene.
        target_point: ``(M, 3)`` what the predicted translation is compared with, metres.
        symmetry: ``(P, M)`` int64, over whose turns the rotation error is the least.
        dtype: precision in which translation and scale are compared.
    """
    shift = predictions.translation.to(dtype)[:, None] - target_point.to(dtype)
    x, y, z = (shift * shift).unbind(dim=-1)
    first, second, third = (predictions.scale.to(dtype)[:, None] / targets.scale.to(dtype)).unbind(dim=-1)
    scale = ((first + second + third) / 3 - 1).abs()
    rotation = comb_rotation_error(predictions.quaternion, targets.quaternion, symmetry)
    return AlignmentErrors((x + y + z).sqrt().double(), rotation, scale.double())


def comb_rotation_error(predicted: Tensor, target: Tensor, symmetry: Tensor) -> Tensor:
    """Return ``2 acos |target · turn about +Y, predicted|``, the least over the turns of a symmetry.

    Quaternions are taken as they are. Where the product exceeds 1, by rounding or because a quaternion is
    longer than one, the scripts' arc cosine fails and they take an error of zero; so does this.

    Args:
        predicted: ``(P, 4)`` [w, x, y, z].
        target: ``(M, 4)`` [w, x, y, z].
        symmetry: ``(P, M)`` int64: 1, 2, 4, or ``SYMMETRY_INFINITE`` for a comb of ten degrees.

    Returns:
        ``(P, M)`` degrees.
    """
    step = torch.arange(_COMB, device=target.device)
    half = step.to(target.dtype) * (math.pi / _COMB)
    cos, sin = torch.cos(half), torch.sin(half)
    w, x, y, z = (column[:, None] for column in target.unbind(dim=-1))
    rotated = torch.stack(
        [w * cos - y * sin, x * cos - z * sin, y * cos + w * sin, z * cos + x * sin], dim=-1
    )
    overlap = (predicted[:, None, None] * rotated).sum(dim=-1).abs()
    angle = torch.rad2deg(2 * torch.acos(overlap))
    angle = torch.where(overlap > 1, 0.0, angle)
    count = torch.where(symmetry == SYMMETRY_INFINITE, _COMB, symmetry)[..., None]
    tried = (step * count) % _COMB == 0
    return torch.where(tried, angle, torch.inf).amin(dim=-1)


def equal_names(first: Sequence[str], second: Sequence[str]) -> Tensor:
    """Return where the names are the same, ``(P, M)`` bool."""
    number = {name: index for index, name in enumerate(dict.fromkeys([*first, *second]))}
    rows, columns = ([number[name] for name in names] for names in (first, second))
    return torch.tensor(rows, dtype=torch.int64)[:, None] == torch.tensor(columns, dtype=torch.int64)


def cad_symmetries(truths: Iterable[CadAlignments]) -> dict[str, int]:
    """Return the symmetry of each CAD model by its ``catid/id``; of several annotations the last wins.

    Args:
        truths: the annotated scenes under test, in the order of their file.

    Raises:
        ValueError: a scene has no symmetries: it holds predictions.
    """
    symmetries: dict[str, int] = {}
    for truth in truths:
        if truth.symmetry is None:
            raise ValueError("expected annotated scenes, which have symmetries")
        symmetries.update(zip(truth.model_id, truth.symmetry.tolist(), strict=True))
    return symmetries


def cad_half_extents(truths: Iterable[CadAlignments]) -> dict[str, list[float]]:
    """Return half the size of each CAD model's box in CAD units, by its ``catid/id``; the last one wins.

    Args:
        truths: annotated scenes, in the order of their file.

    Raises:
        ValueError: a scene has no boxes: it holds predictions.
    """
    half_extents: dict[str, list[float]] = {}
    for truth in truths:
        if truth.half_extent is None:
            raise ValueError("expected annotated scenes, which have boxes")
        half_extents.update(zip(truth.model_id, truth.half_extent.tolist(), strict=True))
    return half_extents
