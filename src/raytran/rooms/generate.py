# SPDX-License-Identifier: Apache-2.0
"""Generates data sets of furnished rooms in the raw layout of ScanNet, ShapeNet and Scan2CAD."""

from __future__ import annotations

import json
import logging
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from raytran.data.files import UNFINISHED, SettingsRecord, sweep, write_text
from raytran.data.locks import lock_when_free
from raytran.data.scan2cad import parse_entry
from raytran.data.text import read_json_object
from raytran.data.workers import work_on
from raytran.errors import ConfigError, DataError
from raytran.rooms.library import (
    MODELS_PER_CLASS,
    ModelPool,
    digest_of,
    list_models,
    read_library,
    survey,
    write_library,
)
from raytran.rooms.scene import Look, RoomSettings, make_scene
from raytran.rooms.write import annotation_path, write_scene

_log = logging.getLogger(__name__)

FORMAT = "raytran.rooms/1"
"""Rises when the same seed no longer gives the same rooms."""

_CADS = "cads.json"
_LOCK = ".rooms.lock"

_NOTICES = ("credits.csv", "LICENCES.txt")
"""Files beside CAD models that must go where the models go."""


@dataclass(frozen=True)
class RoomSplit:
    """How the rooms of one split are made.

    Attributes:
        name: ``train``, ``val`` or ``test``.
        numbers: of its scans; a room follows from the seed and its number.
        frames: pictures with a valid pose in each scan.
        models: numbers of the generated models of each class that its rooms use.
        textures: number of the set of textures that its rooms are painted with.
        given: split of the given CAD models that its rooms use, ``train`` or ``val``; None for all.
        mixed: draw as often from the generated models as from the given ones.
        look: how its rooms are and are recorded, see ``make_scene``.
    """

    name: str
    numbers: range
    frames: int
    models: Sequence[int] = range(MODELS_PER_CLASS)
    textures: int = 0
    given: str | None = "train"
    mixed: bool = False
    look: Look = "plain"

    @property
    def scan_ids(self) -> tuple[str, ...]:
        """The names of its scans, in order."""
        return tuple(scan_name(number) for number in self.numbers)


@dataclass(frozen=True)
class RoomsReport:
    """What a call of ``generate_rooms`` did.

    Attributes:
        root: folder of the data set.
        train: scans for training.
        val: held-out scans.
        made: number of scans made by this call; the others existed already.
        objects: objects in all scans together.
        seconds: wall-clock time.
        cads_left_out: ``catid/id`` of given CAD models that cannot be used, with the reason.
        test: scans that are held out from every choice, too.
    """

    root: Path
    train: tuple[str, ...]
    val: tuple[str, ...]
    made: int
    objects: int
    seconds: float
    cads_left_out: dict[str, str] = field(default_factory=dict)
    test: tuple[str, ...] = ()


def scan_name(number: int) -> str:
    """Return the name of the scan with this number, in ScanNet's form."""
    return f"scene{number:04d}_00"


def generate_rooms(
    output: Path,
    *,
    num_train: int,
    num_val: int,
    seed: int = 0,
    frames: int = 60,
    image_size: tuple[int, int] = (480, 640),
    min_objects: int = 3,
    max_objects: int = 30,
    room_size: tuple[tuple[float, float], tuple[float, float]] = ((3.0, 7.0), (3.0, 6.0)),
    cads: Path | None = None,
    processes: int = 0,
    progress: bool = True,
) -> RoomsReport:
    """Make a data set of furnished rooms, or finish one that was begun.

    Each scene follows from ``seed``, its number and the models in ``cads`` alone. A scan whose folder carries
    its final name is done; calling again makes what is missing. An interrupt lets rooms in work end and
    leaves nothing half-written. Of two calls at once with one folder the second waits for the first.

    Args:
        output: folder that gets ``scannet/``, ``shapenet/``, ``scan2cad/`` and ``rooms.json``.
        num_train: training scans, numbered from 0.
        num_val: held-out scans, numbered after them.
        seed: of everything.
        frames: pictures with a valid pose in each scan.
        image_size: ``(H, W)`` pixels.
        min_objects: least number of objects in a room.
        max_objects: greatest number of objects in a room.
        room_size: ranges of the two sides of the floor, metres.
        cads: folder in ShapeNet's layout with the furniture; None for generated models. Training and held-out
            rooms get different models. Classes that it lacks are generated. ``cads.json`` says which models
            are used, which are not and why.
        processes: worker processes, 0 for one per core; 1 works in this process.
        progress: show a progress bar.

    Raises:
        ConfigError: the numbers contradict each other.
        DataError: ``output`` holds rooms that were made with other settings, or ``cads`` holds no model that
            can be used.
    """
    settings = RoomSettings(seed, frames, image_size, min_objects, max_objects, room_size)
    _check(settings, num_train, num_val)
    train = RoomSplit("train", range(num_train), frames)
    val = RoomSplit("val", range(num_train, num_train + num_val), frames, given="val")
    claim = {"format": FORMAT, "num_train": num_train, "num_val": num_val, **asdict(settings)}
    return make_splits(
        output, settings, (train, val), claim=claim, cads=cads, processes=processes, progress=progress
    )


def make_splits(
    output: Path,
    settings: RoomSettings,
    splits: Sequence[RoomSplit],
    *,
    claim: dict[str, Any],
    cads: Path | None = None,
    processes: int = 0,
    progress: bool = True,
) -> RoomsReport:
    """Make the rooms of some splits and the lists of them, or finish what was begun.

    Args:
        output: as of ``generate_rooms``.
        settings: of all rooms, except that each split has its own number of frames.
        splits: the splits; no two of them have a number in common.
        claim: content of ``rooms.json``; a data set with another one is not touched.
        cads: see ``generate_rooms``.
        processes: see ``generate_rooms``.
        progress: see ``generate_rooms``.

    Raises:
        DataError: as ``generate_rooms``.
    """
    started = time.monotonic()
    output, cads = Path(output).resolve(), None if cads is None else Path(cads).resolve()
    claim = claim if cads is None else claim | {"cads": digest_of(list_models(cads))}
    if _record(output).path.exists():
        _claim(output, claim)  # other settings are told before a wait, not after it
    with lock_when_free(output / _LOCK, work=f"makes the rooms in {output}"):
        _claim(output, claim)
        left_out = {} if cads is None else _survey_cads(output, cads, processes, progress)
        scans = output / "scannet" / "scans"
        scans.mkdir(parents=True, exist_ok=True)
        sweep(scans, f"{UNFINISHED}*")
        rooms = [(split, number) for split in splits for number in split.numbers]
        missing = [(split, number) for split, number in rooms if not (scans / scan_name(number)).is_dir()]
        make = partial(_make_scan, output, settings, cads)
        for _ in work_on(missing, make, label="rooms", processes=processes, progress=progress):
            pass
        objects = _write_lists(output, splits)
        sweep(scans, f"{UNFINISHED}*")
    named = {split.name: split.scan_ids for split in splits}
    return RoomsReport(
        root=output,
        train=named.get("train", ()),
        val=named.get("val", ()),
        test=named.get("test", ()),
        made=len(missing),
        objects=objects,
        seconds=time.monotonic() - started,
        cads_left_out=left_out,
    )


def _make_scan(output: Path, settings: RoomSettings, cads: Path | None, which: tuple[RoomSplit, int]) -> int:
    """Make and write the scan of a split with this number; return how many objects it has."""
    split, number = which
    rng = np.random.default_rng([settings.seed, number])
    library = None if cads is None else read_library(output / _CADS, cads)
    pool = ModelPool(settings.seed, library, split.given, split.models, mixed=split.mixed)
    settings = replace(settings, frames=split.frames)
    scene = make_scene(settings, rng, pool, textures=split.textures, look=split.look)
    return write_scene(scene, scan_id=scan_name(number), root=output, rng=rng)


def _survey_cads(output: Path, cads: Path, processes: int, progress: bool) -> dict[str, str]:
    """Write ``cads.json`` unless it is there; return which models cannot be used, and why."""
    path = output / _CADS
    if not path.is_file():
        write_library(survey(cads, processes=processes, progress=progress), path)
    for name in _NOTICES:
        if (cads / name).is_file():
            write_text(output / "shapenet" / name, (cads / name).read_text(encoding="utf-8"))
    library = read_library(path, cads)
    if library.left_out:
        name, why = next(iter(library.left_out.items()))
        _log.warning(
            "%d of %d CAD models are not used; %s names them, the first is %s: %s",
            *(len(library.left_out), len(library.left_out) + len(library.models), path, name, why),
        )
    return library.left_out


def _check(settings: RoomSettings, num_train: int, num_val: int) -> None:
    if num_train < 0 or num_val < 0 or not 0 < num_train + num_val <= 10000:
        raise ConfigError(
            f"expected 1 to 10000 rooms in all, got num_train={num_train} and num_val={num_val}"
        )
    if not 1 <= settings.min_objects <= settings.max_objects:
        raise ConfigError(
            f"expected 1 ≤ min_objects ≤ max_objects, got {settings.min_objects} and {settings.max_objects}"
        )
    if settings.frames < 2 or min(settings.image_size) < 16 or settings.seed < 0:
        raise ConfigError("expected seed ≥ 0, at least 2 frames and images of at least 16 × 16 pixels")
    if any(not 2.0 <= low <= high <= 12.0 for low, high in settings.room_size):
        raise ConfigError(f"expected room sides between 2 and 12 metres, got {settings.room_size}")


def _claim(output: Path, asked: dict[str, Any]) -> None:
    """Write ``rooms.json``.

    Raises:
        DataError: there is one with other settings.
    """
    record = _record(output)
    different = record.begin(asked)
    if different:
        raise DataError(
            f"{record.path} describes rooms made with other settings ({', '.join(different)}); "
            "choose another output folder or remove this one"
        )


def _record(output: Path) -> SettingsRecord:
    return SettingsRecord(output / "rooms.json")


def _entry(path: Path) -> dict[str, Any]:
    """Return the annotation of one room, checked."""
    entry = read_json_object(path)
    try:
        parse_entry(entry)
    except DataError as error:
        raise DataError(f"{path} is damaged ({error}): remove the folder of that room") from error
    return entry


def _write_lists(output: Path, splits: Sequence[RoomSplit]) -> int:
    """Write the split files and the annotations of all scans; return the number of objects."""
    entries = [_entry(annotation_path(output, scan_id)) for split in splits for scan_id in split.scan_ids]
    write_text(output / "scan2cad" / "full_annotations.json", json.dumps(entries))
    counts = {
        entry["id_scan"]: Counter(f"{m['catid_cad']}_{m['id_cad']}" for m in entry["aligned_models"])
        for entry in entries
    }
    write_text(output / "scan2cad" / "cad_appearances.json", json.dumps(counts, indent=1))
    for split in splits:
        path = output / "scannet" / f"scannetv2_{split.name}.txt"
        write_text(path, "".join(f"{scan_id}\n" for scan_id in split.scan_ids))
    return sum(entry["n_aligned_models"] for entry in entries)
