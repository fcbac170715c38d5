# SPDX-License-Identifier: Apache-2.0
"""Boxes and their overlap as in ODAM's eval_scan2cad.py (Li et al., 2021): seen from above, times height."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from raytran.classes import SCAN2CAD_CLASS_BY_CATID
from raytran.errors import ShapeError
from raytran.geometry.rotation import matrix_from_quaternion
from raytran.metrics.functional.alignment import row_blocks
from raytran.structs import CadAlignments

_SMALLEST_SCALE = 1e-3

_SIGNS = torch.tensor(
    [[1, 1, 1], [-1, 1, 1], [-1, 1, -1], [1, 1, -1], [1, -1, 1], [-1, -1, 1], [-1, -1, -1], [1, -1, -1]]
)
"""The corners of a box in the script's order, the upper face first; +Y is up."""


def odam_true_boxes(targets: CadAlignments) -> tuple[Tensor, Tensor]:
    """Return the corners of the annotated boxes that the script counts, and which models they belong to.

    Only the eight classes with a name, and no model with a scale below 0.001. The box sits on the CAD's
    origin: the script does not know the centre. The scan's ``axisAlignment``, a turn about z and a shift of
    both sides, changes no overlap and is left out.

    Args:
        targets: the annotated models of one scene.

    Returns:
        ``(M', 8, 3)`` in the scan, metres, and ``(M,)`` bool, whether a model is among the M'.

    Raises:
        ShapeError: ``targets`` lacks what annotations have.
    """
    if targets.pose is None or targets.half_extent is None or targets.annotated_scale is None:
        raise ShapeError("protocol odam needs the pose, the box and the scale of the annotated models")
    keep = _named(targets) & (targets.annotated_scale.amin(dim=-1) >= _SMALLEST_SCALE)
    pose, half, scale = targets.pose[keep], targets.half_extent[keep], targets.annotated_scale[keep]
    return _corners(pose[:, :3, :3] / scale[:, None], pose[:, :3, 3], half * scale), keep


def odam_predicted_boxes(
    predictions: CadAlignments, half_extents: Mapping[str, Sequence[float]]
) -> tuple[Tensor, CadAlignments]:
    """Return the corners of the predicted boxes of the eight classes with a name, and their alignments.

    They sit on the CAD's origin too. A CAD model of unknown size counts, but its corners are NaN.

    Args:
        predictions: of one scene; their own ``half_extent`` is taken if they have one.
        half_extents: of each ``catid/id``, see ``cad_half_extents``.

    Returns:
        ``(P', 8, 3)`` in the scan, metres, and the P' alignments.
    """
    counted = predictions.select(_named(predictions))
    half = counted.half_extent
    if half is None:
        unknown = (torch.nan, torch.nan, torch.nan)
        rows = [tuple(half_extents.get(name, unknown)) for name in counted.model_id]
        half = torch.tensor(rows, dtype=torch.float64).reshape(len(counted), 3)
    rotation = matrix_from_quaternion(counted.quaternion)
    return _corners(rotation, counted.translation, half * counted.scale), counted


def bev_iou(first: Tensor, second: Tensor) -> Tensor:
    """Return the script's IoU of boxes: overlap seen from above, times the overlap of the heights.

    The outline is that of the upper face, and the heights those of the first upper and the first lower
    corner: exact for upright boxes, not for tilted ones, and zero for a box that stands on its head. Where
    outlines share an edge the script returns anything; this is the limit of its value.

    Args:
        first: ``(A, 8, 3)`` corners in the script's order.
        second: ``(B, 8, 3)`` corners.

    Returns:
        ``(A, B)``; zero where a corner is not finite or a volume is zero.
    """
    outlines = first[:, :4, :2], second[:, :4, :2]
    area = torch.cat(
        [_shared_area(outlines[0][part], outlines[1]) for part in row_blocks(len(first), len(second))]
    )
    top = torch.minimum(first[:, None, 0, 2], second[:, 0, 2])
    bottom = torch.maximum(first[:, None, 4, 2], second[:, 4, 2])
    shared = area * (top - bottom).clamp(min=0)
    iou = shared / (_volume(first)[:, None] + _volume(second) - shared)
    return iou.nan_to_num(nan=0.0, posinf=0.0, neginf=0.0)


def _named(alignments: CadAlignments) -> Tensor:
    return torch.tensor([catid in SCAN2CAD_CLASS_BY_CATID for catid in alignments.catid], dtype=torch.bool)


def _corners(linear: Tensor, translation: Tensor, half: Tensor) -> Tensor:
    """Return ``(n, 8, 3)`` corners; the script rounds them to float32 before it places them."""
    local = (_SIGNS * half[:, None]).float().double()
    return local @ linear.mT + translation[:, None]


def _volume(corners: Tensor) -> Tensor:
    edges = corners[:, [1, 2, 4]] - corners[:, [0, 1, 0]]
    return edges.norm(dim=-1).prod(dim=-1)


def _shared_area(first: Tensor, second: Tensor) -> Tensor:
    """Return the area that parallelograms share, ``(A, 4, 2)`` and ``(B, 4, 2)`` → ``(A, B)``.

    In the frame in which the second is the square [-1, 1]², each edge of the first is cut where it crosses
    the square's four lines, and clamped into the square: the area is the integral of x dy along what results,
    since the curve turns as often as before around each point inside, and around none outside.
    """
    axes = torch.stack([second[:, 0] - second[:, 1], second[:, 1] - second[:, 2]], dim=-1) / 2
    (a, b), (c, d) = (row.unbind(-1) for row in axes.unbind(-2))
    determinant = a * d - b * c
    inverse = torch.stack([d, -b, -c, a], dim=-1).unflatten(-1, (2, 2)) / determinant[:, None, None]
    center = (second[:, 0] + second[:, 2]) / 2
    start = ((first[:, None] - center[:, None])[..., None, :] * inverse[:, None]).sum(dim=-1)
    step = start.roll(-1, dims=-2) - start
    cuts = torch.cat([(-1 - start) / step, (1 - start) / step], dim=-1)
    cuts = torch.where(cuts.isfinite(), cuts, 0.0).clamp(0, 1).sort(dim=-1).values
    along = torch.cat([torch.zeros_like(cuts[..., :1]), cuts, torch.ones_like(cuts[..., :1])], dim=-1)
    points = (start[..., None, :] + along[..., None] * step[..., None, :]).clamp(-1, 1)
    x, y = points.unbind(dim=-1)
    flux = (x[..., 1:] + x[..., :-1]) / 2 * y.diff(dim=-1)
    return flux.sum(dim=(-2, -1)).abs() * determinant.abs()
