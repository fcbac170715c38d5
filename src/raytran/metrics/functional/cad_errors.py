# SPDX-License-Identifier: Apache-2.0
"""The errors between CAD alignments as the published Scan2CAD scripts compute them, rounding and all."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import torch
from torch import Tensor

from raytran.metrics.functional.alignment import AlignmentErrors, row_blocks
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
    translation = shift_error(predictions.translation.to(dtype), target_point.to(dtype))
    scale = scale_error(predictions.scale.to(dtype), targets.scale.to(dtype))
    rotation = comb_rotation_error(predictions.quaternion, targets.quaternion, symmetry)
    return AlignmentErrors(translation, rotation, scale)


def shift_error(predicted: Tensor, target: Tensor) -> Tensor:
    """Return distances, computed in the type of the inputs, ``(P, 3)``, ``(M, 3)`` → ``(P, M)`` float64."""
    shift = predicted[:, None] - target
    x, y, z = (shift * shift).unbind(dim=-1)
    return (x + y + z).sqrt().double()


def scale_error(predicted: Tensor, target: Tensor) -> Tensor:
    """Return the error of the mean ratio, computed and returned as ``shift_error``."""
    first, second, third = (predicted[:, None] / target).unbind(dim=-1)
    return ((first + second + third) / 3 - 1).abs().double()


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
    turned = comb_of_turns(target)
    return torch.cat(
        [
            least_comb_angle(predicted[part, None], turned, symmetry[part])
            for part in row_blocks(len(predicted), len(target))
        ]
    )


def comb_of_turns(target: Tensor) -> Tensor:
    """Return quaternions turned about +Y in steps of ten degrees, ``(M, 4)`` → ``(M, 36, 4)``."""
    half = torch.arange(_COMB, device=target.device).to(target.dtype) * (math.pi / _COMB)
    cos, sin = torch.cos(half), torch.sin(half)
    w, x, y, z = (column[:, None] for column in target.unbind(dim=-1))
    return torch.stack([w * cos - y * sin, x * cos - z * sin, y * cos + w * sin, z * cos + x * sin], dim=-1)


def least_comb_angle(predicted: Tensor, turned: Tensor, symmetry: Tensor) -> Tensor:
    """Return the least angle to one of the turns of a symmetry; see ``comb_rotation_error``.

    Args:
        predicted: ``(..., 4)``.
        turned: ``(..., 36, 4)``, from ``comb_of_turns``.
        symmetry: ``(...)`` int64.

    Returns:
        ``(...)`` degrees, the shapes broadcast.
    """
    overlap = (predicted[..., None, :] * turned).sum(dim=-1).abs()
    angle = torch.rad2deg(2 * torch.acos(overlap))
    angle = torch.where(overlap > 1, 0.0, angle)
    count = torch.where(symmetry == SYMMETRY_INFINITE, _COMB, symmetry)[..., None]
    tried = (torch.arange(_COMB, device=turned.device) * count) % _COMB == 0
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
