# SPDX-License-Identifier: Apache-2.0
"""The default data: rooms that are generated when training or evaluation first asks for them."""

from __future__ import annotations

import json
import logging
from collections.abc import Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Any

from raytran.data.files import SettingsRecord
from raytran.data.text import read_names
from raytran.errors import ConfigError
from raytran.rooms.benchmark import generate_rooms_v1
from raytran.rooms.generate import generate_rooms
from raytran.rooms.rooms_v2 import generate_rooms_v2

_log = logging.getLogger(__name__)

RECORD = "rooms.json"
"""The file with the settings of a set, there from its beginning."""

LISTS = ("scannetv2_train.txt", "scannetv2_val.txt")
LISTS_V1 = (*LISTS, "scannetv2_test.txt")


def ensure_rooms(
    output: Path, *, allowed: bool | str = True, usual: str | Path = "", **settings: Any
) -> None:
    """Make the rooms in ``output`` unless a whole set is there, which is then used as it is.

    Args:
        output: the data set.
        allowed: whether rooms may be made; ``auto``: in ``usual``, and elsewhere where some were begun.
        usual: the folder where nobody need ask for them.
        settings: arguments of ``generate_rooms``.

    Raises:
        DataError: a set with other settings was begun there.
        ConfigError: the settings contradict each other, or rooms may not be made there.
    """
    output = Path(output)
    if rooms_are_complete(output):
        recorded = SettingsRecord(output / RECORD).read()
        asked = json.loads(json.dumps(settings))
        different = [
            f"{name}={recorded[name]}" for name in asked if name in recorded and recorded[name] != asked[name]
        ]
        if different:
            _log.warning("using the rooms in %s as they are, made with %s", output, " ".join(different))
        return
    count = settings["num_train"] + settings["num_val"]
    _begin(output, allowed, Path(usual), count)
    generate_rooms(output, **settings)


def ensure_rooms_v1(
    output: Path,
    *,
    num_train: int,
    num_val: int,
    num_test: int,
    processes: int = 0,
    progress: bool = True,
    allowed: bool | str = True,
    usual: str | Path = "",
) -> None:
    """Make rooms-v1 in ``output`` unless at least as many rooms are there, which are then used as they are.

    Args:
        output: the data set.
        num_train: training rooms.
        num_val: validation rooms.
        num_test: test rooms.
        processes: worker processes, 0 for one per core.
        progress: show a progress bar.
        allowed: as of ``ensure_rooms``.
        usual: as of ``ensure_rooms``.

    Raises:
        DataError: other rooms are there.
        ConfigError: a number is too large, or rooms may not be made there.
    """
    output = Path(output)
    asked = (num_train, num_val, num_test)
    if rooms_are_complete(output, LISTS_V1) and _enough(output, LISTS_V1, asked):
        return
    _begin(output, allowed, Path(usual), sum(asked))
    generate_rooms_v1(
        output,
        num_train=num_train,
        num_val=num_val,
        num_test=num_test,
        processes=processes,
        progress=progress,
    )


def ensure_rooms_v2(
    output: Path,
    *,
    num_train: int,
    num_val: int,
    cads: Path | None = None,
    processes: int = 0,
    progress: bool = True,
    allowed: bool | str = True,
    usual: str | Path = "",
) -> None:
    """Make rooms-v2 in ``output`` unless at least as many rooms are there, which are then used as they are.

    Args:
        output: the data set.
        num_train: training rooms.
        num_val: validation rooms.
        cads: furniture beside the generated one, see ``generate_rooms_v2``.
        processes: worker processes, 0 for one per core.
        progress: show a progress bar.
        allowed: as of ``ensure_rooms``.
        usual: as of ``ensure_rooms``.

    Raises:
        DataError: other rooms are there.
        ConfigError: a number is too large, or rooms may not be made there.
    """
    output = Path(output)
    asked = (num_train, num_val)
    if rooms_are_complete(output, LISTS) and _enough(output, LISTS, asked):
        return
    _begin(output, allowed, Path(usual), sum(asked))
    generate_rooms_v2(
        output, num_train=num_train, num_val=num_val, cads=cads, processes=processes, progress=progress
    )


def _begin(output: Path, allowed: bool | str, usual: Path, count: int) -> None:
    """Say that rooms are made in ``output``, if they may be: a mistyped path would cost half an hour.

    Raises:
        ConfigError: they may not, or ``allowed`` is no such choice.
    """
    if not isinstance(allowed, bool) and allowed != "auto":
        raise ConfigError(f"unknown rooms.make={allowed}: choose auto, true or false")
    begun = (output / RECORD).exists() or output.resolve() == usual.resolve()
    if not (allowed is True or (allowed == "auto" and begun)):
        others = [path.name for path in output.parent.glob("*") if (path / RECORD).is_file()]
        meant = get_close_matches(output.name, others, n=1)
        question = f"is {output.with_name(meant[0])} meant? " if meant else ""
        raise ConfigError(
            f"there are no rooms in data.root={output}: {question}rooms.make=true makes {count} of them there"
        )
    _log.info("making %d rooms in %s (first use; an interrupted set is completed)", count, output.resolve())


def rooms_are_complete(output: Path, lists: Sequence[str] = LISTS) -> bool:
    """Say whether ``output`` holds a whole set of rooms: the lists, written last, and every scan in them."""
    if not all((output / name).is_file() for name in (RECORD, *(f"scannet/{name}" for name in lists))):
        return False
    return all(
        (output / "scannet" / "scans" / scan).is_dir() for name in lists for scan in _scans(output, name)
    )


def _enough(output: Path, lists: Sequence[str], asked: Sequence[int]) -> bool:
    """Say whether each list names at least as many scans as asked."""
    return all(len(_scans(output, name)) >= count for name, count in zip(lists, asked, strict=True))


def _scans(output: Path, name: str) -> list[str]:
    return read_names(output / "scannet" / name)
