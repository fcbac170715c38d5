# SPDX-License-Identifier: Apache-2.0
"""rooms-v2: rooms to train on that look like the world; networks are judged elsewhere (``benchmark``)."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

from raytran.rooms.benchmark import scan_numbers
from raytran.rooms.generate import RoomSplit, RoomsReport, make_splits
from raytran.rooms.scene import RoomSettings

FORMAT = "raytran.rooms-v2/1"
"""Rises when the rooms change."""

NUM_TRAIN, NUM_VAL = 1000, 50

SETTINGS = RoomSettings(
    # Another seed than that of rooms-v1: models of one seed are never those of another.
    seed=2,
    frames=24,
    image_size=(240, 320),
    min_objects=3,
    max_objects=24,
    room_size=((3.0, 8.0), (2.8, 7.0)),
)

_NUMBERS = {"train": range(8000), "val": range(8000, 9000)}
# As many as this that training shares, none of which has a number of validation or test of rooms-v1.
_TRAIN_MODELS = (*range(100), *range(300, 700))
_VAL_MODELS = tuple(range(900, 1000))


def generate_rooms_v2(
    output: Path,
    *,
    num_train: int = NUM_TRAIN,
    num_val: int = NUM_VAL,
    cads: Path | None = None,
    processes: int = 0,
    progress: bool = True,
) -> RoomsReport:
    """Make the rooms, finish a set that was begun, or add rooms to a smaller one.

    The first rooms of each split are the same whatever the numbers, and rooms once made stay in the lists.

    Args:
        output: folder that gets ``scannet/``, ``shapenet/``, ``scan2cad/`` and ``rooms.json``.
        num_train: training scans, numbered from 0.
        num_val: scans to choose networks by, numbered from 8000; they have other generated models, textures
            and layouts, and the given models of training.
        cads: folder in ShapeNet's layout, of whose models the training half is drawn as often as generated
            ones; the other half is never touched. None: generated models alone.
        processes: worker processes, 0 for one per core; 1 works in this process.
        progress: show a progress bar.

    Raises:
        ConfigError: a number is too large.
        DataError: ``output`` holds other rooms, or ``cads`` holds no model that can be used.
    """
    output = Path(output)
    numbers = scan_numbers(output, {"train": num_train, "val": num_val}, _NUMBERS)
    models = {"train": _TRAIN_MODELS, "val": _VAL_MODELS}
    splits = [
        RoomSplit(
            name,
            numbers[name],
            SETTINGS.frames,
            models[name],
            textures=number,
            given="train",
            mixed=True,
            look="world",
        )
        for number, name in enumerate(_NUMBERS)
    ]
    claim = {"format": FORMAT, **asdict(SETTINGS)}
    return make_splits(
        output, SETTINGS, splits, claim=claim, cads=cads, processes=processes, progress=progress
    )
