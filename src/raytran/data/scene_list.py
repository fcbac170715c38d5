# SPDX-License-Identifier: Apache-2.0
"""Which scenes a data set has, and what of them stays in memory: objects of all, cameras of the latest."""

from __future__ import annotations

import logging
import pickle
from collections import Counter, OrderedDict
from collections.abc import Mapping, Sequence
from itertools import accumulate
from pathlib import Path

import torch

from raytran.classes import Classes
from raytran.data.scan2cad import SceneAnnotation, scene_objects
from raytran.data.scannet.scan import Scan, read_scan
from raytran.data.text import read_names
from raytran.errors import DataError
from raytran.limits import shown
from raytran.structs import ObjectSet

_log = logging.getLogger(__name__)

_SHOWN = 5
"""Categories that are named of those that belong to no class."""


def choose_scenes(
    scans_root: Path,
    wanted: Sequence[str] | None,
    annotations: Mapping[str, SceneAnnotation] | None,
) -> tuple[str, ...]:
    """Return the scans to take.

    Args:
        scans_root: folder of the scans.
        wanted: names of scans; if None all that are there and, if there are annotations, have objects.
        annotations: of the scans; None if there are none at all.

    Raises:
        DataError: a scan or the folder is missing, or no scan is left.
    """
    if not scans_root.is_dir():
        raise DataError(f"there is no folder {scans_root}: prepare the data set or mend its path")
    present = {p.name for p in scans_root.iterdir() if p.is_dir() and not p.name.startswith(".")}
    if wanted is None:
        wanted = sorted(present if annotations is None else present & set(annotated(annotations)))
        if not wanted:
            which = "with objects in the annotation" if annotations is not None else "at all"
            raise DataError(f"no scene {which} lies in {scans_root}: check that the paths belong together")
    missing = [scene_id for scene_id in wanted if scene_id not in present]
    if missing:
        raise DataError(
            f"{len(missing)} of {len(wanted)} scans are not in {scans_root}, the first is {missing[0]}: "
            "add them or take them from the list"
        )
    return tuple(wanted)


def annotated(annotations: Mapping[str, SceneAnnotation]) -> list[str]:
    """Return the scenes that have at least one model."""
    return [scene_id for scene_id, annotation in annotations.items() if annotation.model_id]


def read_split(scannet: Path, split: str) -> list[str] | None:
    """Return the scans of ``scannetv2_<split>.txt``, or None if there are no split files at all.

    Raises:
        DataError: there are others, but not this one; or it cannot be read.
    """
    path = scannet / f"scannetv2_{split}.txt"
    if path.is_file():
        return read_names(path)
    if any(scannet.glob("scannetv2_*.txt")):
        raise DataError(f"there is no {path}: choose a split that has a file, or write its scans there")
    return None


def annotated_objects(
    annotations: Mapping[str, SceneAnnotation] | None, scene_ids: Sequence[str], classes: Classes
) -> list[ObjectSet]:
    """Return the objects of each scene; those of no class are left out, and counted in the log.

    Args:
        annotations: of the scenes; None if there are none at all.
        scene_ids: the scenes; those without annotation have no objects.
        classes: of the objects.

    Raises:
        DataError: there are objects, and all of them are of no class.
    """
    found = {} if annotations is None else annotations
    scenes = [found.get(scene_id) for scene_id in scene_ids]
    categories = Counter(
        name.split("/")[0] for scene in scenes if scene is not None for name in scene.model_id
    )
    unknown = {
        category: count for category, count in categories.items() if classes.label_of(category) is None
    }
    if unknown:
        few = ", ".join(map(shown, list(unknown)[:_SHOWN])) + (", …" if len(unknown) > _SHOWN else "")
        if len(unknown) == len(categories):
            raise DataError(
                f"none of the {categories.total()} annotated objects, of categories {few}, is of one of the "
                f"classes ({classes}): name those of the data in classes.names or classes.catids"
            )
        _log.warning(
            "%d of %d annotated objects belong to no class and are left out, of categories %s",
            *(sum(unknown.values()), categories.total(), few),
        )
    return [ObjectSet.empty(classes) if scene is None else scene_objects(scene, classes) for scene in scenes]


class ObjectTable:
    """The objects of many scenes in six tensors.

    A tensor costs a file handle in each worker process that is not forked, so thousands of small tensors
    could not be sent to one.

    Args:
        scenes: objects without shapes.
    """

    def __init__(self, scenes: Sequence[ObjectSet]) -> None:
        self._all = ObjectSet.join(list(scenes) or [ObjectSet.empty()])
        self._ends = (0, *accumulate(map(len, scenes)))

    def __len__(self) -> int:
        return len(self._ends) - 1

    def __getitem__(self, index: int) -> ObjectSet:
        """Return the objects of one scene, copied."""
        return self._all.select(torch.arange(self._ends[index], self._ends[index + 1]))


class RecentScans:
    """Scans by name; the most recently used stay in memory, packed into about 0.2 kB a frame.

    A copy for another process starts empty.

    Args:
        scans_root: folder of the scans.
        max_bytes: most memory of all scans together.
    """

    def __init__(self, scans_root: Path, max_bytes: int) -> None:
        self._scans_root, self._max_bytes = scans_root, max_bytes
        self._packed: OrderedDict[str, bytes] = OrderedDict()
        self._bytes = 0

    def __getitem__(self, scene_id: str) -> Scan:
        """Return a scan.

        Raises:
            DataError: see ``read_scan``.
        """
        if scene_id in self._packed:
            self._packed.move_to_end(scene_id)
            unpacked: Scan = pickle.loads(self._packed[scene_id])
            return unpacked
        scan = read_scan(self._scans_root / scene_id)
        self._packed[scene_id] = pickle.dumps(scan)
        self._bytes += len(self._packed[scene_id])
        while self._bytes > self._max_bytes:
            self._bytes -= len(self._packed.popitem(last=False)[1])
        return scan

    def __len__(self) -> int:
        """Return the number of scans in memory."""
        return len(self._packed)

    def __reduce__(self) -> tuple[type[RecentScans], tuple[Path, int]]:
        return RecentScans, (self._scans_root, self._max_bytes)
