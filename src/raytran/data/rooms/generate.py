# SPDX-License-Identifier: Apache-2.0
"""Furnished rooms by the number, in the raw layout of ScanNet, ShapeNet and Scan2CAD."""

from __future__ import annotations

import contextlib
import json
import multiprocessing
import os
import shutil
import signal
import time
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from dataclasses import asdict, dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from raytran.data.rooms.scene import RoomSettings, make_scene
from raytran.data.rooms.write import annotation_path, write_scene, write_text
from raytran.errors import ConfigError, DataError

FORMAT = "raytran.rooms/1"
"""Rises when the same seed no longer gives the same rooms."""

_ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


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
    """

    root: Path
    train: tuple[str, ...]
    val: tuple[str, ...]
    made: int
    objects: int
    seconds: float


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
    processes: int = 0,
    progress: bool = True,
) -> RoomsReport:
    """Make a data set of furnished rooms, or finish one that was begun.

    Each scene follows from ``seed`` and its number alone. A scan whose folder carries its final name is done;
    calling again makes what is missing. An interrupt lets rooms in work end and leaves nothing half-written.

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
        processes: worker processes, 0 for one per core; 1 works in this process.
        progress: show a progress bar.

    Raises:
        ConfigError: the numbers contradict each other.
        DataError: ``output`` holds rooms that were made with other settings.
    """
    started = time.monotonic()
    settings = RoomSettings(seed, frames, image_size, min_objects, max_objects, room_size)
    _check(settings, num_train, num_val)
    output = Path(output).resolve()
    _claim(output, {"format": FORMAT, "num_train": num_train, "num_val": num_val, **asdict(settings)})
    scan_ids = [f"scene{number:04d}_00" for number in range(num_train + num_val)]
    scans = output / "scannet" / "scans"
    scans.mkdir(parents=True, exist_ok=True)
    _sweep(scans)
    missing = [number for number, scan_id in enumerate(scan_ids) if not (scans / scan_id).is_dir()]
    _make_all(output, settings, missing, processes, progress)
    objects = _write_lists(output, scan_ids, num_train)
    train, val = tuple(scan_ids[:num_train]), tuple(scan_ids[num_train:])
    return RoomsReport(output, train, val, len(missing), objects, time.monotonic() - started)


def make_room_scan(output: Path, settings: RoomSettings, number: int) -> int:
    """Make and write the scan with this number; return how many objects it has."""
    rng = np.random.default_rng([settings.seed, number])
    return write_scene(make_scene(settings, rng), scan_id=f"scene{number:04d}_00", root=output, rng=rng)


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
        different = [key for key in asked if found.get(key) != asked[key]]
        if different:
            raise DataError(
                f"{path} describes rooms made with other settings ({', '.join(different)}); "
                "choose another output folder or remove this one"
            )
        return
    write_text(path, json.dumps(asked, indent=2) + "\n")


def _sweep(scans: Path) -> None:
    """Remove what an earlier call that was killed left unfinished."""
    for folder in scans.glob(".scene*.tmp"):
        shutil.rmtree(folder, ignore_errors=True)


def _make_all(
    output: Path, settings: RoomSettings, numbers: list[int], processes: int, progress: bool
) -> None:
    workers = min(processes or os.cpu_count() or 1, len(numbers))
    columns = (TextColumn("rooms"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, disable=not progress or not numbers) as bar:
        task = bar.add_task("rooms", total=len(numbers))
        if workers <= 1:
            for number in numbers:
                make_room_scan(output, settings, number)
                bar.advance(task)
            return
        with _one_thread_each(), _pool(workers) as pool:
            # No more is handed out than is worked on, so that an interrupt waits for rooms in work only.
            waiting = iter(numbers)
            running = {pool.submit(make_room_scan, output, settings, n) for n in islice(waiting, workers)}
            while running:
                done, running = wait(running, return_when=FIRST_COMPLETED)
                for future in done:
                    future.result()
                    bar.advance(task)
                    running |= {pool.submit(make_room_scan, output, settings, n) for n in islice(waiting, 1)}


def _pool(workers: int) -> ProcessPoolExecutor:
    context = multiprocessing.get_context("spawn")
    return ProcessPoolExecutor(workers, mp_context=context, initializer=_leave_interrupts_to_parent)


def _leave_interrupts_to_parent() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)


@contextlib.contextmanager
def _one_thread_each() -> Iterator[None]:
    """Let processes started inside use one thread each."""
    before = {name: os.environ.get(name) for name in _ONE_THREAD}
    os.environ.update(dict.fromkeys(_ONE_THREAD, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


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
