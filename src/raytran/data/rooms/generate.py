# SPDX-License-Identifier: Apache-2.0
"""Furnished rooms by the number, in the raw layout of ScanNet, ShapeNet and Scan2CAD."""

from __future__ import annotations

import json
import logging
import time
from collections import Counter
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from raytran.data.atomic import UNFINISHED, sweep, write_text
from raytran.data.rooms.library import digest_of, list_models, read_library, survey, write_library
from raytran.data.rooms.pool import ModelPool
from raytran.data.rooms.scene import RoomSettings, make_scene
from raytran.data.rooms.write import annotation_path, write_scene
from raytran.data.workers import work_on
from raytran.errors import ConfigError, DataError

_log = logging.getLogger(__name__)

FORMAT = "raytran.rooms/1"
"""Rises when the same seed no longer gives the same rooms."""

_CADS = "cads.json"

_NOTICES = ("credits.csv", "LICENCES.txt")
"""Files beside CAD models that must go where the models go."""


@dataclass(frozen=True)
class RoomsReport:
    """What a call of ``generate_rooms`` did.

    Attributes:
        root: the data set.
        train: scans for training.
        val: held-out scans.
        made: scans made by this call; the others were there already.
        objects: objects in all scans together.
        seconds: wall-clock time.
        cads_left_out: ``catid/id`` of given CAD models that cannot be used, with the reason.
    """

    root: Path
    train: tuple[str, ...]
    val: tuple[str, ...]
    made: int
    objects: int
    seconds: float
    cads_left_out: dict[str, str] = field(default_factory=dict)


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
    leaves nothing half-written.

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
        cads: folder in ShapeNet's layout to furnish with; None for generated models. Training and held-out
            rooms get different models. What it lacks, such as a class, is generated; ``cads.json`` tells
            which models are used, which are not and why.
        processes: worker processes, 0 for one per core; 1 works in this process.
        progress: show a progress bar.

    Raises:
        ConfigError: the numbers contradict each other.
        DataError: ``output`` holds rooms that were made with other settings, or ``cads`` holds no model that
            can be used.
    """
    settings = RoomSettings(seed, frames, image_size, min_objects, max_objects, room_size)
    _check(settings, num_train, num_val)
    cads = None if cads is None else Path(cads).resolve()
    return _generate(Path(output).resolve(), settings, (num_train, num_val), cads, processes, progress)


def _generate(
    output: Path,
    settings: RoomSettings,
    numbers: tuple[int, int],
    cads: Path | None,
    processes: int,
    progress: bool,
) -> RoomsReport:
    started = time.monotonic()
    num_train, num_val = numbers
    asked = {"format": FORMAT, "num_train": num_train, "num_val": num_val, **asdict(settings)}
    _claim(output, asked if cads is None else asked | {"cads": digest_of(list_models(cads))})
    left_out = {} if cads is None else _look_through(output, cads, processes, progress)
    scan_ids = [f"scene{number:04d}_00" for number in range(num_train + num_val)]
    scans = output / "scannet" / "scans"
    scans.mkdir(parents=True, exist_ok=True)
    sweep(scans, f"{UNFINISHED}*")
    missing = [number for number, scan_id in enumerate(scan_ids) if not (scans / scan_id).is_dir()]
    make = partial(make_room_scan, output, settings, num_train=num_train, cads=cads)
    for _ in work_on(missing, make, label="rooms", processes=processes, progress=progress):
        pass
    objects = _write_lists(output, scan_ids, num_train)
    train, val = tuple(scan_ids[:num_train]), tuple(scan_ids[num_train:])
    return RoomsReport(output, train, val, len(missing), objects, time.monotonic() - started, left_out)


def make_room_scan(
    output: Path, settings: RoomSettings, number: int, *, num_train: int, cads: Path | None = None
) -> int:
    """Make and write the scan with this number; return how many objects it has."""
    rng = np.random.default_rng([settings.seed, number])
    library = None if cads is None else read_library(output / _CADS, cads)
    pool = ModelPool(settings.seed, library, "train" if number < num_train else "val")
    scene = make_scene(settings, rng, pool)
    return write_scene(scene, scan_id=f"scene{number:04d}_00", root=output, rng=rng)


def _look_through(output: Path, cads: Path, processes: int, progress: bool) -> dict[str, str]:
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
    """Write ``rooms.json``, or see that the one there asked for the same."""
    path = output / "rooms.json"
    asked = json.loads(json.dumps(asked))
    if path.exists():
        try:
            found = json.loads(path.read_text(encoding="utf-8"))
        except ValueError:
            found = {}
        different = [key for key in {"cads": None} | asked if found.get(key) != asked.get(key)]
        if different:
            raise DataError(
                f"{path} describes rooms made with other settings ({', '.join(different)}); "
                "choose another output folder or remove this one"
            )
        return
    write_text(path, json.dumps(asked, indent=2) + "\n")


def _write_lists(output: Path, scan_ids: list[str], num_train: int) -> int:
    """Write the split files and the annotations of all scans; return the number of objects."""
    entries = [
        json.loads(annotation_path(output, scan_id).read_text(encoding="utf-8")) for scan_id in scan_ids
    ]
    write_text(output / "scan2cad" / "full_annotations.json", json.dumps(entries))
    counts = {
        entry["id_scan"]: Counter(f"{m['catid_cad']}_{m['id_cad']}" for m in entry["aligned_models"])
        for entry in entries
    }
    write_text(output / "scan2cad" / "cad_appearances.json", json.dumps(counts, indent=1))
    for split, chosen in (("train", scan_ids[:num_train]), ("val", scan_ids[num_train:])):
        write_text(
            output / "scannet" / f"scannetv2_{split}.txt", "".join(f"{scan_id}\n" for scan_id in chosen)
        )
    return sum(entry["n_aligned_models"] for entry in entries)
