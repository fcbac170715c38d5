# SPDX-License-Identifier: Apache-2.0
"""CAD alignments: the poses that bring CAD models into the boxes of objects, and Scan2CAD's files of them."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from raytran.data.files import write_text
from raytran.geometry.rotation import quaternion_from_matrix
from raytran.structs import CadAlignments, ObjectSet

ALIGNMENTS = "scan2cad.csv"
"""Name of the file of one scene in the folder of its results."""

SCAN2CAD_COLUMNS: tuple[str, ...] = (
    *("catid_cad", "id_cad", "tx", "ty", "tz", "qw", "qx", "qy", "qz", "sx", "sy", "sz"),
)
"""The 12 columns of a Scan2CAD result file, poses in the scan (EvaluateBenchmark.py)."""


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


def write_alignments_csv(path: Path, alignments: CadAlignments) -> Path:
    """Write the 12 columns of Scan2CAD's benchmark without a header, whole or not at all.

    Args:
        path: ``<id_scan>.csv``.
        alignments: in the order in which the benchmark shall try them.

    Returns:
        ``path``.
    """
    numbers = torch.cat([alignments.translation, alignments.quaternion, alignments.scale], dim=1).tolist()
    names = zip(alignments.catid, alignments.id_cad, strict=True)
    table = io.StringIO()
    rows = ([*name, *row] for name, row in zip(names, numbers, strict=True))
    csv.writer(table, lineterminator="\n").writerows(rows)
    write_text(path, table.getvalue())
    return path
