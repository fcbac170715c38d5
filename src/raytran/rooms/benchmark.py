# SPDX-License-Identifier: Apache-2.0
"""rooms-v1: a fixed benchmark of generated rooms for training, validation and test.

Rooms of validation and test share no CAD model, texture or layout with training or with each other. Another
test set takes its furniture from given CAD models. Only the number of rooms can be chosen.
"""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

from raytran.data.scene_list import read_split
from raytran.errors import ConfigError
from raytran.rooms.generate import RoomSplit, RoomsReport, make_splits
from raytran.rooms.library import MODELS_PER_CLASS
from raytran.rooms.scene import RoomSettings

FORMAT = "raytran.rooms-v1/1"
"""Rises when the rooms change; results before and after cannot be compared."""

NUM_TRAIN, NUM_VAL, NUM_TEST = 1000, 100, 100
"""Rooms of the benchmark; fewer are for quick trials."""

SETTINGS = RoomSettings(
    seed=0,
    frames=24,
    image_size=(240, 320),
    min_objects=3,
    max_objects=20,
    room_size=((3.0, 6.0), (3.0, 5.5)),
)
"""Those of the preset ``small``."""

TEST_FRAMES = 96
"""Frames of a test room, as many as the paper predicts from."""

FURNITURE_PARTS = {"all": None, "held_out": "val"}
"""Which of the given CAD models the second test set takes → their split; None for both."""

# The ranges are fixed, so that a room does not depend on how many others there are.
_NUMBERS = {"train": range(8000), "val": range(8000, 9000), "test": range(9000, 9500)}
_FURNITURE_NUMBERS = range(9500, 10000)


def generate_rooms_v1(
    output: Path,
    *,
    num_train: int = NUM_TRAIN,
    num_val: int = NUM_VAL,
    num_test: int = NUM_TEST,
    processes: int = 0,
    progress: bool = True,
) -> RoomsReport:
    """Make the benchmark, finish one that was begun, or add rooms to a smaller one.

    The first rooms of each split are the same whatever the numbers, and rooms once made stay in the lists.

    Args:
        output: folder that gets ``scannet/``, ``shapenet/``, ``scan2cad/`` and ``rooms.json``.
        num_train: training scans, numbered from 0: those of ``generate_rooms`` with these settings.
        num_val: scans to choose networks by, numbered from 8000.
        num_test: scans to report results on, of ``TEST_FRAMES`` frames, numbered from 9000.
        processes: worker processes, 0 for one per core; 1 works in this process.
        progress: show a progress bar.

    Raises:
        ConfigError: a number is too large.
        DataError: ``output`` holds other rooms.
    """
    output = Path(output)
    asked = {"train": num_train, "val": num_val, "test": num_test}
    numbers = scan_numbers(output, asked, _NUMBERS)
    splits = (
        RoomSplit("train", numbers["train"], SETTINGS.frames),
        RoomSplit("val", numbers["val"], SETTINGS.frames, _models(1), textures=1),
        RoomSplit("test", numbers["test"], TEST_FRAMES, _models(2), textures=2),
    )
    claim = {"format": FORMAT, **asdict(SETTINGS), "test_frames": TEST_FRAMES}
    return make_splits(output, SETTINGS, splits, claim=claim, processes=processes, progress=progress)


def generate_rooms_v1_furniture(
    output: Path,
    *,
    cads: Path,
    part: str = "all",
    num_test: int = NUM_TEST,
    processes: int = 0,
    progress: bool = True,
) -> RoomsReport:
    """Make test rooms with furniture that was not generated: shapes from another distribution.

    They differ from the test rooms of ``generate_rooms_v1`` in their CAD models and, as larger or smaller
    pieces fit elsewhere, their layouts.

    Args:
        output: as of ``generate_rooms_v1``; gets a list of test scans only.
        cads: folder in ShapeNet's layout; where it has fewer than five models of what is wanted, those of the
            other test rooms are used, too.
        part: of its models, ``all``, or ``held_out`` for those that no training room is furnished with. Sets
            of both parts have scans of the same names, with other furniture in them.
        num_test: scans, numbered from 9500.
        processes: worker processes, 0 for one per core; 1 works in this process.
        progress: show a progress bar.

    Raises:
        ConfigError: the number is too large, or there is no such part.
        DataError: ``output`` holds other rooms, or ``cads`` holds no model that can be used.
    """
    if part not in FURNITURE_PARTS:
        raise ConfigError(f"unknown part={part}: choose one of {', '.join(FURNITURE_PARTS)}")
    numbers = scan_numbers(Path(output), {"test": num_test}, {"test": _FURNITURE_NUMBERS})
    split = RoomSplit(
        "test", numbers["test"], TEST_FRAMES, _models(2), textures=2, given=FURNITURE_PARTS[part]
    )
    claim = {"format": FORMAT, "furniture": True, **asdict(SETTINGS), "test_frames": TEST_FRAMES}
    if part != "all":  # rooms made before there were parts go on as they are
        claim |= {"part": part}
    return make_splits(
        output, SETTINGS, [split], claim=claim, cads=cads, processes=processes, progress=progress
    )


def _models(split: int) -> range:
    """Return the numbers of the generated models of a split: 0 is training, 1 validation, 2 test."""
    return range(split * MODELS_PER_CLASS, (split + 1) * MODELS_PER_CLASS)


def scan_numbers(output: Path, asked: dict[str, int], numbers: dict[str, range]) -> dict[str, range]:
    """Return the numbers of each split's scans: the first ones, as many as asked or as are listed already.

    Args:
        output: of the data set.
        asked: how many, by split.
        numbers: that the scans of a split can have.

    Raises:
        ConfigError: one is too large or negative, or all are 0.
    """
    for name, count in asked.items():
        if not 0 <= count <= len(numbers[name]):
            raise ConfigError(f"expected 0 to {len(numbers[name])} rooms, got num_{name}={count}")
    if not any(asked.values()):
        raise ConfigError(
            "no rooms are asked for: give at least one of " + ", ".join(f"num_{n}=" for n in asked)
        )
    return {name: numbers[name][: max(count, _listed(output, name))] for name, count in asked.items()}


def _listed(output: Path, split: str) -> int:
    """Return how many scans of a split were listed by an earlier call."""
    path = output / "scannet" / f"scannetv2_{split}.txt"
    return len(read_split(output / "scannet", split) or ()) if path.is_file() else 0
