# SPDX-License-Identifier: Apache-2.0
"""Boxes read from files that anybody may have written: ``scene.json``, Scan2CAD's, ROCA's and Boxer's CSV."""

from __future__ import annotations

import csv
import logging
import math
import re
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from raytran.classes import PAPER_CLASSES, Classes
from raytran.data.text import as_name, read_json_object, read_text
from raytran.errors import ConfigError, DataError
from raytran.export.cad_alignments import ALIGNMENTS, SCAN2CAD_COLUMNS, align_cads
from raytran.export.write import FORMAT
from raytran.geometry.rotation import matrix_from_quaternion, upright_basis
from raytran.limits import (
    BOX_SIDE,
    MATRIX_ENTRY,
    POSITION,
    QUATERNION,
    SCALE,
    SCORE,
    Quantity,
    as_number,
    as_numbers,
    shown,
)
from raytran.structs import CadAlignments, ObjectSet, ScenePrediction

_log = logging.getLogger(__name__)

ROCA_COLUMNS: tuple[str, ...] = (
    *("id_scan", "objectCategory", "alignedModelId", *SCAN2CAD_COLUMNS[2:], "object_score"),
)
"""The 14 columns of ROCA's result file (vid2cad_evaluation.py)."""

_SCORED = (*SCAN2CAD_COLUMNS, "score")
_EXAMPLE = ("id_scan", *SCAN2CAD_COLUMNS)
"""The 13 columns of Scan2CAD's own example (dummy_alignment.csv), all with score 1."""

_VID2CAD = (*_EXAMPLE, "", "num_views", "score")
"""The 16 columns of Vid2CAD's result file as ODAM reads it (eval_scan2cad.py); the 14th is not read, nor is
the number of views."""

BOXER_COLUMNS: tuple[str, ...] = (
    *("time_ns", "tx_world_object", "ty_world_object", "tz_world_object"),
    *("qw_world_object", "qx_world_object", "qy_world_object", "qz_world_object"),
    *("scale_x", "scale_y", "scale_z", "name", "instance", "sem_id", "prob"),
)
"""The 15 columns of Boxer's boxes (ObbCsvWriter2 in its utils/file_io.py), which stand below a header row."""

_BOXER_FILES = ("boxer_3dbbs_fused.csv", "boxer_3dbbs_tracked.csv", "boxer_3dbbs.csv")
"""What Boxer writes into the folder of a sequence: the boxes of all frames fused, of its tracker, and of each
frame; the first that is there counts."""

_OF_ONE_SCAN = (SCAN2CAD_COLUMNS, _SCORED)
_OF_MANY_SCANS = (ROCA_COLUMNS, _EXAMPLE, _VID2CAD)
"""Columns of the files that hold the alignments of one scan, and of many."""

_NOT_READ = ("", "num_views")
_NAMES = ("id_scan", "objectCategory", "alignedModelId", "catid_cad", "id_cad")
"""Columns that are no numbers."""

_SHORT_SCAN_ID = re.compile(r"\d{4}_\d{2}")
"""What Vid2CAD calls ``scene0470_00``."""

_CATID_DIGITS = 8

_UNIT_TOLERANCE = 1e-3
"""Quaternions written with four digits still count as of length one."""

_THINNEST = 1e-3
"""Least size of a box, metres, as of annotated objects: a CAD model may be a flat sheet."""

_NOT_ORTHOGONAL = 1e-3
"""Largest entry of ``RᵀR - 1`` of a matrix that still counts as a rotation."""

_LEAST_LENGTH = 1e-9
"""Of a quaternion: what is shorter has no direction left."""

_MAX_CSV = 16 * 2**20
"""Bytes of a CSV that are read: all rows of Scan2CAD's benchmark have three megabytes."""

_SIDE = Quantity(BOX_SIDE.name, -BOX_SIDE.high, BOX_SIDE.high)
"""Of either sign here: what a size that is not positive means is said in words of its own."""

_QUANTITIES: dict[str, Quantity] = {
    **dict.fromkeys(("tx", "ty", "tz"), POSITION),
    **dict.fromkeys(("qw", "qx", "qy", "qz"), QUATERNION),
    # Of either sign too.
    **dict.fromkeys(("sx", "sy", "sz"), Quantity(SCALE.name, -SCALE.high, SCALE.high)),
    **dict.fromkeys(BOXER_COLUMNS[1:4], POSITION),
    **dict.fromkeys(BOXER_COLUMNS[4:8], QUATERNION),
    **dict.fromkeys(BOXER_COLUMNS[8:11], _SIDE),
}
"""What the columns of numbers measure, but for the score."""

CadBoxes = Mapping[str, tuple[Tensor, Tensor]]
"""Centre and half extents ``(3,)`` of each annotated CAD model's box in CAD units, by ``catid/id``."""


@dataclass(frozen=True)
class NamedBoxes:
    """The boxes of one scene under the names of classes that a file gives them.

    Attributes:
        path: the file.
        scene_id: what the file calls its scene; empty where it does not.
        category: the class of each box.
        objects: the boxes, all with label 0.
        listed: what the file says of its classes, unread; None: nothing.
    """

    path: Path
    scene_id: str
    category: tuple[str, ...]
    objects: ObjectSet
    listed: Any = None

    def labelled(self, classes: Classes, *, leave_out_others: bool = False) -> ObjectSet:
        """Return the boxes as objects of some classes.

        Args:
            classes: that they are of.
            leave_out_others: leave out the boxes of other classes.

        Raises:
            DataError: one is of another class, and is not to be left out.
        """
        place = {name: label for label, name in enumerate(classes.names)}
        other = next((name for name in self.category if name not in place), None)
        if other is not None and not leave_out_others:
            raise DataError(f"{self.path} has an object of category {shown(other)}: choose one of {classes}")
        label = torch.tensor([place.get(name, -1) for name in self.category], dtype=torch.int64)
        return replace(self.objects, label=label, classes=classes).select(label >= 0)


@dataclass(frozen=True)
class ScenePredictions:
    """What was predicted for one scene, in the forms that the protocols compare.

    Attributes:
        path: the file.
        objects: boxes, for protocol ``strict``.
        boxes: for ``odam``, on the origins of the CAD models where these are known; those of CAD alignments
            get their size from the annotations.
        cads: CAD alignments in the order of the file, for ``scan2cad`` and ``vid2cad``; None if the file has
            objects without CAD models.
        n_unknown_cads: predictions left out of some of these, since the annotations do not know the box of
            their CAD model.
        n_other_classes: predictions left out of all, since nothing is asked for of their class.
    """

    path: Path
    objects: ObjectSet
    boxes: CadAlignments
    cads: CadAlignments | None
    n_unknown_cads: int = 0
    n_other_classes: int = 0


@dataclass(frozen=True)
class PredictionFiles:
    """The predictions by scene, and the names of those that were ignored as they are not asked for."""

    scenes: dict[str, ScenePredictions]
    ignored: tuple[str, ...]

    def counts(self) -> dict[str, int]:
        """Return what was read and what was left out, for ``metrics.json``."""
        return {
            "n_scenes_with_predictions": len(self.scenes),
            "n_scenes_ignored": len(self.ignored),
            "n_predictions_without_known_cad": sum(scene.n_unknown_cads for scene in self.scenes.values()),
            "n_predictions_of_other_classes": sum(scene.n_other_classes for scene in self.scenes.values()),
        }


def read_predictions(
    path: Path,
    scene_ids: Collection[str],
    cad_boxes: CadBoxes,
    classes: Classes = PAPER_CLASSES,
    *,
    leave_out_others: bool = False,
) -> PredictionFiles:
    """Read the predictions for the scenes asked for.

    Args:
        path: a folder of ``<scene_id>.json`` or ``<scene_id>/scene.json`` (``raytran.scene/1``) or
            ``<scene_id>.csv`` (Scan2CAD's 12 columns, or Boxer's 15 below their header) or Boxer's results,
            ``<scene_id>/boxer_3dbbs_fused.csv``; or the folder of one scene; or a CSV with all scenes, of
            ROCA's 14 columns, Scan2CAD's 13 or Vid2CAD's 16, or one of Boxer's.
        scene_ids: the annotated scenes; others are ignored, without being opened.
        cad_boxes: of the CAD models that the annotations name.
        classes: that the objects are of; CAD models of no class have no box.
        leave_out_others: predictions of other classes are left out and counted, and boxes may be flat. Else
            another class in a ``scene.json`` is an error.

    Raises:
        DataError: nothing there is for any of the scenes, a scene occurs twice, or a file is damaged.
    """
    if path.is_file() and not is_boxer_csv(path):
        alignments = _with_known_ids(read_roca_csv(path), scene_ids)
        ignored = tuple(alignments.keys() - set(scene_ids))
        scenes = {
            name: _from_alignments(path, alignments[name], cad_boxes, classes)
            for name in alignments
            if name in scene_ids
        }
    else:
        files = files_by_scene(path)
        ignored = tuple(name for name in files if name not in scene_ids)
        scenes = {
            name: _read_scene(files[name], name, cad_boxes, classes, leave_out_others)
            for name in files
            if name in scene_ids
        }
    if not scenes:
        raise DataError(
            f"{path} holds no predictions for any of the {len(scene_ids)} annotated scenes: name the files "
            "<scene_id>.json (raytran.scene/1) or <scene_id>.csv (12 columns)"
        )
    if ignored:
        shown = ", ".join(sorted(ignored)[:3]) + (", …" if len(ignored) > 3 else "")
        _log.warning("%s: ignored %d scenes that are not asked for (%s)", path, len(ignored), shown)
    result = PredictionFiles(scenes, ignored)
    if unknown := result.counts()["n_predictions_without_known_cad"]:
        _log.warning(
            "%s: the annotations do not know the CAD model of %d predictions: where its box is needed "
            "(strict and odam for a CSV, scan2cad and vid2cad for a JSON file), they find nothing",
            path,
            unknown,
        )
    if others := result.counts()["n_predictions_of_other_classes"]:
        _log.warning("%s: left out %d predictions of classes that are not asked for", path, others)
    return result


def _with_known_ids(
    alignments: dict[str, CadAlignments], scene_ids: Collection[str]
) -> dict[str, CadAlignments]:
    """Return alignments by the names of the annotated scenes: Vid2CAD leaves out their "scene"."""

    def known(name: str) -> str:
        is_short = _SHORT_SCAN_ID.fullmatch(name) and name not in scene_ids and f"scene{name}" in scene_ids
        return f"scene{name}" if is_short else name

    renamed = {known(name): cads for name, cads in alignments.items()}
    return renamed if len(renamed) == len(alignments) else alignments


def files_by_scene(path: Path) -> dict[str, Path]:
    """Return the file of each scene, by name.

    Args:
        path: a folder as of ``read_predictions``, or one of Boxer's files.

    Raises:
        DataError: there is no such folder, or two files of one scene.
    """
    if path.is_file():
        return {_named_by_boxer(path): path}
    if not path.is_dir():
        raise DataError(f"no predictions at {path}: give a folder, or a CSV with all scenes")
    files: dict[str, Path] = {}
    of_boxer = _boxers_choice(path)
    for entry in sorted(path.iterdir()):
        file = (_boxers_choice(entry) or entry / "scene.json") if entry.is_dir() else entry
        if entry.name.startswith(".") or file.suffix not in (".json", ".csv") or not file.is_file():
            continue
        if entry.name == ALIGNMENTS:  # raytran.predict writes it beside a scene.json of the same objects
            continue
        name = entry.name if entry.is_dir() else entry.stem
        if entry.name == "scene.json":  # the folder is one that raytran.predict has written for one scene
            name = _read_scene_json(entry, scored=False).scene_id
        elif entry.name in _BOXER_FILES:
            if entry != of_boxer:
                continue
            name = _named_by_boxer(entry)
        if name in files:
            raise DataError(f"{files[name]} and {file} both hold scene {name}: delete one of them")
        files[name] = file
    return files


def _boxers_choice(folder: Path) -> Path | None:
    """Return the file that counts of those that Boxer has written into a folder, None if it has not."""
    return next((folder / name for name in _BOXER_FILES if (folder / name).is_file()), None)


def _named_by_boxer(path: Path) -> str:
    """Return the scene of one of Boxer's files, which is its folder's name; its own if it was renamed."""
    return path.absolute().parent.name if path.name in _BOXER_FILES else path.stem


def _read_scene(
    path: Path, scene_id: str, cad_boxes: CadBoxes, classes: Classes, leave_out_others: bool
) -> ScenePredictions:
    if path.suffix == ".csv" and not is_boxer_csv(path):
        return _from_alignments(path, read_alignments_csv(path), cad_boxes, classes)
    named = read_named_boxes(path, scene_id, flat=leave_out_others)
    # Boxer's words are free.
    objects = named.labelled(classes, leave_out_others=leave_out_others or path.suffix == ".csv")
    scene = _from_objects(path, objects, cad_boxes)
    return replace(scene, n_other_classes=len(named.objects) - len(objects))


def read_named_boxes(
    path: Path,
    scene_id: str,
    *,
    scored: bool = True,
    flat: bool = False,
) -> NamedBoxes:
    """Read the boxes of one scene, of whatever classes.

    Args:
        path: ``raytran.scene/1`` or Boxer's CSV.
        scene_id: what the scene is called; a file that gives it another name is an error.
        scored: False reads true boxes, whose scores are 1 whatever the file says.
        flat: a size may be 0; such boxes are counted in a warning, as they overlap with nothing.

    Raises:
        DataError: the file is missing or damaged, or of another form.
    """
    if path.suffix == ".csv":
        named = read_boxer_csv(path, flat=flat)
    else:
        named = _read_scene_json(path, scored=scored, flat=flat)
    if named.scene_id not in (scene_id, ""):
        raise DataError(
            f"{path} says that it is scene {named.scene_id!r}, but its name says {scene_id!r}: rename it"
        )
    without_volume = int((named.objects.size == 0).any(dim=1).sum())
    if without_volume:
        _log.warning("%s: %d boxes have no volume, and overlap with nothing", path, without_volume)
    return named


def _check_objects(
    objects: ObjectSet, path: Path, line_of: Callable[[int], int], *, flat: bool = False
) -> None:
    """Raise on an object that nothing can be compared with, naming its line.

    Args:
        objects: what was read.
        path: from where.
        line_of: the line of an object's number.
        flat: a size may be 0.
    """
    identity = torch.eye(3, dtype=torch.float64)
    rotation = objects.rotation.nan_to_num()
    skew = (rotation.mT @ rotation - identity).abs().amax(dim=(-2, -1))
    numbers = [objects.center, objects.size, objects.rotation.flatten(1), objects.score[:, None]]
    faults = {
        "a number is not finite, or kilometres": ~torch.cat(numbers, dim=1).isfinite().all(dim=1),
        "a size is negative" if flat else "a size is not positive": (
            objects.size < 0 if flat else objects.size <= 0
        ).any(dim=1),
        "the rotation is no rotation matrix": (skew > _NOT_ORTHOGONAL) | (torch.linalg.det(rotation) <= 0),
    }
    for fault, where in faults.items():
        if where.any():
            index = int(where.nonzero()[0])
            raise DataError(f"{path}, line {line_of(index)}: {fault}, mend object {index}")


def _line_of_object(path: Path, index: int) -> int:
    """Return the line on which an object's ``category`` stands: JSON parsers do not keep lines."""
    text = read_text(path)
    starts = [match.start() for match in re.finditer(r'"category"\s*:', text)]
    return text.count("\n", 0, starts[index]) + 1 if index < len(starts) else 1


def _from_alignments(
    path: Path, cads: CadAlignments, cad_boxes: CadBoxes, classes: Classes
) -> ScenePredictions:
    """Turn CAD alignments into boxes, as far as the CAD models are known."""
    index = torch.tensor([i for i, name in enumerate(cads.model_id) if name in cad_boxes], dtype=torch.int64)
    known = cads.select(index)
    rotation = matrix_from_quaternion(known.quaternion)
    center, half = _lookup(known.model_id, cad_boxes)
    labels = [classes.label_of(catid) for catid in known.catid]
    objects = ObjectSet(
        label=torch.tensor([-1 if label is None else label for label in labels], dtype=torch.int64),
        center=known.translation + (rotation @ (known.scale * center)[..., None])[..., 0],
        size=_sizes(2 * half * known.scale, path),
        rotation=rotation,
        symmetry=torch.ones(len(known), dtype=torch.int64),
        score=known.score,
        model_id=known.model_id,
        classes=classes,
    )
    objects = objects.select(objects.label >= 0)
    return ScenePredictions(
        path,
        objects,
        cads,
        cads,
        n_unknown_cads=len(cads) - len(known),
        n_other_classes=sum(classes.label_of(catid) is None for catid in cads.catid),
    )


def _sizes(sizes: Tensor, path: Path) -> Tensor:
    """Return the sizes of boxes, none thinner than annotated ones.

    Raises:
        DataError: a CAD model and its scale, each possible, make a box of kilometres.
    """
    if not (sizes <= BOX_SIDE.high).all():
        raise DataError(f"{path} has a box of {float(sizes.max()):g} m: write sizes in metres a CAD unit")
    return sizes.clamp(min=_THINNEST)


def _from_objects(path: Path, objects: ObjectSet, cad_boxes: CadBoxes) -> ScenePredictions:
    """Find the CAD alignments that boxes with the names of CAD models stand for."""
    names = objects.model_id or ("",) * len(objects)
    known = [name in cad_boxes and bool((cad_boxes[name][1] > 0).all()) for name in names]
    center, half = _lookup([name if ok else "" for name, ok in zip(names, known, strict=True)], cad_boxes)
    catid_of = [next(iter(catids), "") for catids in objects.classes.catids]
    split_names = [name.partition("/") for name in names]
    catids = [
        catid or catid_of[label]
        for (catid, _, _), label in zip(split_names, objects.label.tolist(), strict=True)
    ]
    id_cads = [id_cad for _, _, id_cad in split_names]
    boxes = align_cads(objects, catids, id_cads, center=center, half_extent=half)
    complete = all(names)
    index = torch.tensor(known, dtype=torch.bool).nonzero().squeeze(1)
    cads = replace(boxes.select(index), half_extent=None) if complete else None
    n_unknown = len(objects) - len(index) if complete else 0
    return ScenePredictions(path, objects, boxes, cads, n_unknown)


def _lookup(names: Collection[str], cad_boxes: CadBoxes) -> tuple[Tensor, Tensor]:
    """Return centres and half extents, ``(M, 3)`` each; those of a name that is unknown are 0 and 1/2."""
    unit = (torch.zeros(3, dtype=torch.float64), torch.full((3,), 0.5, dtype=torch.float64))
    boxes = [cad_boxes.get(name, unit) for name in names]
    if not boxes:
        return torch.zeros(0, 3, dtype=torch.float64), torch.zeros(0, 3, dtype=torch.float64)
    return torch.stack([center for center, _ in boxes]), torch.stack([half for _, half in boxes])


def read_scene_json(path: Path, classes: Classes | None = None) -> ScenePrediction:
    """Read what ``write_scene_json`` wrote; the numbers are float64, as written.

    Args:
        path: the file.
        classes: that the objects are of; None: those that the file lists, the paper's where it lists none.

    Returns:
        The objects, with symmetry 1 and no shapes. The file does not hold the voxel grid, so ``grid_center``
        is NaN.

    Raises:
        DataError: the file is missing, damaged, of another format, or names an unknown category.
    """
    named = _read_scene_json(Path(path))
    if classes is None:
        try:
            classes = Classes.of(named.listed)
        except ConfigError as error:
            raise DataError(f"{path} lists classes that are none ({error}): write it again") from error
    return ScenePrediction(
        scene_id=named.scene_id,
        objects=named.labelled(classes),
        grid_center=torch.full((3,), torch.nan),
    )


def _read_scene_json(path: Path, *, scored: bool = True, flat: bool = False) -> NamedBoxes:
    if not path.exists():
        raise DataError(f"no scene file at {path}; write one with `raytran predict`")
    content = read_json_object(path)
    named = content.get("format")
    if named != FORMAT:
        raise DataError(f"{path} has format {shown(named)}, this version reads {FORMAT!r}; write it again")
    entries = content.get("objects")
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        raise DataError(f"{path} has no list of objects: write it again")
    # One may write an empty name.
    scene_id = content.get("scene_id") and as_name(content["scene_id"], f"scene_id in {path}")
    if not isinstance(scene_id, str):
        raise DataError(f"{path} has no scene_id: write it again")
    category = tuple(as_name(entry.get("category"), f"category of an object in {path}") for entry in entries)
    objects = _objects_from_json(entries, path, scored=scored)
    _check_objects(objects, path, lambda index: _line_of_object(path, index), flat=flat)
    return NamedBoxes(path, scene_id, category, objects, content.get("classes"))


def _objects_from_json(entries: Sequence[dict[str, Any]], path: Path, *, scored: bool) -> ObjectSet:
    count = len(entries)

    def column(key: str, quantity: Quantity, *shape: int) -> torch.Tensor:
        rows = [entry.get(key) for entry in entries]
        # What is out of bounds becomes NaN, of which `_check_objects` names the line.
        values = as_numbers(rows, (count, *shape), quantity, f"{key} of the objects in {path}", lost=True)
        return torch.from_numpy(values)

    models = tuple(_model_id(entry, path) for entry in entries)
    return ObjectSet(
        label=torch.zeros(count, dtype=torch.int64),
        center=column("center", POSITION, 3),
        size=column("size", _SIDE, 3),
        rotation=column("rotation", MATRIX_ENTRY, 3, 3),
        symmetry=torch.ones(count, dtype=torch.int64),
        score=column("score", SCORE) if scored else torch.ones(count, dtype=torch.float64),
        model_id=models if any(models) else (),
    )


def _model_id(entry: Mapping[str, Any], path: Path) -> str:
    """Return ``catid/id`` of the CAD model of an object, empty if it has none."""
    if not entry.get("id_cad"):
        return ""
    return "/".join(as_name(entry.get(key), f"{key} in {path}") for key in ("catid_cad", "id_cad"))


def is_boxer_csv(path: Path) -> bool:
    """Say whether a file begins with the header row of Boxer's boxes."""
    if path.suffix != ".csv":
        return False
    first = next((line for line in read_text(path, max_bytes=_MAX_CSV).splitlines() if line.strip()), "")
    return [cell.strip() for cell in first.split(",")] == list(BOXER_COLUMNS)


def read_boxer_csv(path: Path, *, flat: bool = False) -> NamedBoxes:
    """Read the boxes of one scene that Boxer has written, or a program that writes the same columns.

    A box there has its own z axis up; here it is turned to have its y axis up, as all objects, and its sizes
    are (x, z, y) of the file's: it is the same box. Its position is that of the file's world. Boxes of
    different frames are separate predictions, of which a warning tells.

    Args:
        path: the file, with its header row.
        flat: a size may be 0.

    Raises:
        DataError: the file cannot be read, or a row has another number of columns or a wrong value.
    """
    lines: list[int] = []
    rows: list[list[float]] = []
    names: list[str] = []
    times: set[str] = set()
    for line, cells in _cells(path):
        if not lines and cells == list(BOXER_COLUMNS):
            continue
        if len(cells) != len(BOXER_COLUMNS):
            raise DataError(
                f"{path}, line {line} has {len(cells)} columns: write the {len(BOXER_COLUMNS)} columns "
                f"{','.join(BOXER_COLUMNS)}"
            )
        row = dict(zip(BOXER_COLUMNS, cells, strict=True))
        columns = (*BOXER_COLUMNS[1:11], "prob")
        rows.append(_numbers([row[column] for column in columns], columns, path, line))
        if math.hypot(*rows[-1][3:7]) < _LEAST_LENGTH:
            raise DataError(f"{path}, line {line}: the quaternion has length zero, write a rotation")
        names.append(as_name(row["name"], f"name in line {line} of {path}"))
        lines.append(line)
        times.add(row["time_ns"])
    if len(times) > 1:
        _log.warning(
            "%s holds boxes of %d frames, each of which counts as a prediction of its own: fuse them first, "
            "with Boxer's --fuse or --track",
            *(path, len(times)),
        )
    numbers = torch.tensor(rows, dtype=torch.float64).reshape(len(rows), 11)
    objects = ObjectSet(
        label=torch.zeros(len(rows), dtype=torch.int64),
        center=numbers[:, :3],
        size=numbers[:, [7, 9, 8]],
        rotation=matrix_from_quaternion(numbers[:, 3:7]) @ upright_basis(dtype=torch.float64),
        symmetry=torch.ones(len(rows), dtype=torch.int64),
        score=numbers[:, 10],
    )
    _check_objects(objects, path, lambda index: lines[index], flat=flat)
    return NamedBoxes(path, "", tuple(names), objects)


class _Row(NamedTuple):
    line: int
    scan: str
    names: list[str]
    values: list[float]


def read_alignments_csv(path: Path) -> CadAlignments:
    """Read the predictions for one scan, 12 columns a row; a header row and blank lines are skipped.

    A 13th column is the score. Quaternions and categories are kept as given, but one sentence warns of
    quaternions not of length one and of categories without eight digits: the official script takes them as
    they are, and the latter match nothing.

    Args:
        path: ``<id_scan>.csv``.

    Raises:
        DataError: the file cannot be read, or a row has another number of columns, a value that is no
            finite number, a quaternion of length zero or a scale that is not positive.
    """
    rows = _read_rows(Path(path), _OF_ONE_SCAN)
    short = [row for row in rows if len(row.names[0]) != _CATID_DIGITS]
    if short:
        _log.warning(
            "%s, line %d: catid_cad %s does not have eight digits (%d such lines) and matches nothing",
            *(path, short[0].line, shown(short[0].names[0]), len(short)),
        )
    return _alignments_from_rows(rows)


def read_roca_csv(path: Path) -> dict[str, CadAlignments]:
    """Read the predictions for many scans, 14 columns a row, as ``read_alignments_csv`` does.

    Scan2CAD's 13 columns, which have no score, and Vid2CAD's 16 are read too. ROCA writes categories as
    numbers; they get their leading zeros back.

    Args:
        path: the file; the rows of a scan need not be neighbours.

    Returns:
        the alignments of each scan that has any, in the order of first appearance.

    Raises:
        DataError: see ``read_alignments_csv``.
    """
    by_scene: dict[str, list[_Row]] = {}
    for row in _read_rows(Path(path), _OF_MANY_SCANS):
        category, name = row.names
        by_scene.setdefault(row.scan, []).append(row._replace(names=[category.zfill(_CATID_DIGITS), name]))
    return {scene_id: _alignments_from_rows(rows) for scene_id, rows in by_scene.items()}


def _read_rows(path: Path, forms: Sequence[tuple[str, ...]]) -> list[_Row]:
    """Return the rows of a file whose columns are those of one of some forms, the same in all rows."""
    rows: list[_Row] = []
    not_unit: list[int] = []
    columns: tuple[str, ...] | None = None
    is_first = True
    for line, cells in _cells(path):
        is_first, may_be_header = False, is_first
        if may_be_header and len(cells) in map(len, forms) and _is_header(cells[3:]):
            _log.warning("%s, line %d: skipped a header row", path, line)
            continue
        columns = columns or _form_of(cells, forms)
        if columns is None or len(cells) != len(columns):
            wanted = columns or forms[0]
            others = "" if columns else "".join(f" or {len(form)}" for form in forms[1:])
            raise DataError(
                f"{path}, line {line} has {len(cells)} columns: write the {len(wanted)} columns "
                f"{','.join(wanted)}{others}"
            )
        row = _row(line, cells, columns, path)
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


def _cells(path: Path) -> Iterator[tuple[int, list[str]]]:
    """Give the cells of each row that is not empty, with the number of its line."""
    try:
        lines = read_text(path, max_bytes=_MAX_CSV).splitlines()
        separator = ";" if lines and "," not in lines[0] else ","  # spreadsheets write semicolons
        table = list(csv.reader(lines, delimiter=separator))
    except csv.Error as error:
        raise DataError(f"cannot read the alignments {path} ({error}): check the path") from error
    for line, cells in enumerate(table, start=1):
        stripped = [cell.strip() for cell in cells]
        if any(stripped):
            yield line, stripped


def _form_of(cells: Sequence[str], forms: Sequence[tuple[str, ...]]) -> tuple[str, ...] | None:
    """Return the columns of a row, None if it has those of no form.

    Only the name of a category is a whole number: a row of 13 that begins with one has no name of a scan.
    """
    has_scan = not cells[0].isdecimal()
    return next(
        (
            form
            for form in forms
            if len(form) == len(cells) and (len(form) != 13 or (form[0] == "id_scan") == has_scan)
        ),
        None,
    )


def _row(line: int, cells: Sequence[str], columns: tuple[str, ...], path: Path) -> _Row:
    """Return a row of a file.

    Raises:
        DataError: a value is no finite number.
    """
    named = [(name, cell) for name, cell in zip(columns, cells, strict=True) if name not in _NOT_READ]
    scan = next((cell for name, cell in named if name == "id_scan"), "")
    names = [cell for name, cell in named if name in _NAMES and name != "id_scan"]
    numbers = [(name, cell) for name, cell in named if name not in _NAMES]
    values = _numbers([cell for _, cell in numbers], tuple(name for name, _ in numbers), path, line)
    return _Row(line, scan, names, values)


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
    return [
        as_number(float(cell), _QUANTITIES.get(name, SCORE), f"{name} in line {line} of {path}")
        for name, cell in zip(columns, cells, strict=True)
    ]


def _checked_length(row: _Row, path: Path) -> float:
    """Return the length of a row's quaternion; a pose that no object can have is an error."""
    length = math.hypot(*row.values[3:7])
    if length < _LEAST_LENGTH:
        raise DataError(f"{path}, line {row.line}: the quaternion has length zero, write a rotation")
    if min(row.values[7:10]) < SCALE.low:
        raise DataError(f"{path}, line {row.line}: a scale is not positive, write sizes in metres a CAD unit")
    return length


def _alignments_from_rows(rows: list[_Row]) -> CadAlignments:
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
