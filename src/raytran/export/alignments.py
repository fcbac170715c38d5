# SPDX-License-Identifier: Apache-2.0
"""Boxes of objects and CAD models of known boxes: the poses that bring one into the other."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

from raytran.geometry.rotation import quaternion_from_matrix
from raytran.structs import CadAlignments, ObjectSet


def align_cads(
    objects: ObjectSet, catid: Sequence[str], id_cad: Sequence[str], *, center: Tensor, half_extent: Tensor
) -> CadAlignments:
    """Return the poses that stretch CAD models into the boxes of objects.

    Args:
        objects: ``M`` objects.
        catid: ShapeNet category of each model.
        id_cad: name of each model.
        center: ``(M, 3)`` centre of the model's box, CAD units: its origin is elsewhere.
        half_extent: ``(M, 3)`` half the extents of the model's box, CAD units.
    """
    rotation = objects.rotation.double().cpu()
    scale = objects.size.double().cpu() / (2 * half_extent)
    return CadAlignments(
        catid=tuple(catid),
        id_cad=tuple(id_cad),
        translation=objects.center.double().cpu() - (rotation @ (scale * center)[..., None])[..., 0],
        quaternion=quaternion_from_matrix(rotation),
        scale=scale,
        score=objects.score.double().cpu(),
        half_extent=half_extent,
    )
