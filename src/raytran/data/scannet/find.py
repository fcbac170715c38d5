# SPDX-License-Identifier: Apache-2.0
"""Finds scans and split files below a ScanNet root, however it is nested."""

from __future__ import annotations

import logging
import re
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from raytran.data.scan import OpenScan
from raytran.data.scannet.layout import FORMS, INNER_FOLDERS, WANTED, Listing, find_layout, recognise
from raytran.data.scannet.scan import read_scan, read_sens
from raytran.data.scannet.sens import SensFile
from raytran.data.text import read_names
from raytran.errors import DataError

_log = logging.getLogger(__name__)

SOURCE_FORMS: tuple[str, ...] = ("sens", *FORMS)
"""Forms of a scan, in the order of preference."""

SPLITS: tuple[str, ...] = ("train", "val", "test")

_MAX_DEPTH = 5
_SCENE_NAME = re.compile(r"scene\d{4}_\d{2}")
_SPLIT_FOLDERS = (".", "splits", "meta_data", "Tasks/Benchmark", "tasks/benchmark", "ScanNet/Tasks/Benchmark")
"""Where people, mmdetection3d and ScanNet's own repository keep split files."""


@dataclass(frozen=True)
class ScanSource:
    """A folder or file from which a scan can be read.

    Attributes:
        scene_id: name of the scan.
        form: one of ``SOURCE_FORMS``.
        path: the scan's folder, or its ``.sens`` file.
        header: its ``<scan>.txt``, which may lie elsewhere below the root; None if there is none.
    """

    scene_id: str
    form: str
    path: Path
    header: Path | None = None

    def open(self, *, any_size: bool = False) -> OpenScan:
        """Read the cameras; images are read frame by frame.

        Args:
            any_size: whether intrinsics may be for another image size; see ``read_scan``.

        Raises:
            DataError: the scan is damaged or incomplete; see ``read_scan`` and ``read_sens``.
        """
        if self.form == "sens":
            return read_sens(self.path, scene_id=self.scene_id, header=self.header, any_size=any_size)
        scan = read_scan(self.path, header=self.header, any_size=any_size)
        return replace(scan, scene_id=self.scene_id)

    @property
    def num_frames(self) -> int:
        """Number of frames, lost ones among them, without reading more than a header or a list of files.

        Raises:
            DataError: the file is no recording, or the folder has no images.
        """
        if self.form == "sens":
            with SensFile(self.path) as file:
                return file.num_frames_at_most
        return find_layout(self.path).num_images()


def find_scans(root: Path) -> dict[str, tuple[ScanSource, ...]]:
    """Find every scan below a folder, in every form.

    The folder may be a single scan, a folder of scans, ``scannet`` with ``scans/``, ``scans_test/``,
    ``posed_images/`` or ``tasks/scannet_frames_25k/`` in it, or the parent of ``scannet``; a ``.sens`` file
    will do too. Files in a scan are not opened.

    Args:
        root: where to look, to a depth of five folders.

    Returns:
        The sources of each scan, in the order of the scans' names; of several, the best first: recordings,
        then exports of whole scans, then every 100th frame.

    Raises:
        DataError: there is no such folder, or no scan in it.
    """
    root = Path(root)
    if root.is_file() and root.suffix == ".sens":
        return {root.stem: (ScanSource(root.stem, "sens", root),)}
    if not root.is_dir():
        raise DataError(f"there is no folder {root}: check the path of ScanNet")
    walk = _Walk()
    every_source = list(walk.scans(root / "scannet" if (root / "scannet").is_dir() else root))
    if not every_source:
        raise DataError(f"{root} holds {Listing.of(root).summary()}, so no scans that can be read: {WANTED}")
    by_scan: defaultdict[str, list[ScanSource]] = defaultdict(list)
    for source in every_source:
        by_scan[source.scene_id].append(
            replace(source, header=source.header or walk.headers.get(source.scene_id))
        )
    return {
        scene_id: tuple(sorted(sources, key=lambda s: (SOURCE_FORMS.index(s.form), str(s.path))))
        for scene_id, sources in sorted(by_scan.items())
    }


def read_splits(root: Path) -> dict[str, list[str]]:
    """Read ScanNet's ``scannetv2_{train,val,test}.txt``, one scan a line, below or beside a ScanNet root.

    Args:
        root: as for ``find_scans``.

    Returns:
        The scans of each split that has a file, each scan once; empty if there is no file.

    Raises:
        DataError: a file cannot be read, or a scan is in two splits.
    """
    root = Path(root).resolve()
    bases = (root / "scannet", root, *root.parents[:2])
    splits: dict[str, list[str]] = {}
    for split in SPLITS:
        candidates = (base / folder / f"scannetv2_{split}.txt" for base in bases for folder in _SPLIT_FOLDERS)
        path = next((path for path in candidates if path.is_file()), None)
        if path is None:
            continue
        names = list(dict.fromkeys(read_names(path)))
        for other, taken in splits.items():
            both = sorted(set(names) & set(taken))
            if both:
                raise DataError(
                    f"{len(both)} scans, the first is {both[0]}, are in the {other} split and in {path}: "
                    "take them out of one"
                )
        splits[split] = names
    return splits


class _Walk:
    """Goes through the folders below a root, each once, and notes where ``<scan>.txt`` files lie."""

    def __init__(self) -> None:
        self.headers: dict[str, Path] = {}
        self._seen: set[tuple[int, int]] = set()

    def scans(self, folder: Path, depth: int = 0) -> Iterator[ScanSource]:
        """Yield the sources in a folder; the inside of a scan is not searched."""
        try:
            listing = Listing.of(folder)
            layout = recognise(listing)
            entry = folder.stat()
        except (DataError, OSError) as error:
            _log.warning("skipped a folder: %s", error)
            return
        scene_id = _scene_id(folder)
        header = folder / f"{scene_id}.txt" if f"{scene_id}.txt" in listing.files else None
        if header is not None:
            self.headers.setdefault(scene_id, header)
        recordings = sorted(name.removesuffix(".sens") for name in listing.files if name.endswith(".sens"))
        for name in recordings:
            beside = folder / f"{name}.txt" if f"{name}.txt" in listing.files else None
            yield ScanSource(name, "sens", folder / f"{name}.sens", beside)
        if layout is not None:
            yield ScanSource(scene_id, layout.form, folder, header)
        is_scan = layout is not None or scene_id in recordings
        # A link may lead back up. A scan is a leaf, so two links to one scan are two scans.
        if is_scan or depth == _MAX_DEPTH or (entry.st_dev, entry.st_ino) in self._seen:
            return
        self._seen.add((entry.st_dev, entry.st_ino))
        for name in sorted(listing.folders):
            yield from self.scans(folder / name, depth + 1)


def _scene_id(folder: Path) -> str:
    """Return the scan that a folder belongs to: its own name, or that of the scan whose frames it holds."""
    if _SCENE_NAME.fullmatch(folder.name):
        return folder.name
    inside = folder.name in INNER_FOLDERS or _SCENE_NAME.fullmatch(folder.parent.name)
    return folder.parent.name if inside else folder.name
