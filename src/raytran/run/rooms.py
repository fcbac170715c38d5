# SPDX-License-Identifier: Apache-2.0
"""The embedded default data: rooms that are made when training or evaluation first asks for them."""

from __future__ import annotations

import json
import logging
from pathlib import Path
from typing import Any

from raytran.data.rooms.generate import generate_rooms

_log = logging.getLogger(__name__)

LISTS = ("scannetv2_train.txt", "scannetv2_val.txt")


def ensure_rooms(output: Path, **settings: Any) -> None:
    """Make the rooms in ``output`` unless a whole set is there, which is then used as it is.

    Args:
        output: the data set.
        settings: arguments of ``generate_rooms``.

    Raises:
        DataError: a set with other settings was begun there.
        ConfigError: the settings contradict each other.
    """
    output = Path(output)
    if rooms_are_complete(output):
        found = json.loads((output / "rooms.json").read_text(encoding="utf-8"))
        asked = json.loads(json.dumps(settings))
        other = [f"{name}={found[name]}" for name in asked if name in found and found[name] != asked[name]]
        if other:
            _log.warning("using the rooms in %s as they are, made with %s", output, " ".join(other))
        return
    count = settings["num_train"] + settings["num_val"]
    _log.info("making %d rooms in %s (first use; an interrupted set is completed)", count, output.resolve())
    generate_rooms(output, **settings)


def rooms_are_complete(output: Path) -> bool:
    """Say whether ``output`` holds a whole set of rooms: the lists, written last, and every scan in them."""
    scannet = output / "scannet"
    lists = [scannet / name for name in LISTS]
    if not (output / "rooms.json").is_file() or not all(path.is_file() for path in lists):
        return False
    scans = [scan for path in lists for scan in path.read_text(encoding="utf-8").split()]
    return all((scannet / "scans" / scan).is_dir() for scan in scans)
