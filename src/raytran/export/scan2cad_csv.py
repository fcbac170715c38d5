# SPDX-License-Identifier: Apache-2.0
"""CAD alignments as text: Scan2CAD's result files, one a scan, and ROCA's single file with scores."""

from __future__ import annotations

import csv
import io
import logging
import math
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import torch

from raytran.data.files import write_text
from raytran.errors import DataError
from raytran.structs import CadAlignments

_log = logging.getLogger(__name__)

ALIGNMENTS = "scan2cad.csv"
"""Name of the file of one scene in the folder of its results."""

SCAN2CAD_COLUMNS: tuple[str, ...] = (
    *("catid_cad", "id_cad", "tx", "ty", "tz", "qw", "qx", "qy", "qz", "sx", "sy", "sz"),
)
"""The 12 columns of a Scan2CAD result file, poses in the scan (EvaluateBenchmark.py)."""

ROCA_COLUMNS: tuple[str, ...] = (
    *("id_scan", "objectCategory", "alignedModelId", *SCAN2CAD_COLUMNS[2:], "object_score"),
)
"""The 14 columns of ROCA's result file (vid2cad_evaluation.py)."""

_CATID_DIGITS = 8

_UNIT_TOLERANCE = 1e-3
"""Quaternions written with four digits still count as of length one."""


class _Row(NamedTuple):
    line: int
    names: list[str]
    values: list[float]


def read_alignments_csv(path: Path) -> CadAlignments:
    """Read the predictions for one scan, 12 columns a row; a header row and blank lines are skipped.

    Quaternions and categories are kept as given, but one sentence warns of quaternions not of length one and
    of categories without eight digits: the official script takes them as they are, and the latter match
    nothing.

    Args:
        path: ``<id_scan>.csv``.

    Raises:
        DataError: the file cannot be read, or a row has another number of columns, a value that is no
            finite number, a quaternion of length zero or a scale that is not positive.
    """
    rows = _read_rows(Path(path), SCAN2CAD_COLUMNS, 2)
    short = [row for row in rows if len(row.names[0]) != _CATID_DIGITS]
    if short:
        _log.warning(
            "%s, line %d: catid_cad %r does not have eight digits (%d such lines) and matches nothing",
            *(path, short[0].line, short[0].names[0], len(short)),
        )
    return _alignments(rows)


def read_roca_csv(path: Path) -> dict[str, CadAlignments]:
    """Read the predictions for many scans, 14 columns a row, as ``read_alignments_csv`` does.

    ROCA writes categories as numbers; they get their leading zeros back.

    Args:
        path: the file; the rows of a scan need not be neighbours.

    Returns:
        the alignments of each scan that has any, in the order of first appearance.

    Raises:
        DataError: see ``read_alignments_csv``.
    """
    by_scene: dict[str, list[_Row]] = {}
    for row in _read_rows(Path(path), ROCA_COLUMNS, 3):
        scene_id, category, name = row.names
        by_scene.setdefault(scene_id, []).append(row._replace(names=[category.zfill(_CATID_DIGITS), name]))
    return {scene_id: _alignments(rows) for scene_id, rows in by_scene.items()}


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


def _read_rows(path: Path, columns: tuple[str, ...], n_names: int) -> list[_Row]:
    rows: list[_Row] = []
    not_unit: list[int] = []
    try:
        table = list(csv.reader(path.read_text(encoding="utf-8-sig").splitlines()))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise DataError(f"cannot read the alignments {path} ({error}): check the path") from error
    for line, cells in enumerate(table, start=1):
        cells = [cell.strip() for cell in cells]
        if not any(cells):
            continue
        if len(cells) != len(columns):
            raise DataError(
                f"{path}, line {line} has {len(cells)} columns: write the {len(columns)} columns "
                f"{','.join(columns)}"
            )
        if not rows and _is_header(cells[n_names:]):
            _log.warning("%s, line %d: skipped a header row", path, line)
            continue
        row = _Row(line, cells[:n_names], _numbers(cells[n_names:], columns[n_names:], path, line))
        if abs(_checked_length(row, path) - 1) > _UNIT_TOLERANCE:
            not_unit.append(line)
        rows.append(row)
    if not_unit:
        _log.warning(
            "%s, line %d: the quaternion is not of length one (%d such lines); official protocols take it "
            "as it is",
            *(path, not_unit[0], len(not_unit)),
        )
    return rows


def _is_header(cells: list[str]) -> bool:
    """Return whether not one of the cells is a number."""
    return not any(_parses(float, cell) for cell in cells)


def _parses(parse: Callable[[str], float], cell: str) -> bool:
    try:
        parse(cell)
    except ValueError:
        return False
    return True


def _numbers(cells: list[str], columns: tuple[str, ...], path: Path, line: int) -> list[float]:
    for name, cell in zip(columns, cells, strict=True):
        if not _parses(float, cell) or not math.isfinite(float(cell)):
            raise DataError(f"{path}, line {line}: {name} is {cell[:50]!r}, write a finite number")
    return [float(cell) for cell in cells]


def _checked_length(row: _Row, path: Path) -> float:
    """Return the length of a row's quaternion; a pose that no object can have is an error."""
    length = math.hypot(*row.values[3:7])
    if length == 0:
        raise DataError(f"{path}, line {row.line}: the quaternion has length zero, write a rotation")
    if min(row.values[7:10]) <= 0:
        raise DataError(f"{path}, line {row.line}: a scale is not positive, write sizes in metres a CAD unit")
    return length


def _alignments(rows: list[_Row]) -> CadAlignments:
    numbers = torch.tensor([row.values for row in rows], dtype=torch.float64)
    numbers = numbers.reshape(len(rows), len(rows[0].values) if rows else 10)
    scored = numbers.shape[1] > 10
    return CadAlignments(
        catid=tuple(row.names[0] for row in rows),
        id_cad=tuple(row.names[1] for row in rows),
        translation=numbers[:, :3],
        quaternion=numbers[:, 3:7],
        scale=numbers[:, 7:10],
        score=numbers[:, 10] if scored else torch.ones(len(rows), dtype=torch.float64),
    )
