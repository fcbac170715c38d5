# SPDX-License-Identifier: Apache-2.0
"""Which folders of results there are, and which of their files a page may have."""

from __future__ import annotations

import os
from pathlib import Path

from raytran.errors import DataError

SCENE = "scene.json"

MOST_SCENES = 1000
"""Scenes that a page offers; of more, the first by name."""

_DEPTH = 3
"""Folders below the one given that are looked into."""

_SHOWN = (SCENE, "scene.glb")
_SHOWN_BELOW = "view"


def find_scenes(folder: Path) -> dict[str, Path]:
    """Return the results in a folder, by the name to call each.

    Args:
        folder: one result of ``raytran.predict``, or a folder with results in it or a little below.

    Raises:
        DataError: the folder is missing or holds none.
    """
    if not folder.is_dir():
        raise DataError(f"no folder {folder}: give the output folder of `python -m raytran.predict`")
    folder = folder.resolve()
    if (folder / SCENE).is_file():
        return {folder.name: folder}
    found: dict[str, Path] = {}
    for where, below, files in os.walk(folder):
        path = Path(where)
        if SCENE in files:
            found[path.relative_to(folder).as_posix()] = path
        finished = SCENE in files or len(path.relative_to(folder).parts) >= _DEPTH
        below[:] = [] if finished else sorted(name for name in below if not name.startswith("."))
    if not found:
        raise DataError(
            f"{folder} holds no {SCENE}: give the output folder of `python -m raytran.predict`, "
            "or one with such folders in it"
        )
    return dict(sorted(found.items())[:MOST_SCENES])


def shown_file(scene: Path, name: str) -> Path | None:
    """Return a file of a result that a page may have, or None: not there, not for pages, or outside.

    Links are followed before it is decided where a file lies.

    Args:
        scene: a folder of ``find_scenes``.
        name: as asked for, with slashes.
    """
    parts = name.split("/")
    if name not in _SHOWN and (parts[0] != _SHOWN_BELOW or len(parts) < 2):
        return None
    if any(part in ("", ".", "..") or "\\" in part or "\0" in part for part in parts):
        return None
    try:
        path = scene.joinpath(*parts).resolve(strict=True)
        inside = path.is_relative_to(scene.resolve()) and path.is_file()
    except (OSError, ValueError, RuntimeError):
        return None
    return path if inside else None
