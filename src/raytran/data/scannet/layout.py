# SPDX-License-Identifier: Apache-2.0
"""Recognises in which of ScanNet's exported forms a folder is: where its images, poses and intrinsics lie."""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from raytran.data.images import IMAGE_ENDINGS
from raytran.data.scannet.text import INFO_FILES
from raytran.errors import DataError

FORMS: tuple[str, ...] = ("exporter", "cpp", "odam", "mmdetection3d", "frames_25k")
"""Exported forms, in the order of preference.

``exporter``: ScanNet's Python exporter, ``color/<n>.jpg``, ``pose/<n>.txt``, ``intrinsic/``. ``cpp``: its C++
tool, ``frame-<n>.color.jpg``, ``frame-<n>.pose.txt``, ``_info.txt``. ``odam``: the first, inside ``frames/``.
``mmdetection3d``: ``<n>.jpg``, ``<n>.txt``, ``intrinsic.txt``. ``frames_25k``: every 100th frame, ``color/``,
``pose/``, ``intrinsics_color.txt``.
"""

WANTED = (
    "wanted are color/<n>.jpg with pose/<n>.txt and intrinsic/intrinsic_color.txt, frame-<n>.color.jpg with "
    "frame-<n>.pose.txt and _info.txt, <n>.jpg with <n>.txt and intrinsic.txt, or a .sens file"
)

INNER_FOLDERS = ("frames", "sequence", "sensor_data", "exported", "data")
"""Names of folders inside a scan that hold its frames."""

_INTRINSICS = (
    "intrinsic/intrinsic_color.txt",
    "intrinsics/intrinsic_color.txt",
    "intrinsics_color.txt",
    "intrinsic_color.txt",
    "intrinsic.txt",
    "intrinsics.txt",
    "camera-intrinsics.txt",
    *INFO_FILES,
)
"""Files of intrinsics: ScanNet's tools write the first and the last, users of 7-Scenes and the demo of TSDF
fusion the others."""

FRAME_CAMERAS = "intrinsic/frames.txt"
"""File with a camera for each frame, which preparation writes where lenses or pictures differ."""

_DEPTH_INTRINSICS = ("intrinsic/intrinsic_depth.txt", "intrinsics/intrinsic_depth.txt", "intrinsic_depth.txt")

_IMAGE_ENDINGS = IMAGE_ENDINGS[::-1]
"""Where a frame comes in several, the last one counts."""
_CPP_FRAME = re.compile(r"frame-(\d+)\.(color|pose)\.(\w+)")
_FLAT_FRAME = re.compile(r"(\d+)\.(\w+)")


@dataclass(frozen=True)
class Listing:
    """Names of the folders and files in a folder; hidden ones are left out."""

    path: Path
    folders: frozenset[str]
    files: frozenset[str]

    @classmethod
    def of(cls, path: Path) -> Listing:
        """Read a folder.

        Raises:
            DataError: it cannot be read.
        """
        folders: set[str] = set()
        files: set[str] = set()
        try:
            with os.scandir(path) as entries:
                for entry in entries:
                    if not entry.name.startswith("."):
                        (folders if entry.is_dir() else files).add(entry.name)
        except OSError as error:
            raise DataError(f"cannot read the folder {path} ({error.strerror}): check the path") from error
        return cls(path, frozenset(folders), frozenset(files))

    def summary(self, *, most: int = 6) -> str:
        """Return what the folder holds, in a few words: ``most`` of its folders, and of its files' kinds."""
        endings = Counter(Path(name).suffix or "without ending" for name in self.files)
        contents = [f"the folder {name}" for name in sorted(self.folders)[:most]]
        contents += ["more folders"] if len(self.folders) > most else []
        contents += [f"{count} files {ending}" for ending, count in endings.most_common(min(most, 4))]
        return ", ".join(contents) or "nothing"


@dataclass(frozen=True)
class Layout:
    """Where the parts of an exported scan lie.

    Attributes:
        form: one of ``FORMS``.
        scan: the scan's folder.
        base: the folder of the frames: the scan's, or one inside it.
    """

    form: str
    scan: Path
    base: Path

    def images(self) -> dict[str, Path]:
        """Return the colour image of each frame, by the frame's name."""
        if self.form == "cpp":
            return self._cpp("color", _IMAGE_ENDINGS)
        if self.form == "mmdetection3d":
            files = self._flat(_IMAGE_ENDINGS)
            # Beside the JPEGs, PNGs are depth maps.
            jpegs = {name: path for name, path in files.items() if path.suffix.lower() != ".png"}
            return jpegs or files
        return _by_stem(self.base / "color", _IMAGE_ENDINGS)

    def poses(self) -> dict[str, Path]:
        """Return the pose file of each frame, by the frame's name."""
        if self.form == "cpp":
            return self._cpp("pose", (".txt",))
        return (
            self._flat((".txt",)) if self.form == "mmdetection3d" else _by_stem(self.base / "pose", (".txt",))
        )

    @property
    def is_aligned(self) -> bool:
        """Whether +z is up in the form's worlds.

        ``cpp`` without its file of facts is that of 7-Scenes and of TSDF fusion, whose worlds are those of
        the first camera.
        """
        facts = (folder / name for folder in (self.base, self.scan) for name in INFO_FILES)
        return self.form != "cpp" or any(path.is_file() for path in facts)

    def intrinsics(self) -> Path:
        """Return the first file of intrinsics that is there, or where the exporter would write it.

        The sequences of 7-Scenes may share one that lies above them.
        """
        folders = [self.base, self.scan, *([] if self.is_aligned else [self.scan.absolute().parent])]
        paths = (folder / name for folder in dict.fromkeys(folders) for name in _INTRINSICS)
        return next((path for path in paths if path.is_file()), self.base / _INTRINSICS[0])

    def frame_cameras(self) -> Path | None:
        """Return the file with a camera for each frame, None if all frames have the same."""
        path = self.base / FRAME_CAMERAS
        return path if path.is_file() else None

    def depth_intrinsics(self) -> Path | None:
        """Return the file of the depth camera's intrinsics, None if there is none."""
        paths = (folder / name for folder in (self.base, self.scan) for name in _DEPTH_INTRINSICS)
        return next((path for path in paths if path.is_file()), None)

    def num_images(self) -> int:
        """Return the number of colour images without opening any."""
        return len(self.images())

    def _cpp(self, kind: str, endings: tuple[str, ...]) -> dict[str, Path]:
        """Return the files ``frame-<n>.<kind>.*`` by frame."""
        matches = (_CPP_FRAME.fullmatch(name) for name in Listing.of(self.base).files)
        of_kind = ((m, f".{m[3].lower()}") for m in matches if m and m[2] == kind)
        return _pick(endings, ((m[1], self.base / m.string, ending) for m, ending in of_kind))

    def _flat(self, endings: tuple[str, ...]) -> dict[str, Path]:
        """Return the files ``<n>.*`` by frame."""
        matches = (_FLAT_FRAME.fullmatch(name) for name in Listing.of(self.base).files)
        return _pick(endings, ((m[1], self.base / m.string, f".{m[2].lower()}") for m in matches if m))


def recognise(listing: Listing) -> Layout | None:
    """Return the layout of a scan's folder, or None if it holds no frames.

    Images, poses or intrinsics may be missing: such a folder is recognised too, so that reading it names what
    is missing.
    """
    form = _form(listing)
    if form is not None:
        return Layout(form, listing.path, listing.path)
    for name in INNER_FOLDERS:
        if name in listing.folders:
            inner = Listing.of(listing.path / name)
            form = _form(inner)
            if form is not None:
                return Layout("odam" if form == "exporter" else form, listing.path, inner.path)
    return None


def find_layout(folder: Path) -> Layout:
    """Return the layout of a scan's folder.

    Raises:
        DataError: there is no such folder, or it holds no frames in a known form.
    """
    if not folder.is_dir():
        raise DataError(f"there is no scan folder {folder}: check the path")
    listing = Listing.of(folder)
    layout = recognise(listing)
    if layout is None:
        raise DataError(f"{folder} holds {listing.summary()}, so no frames of a scan: {WANTED}")
    return layout


def _form(listing: Listing) -> str | None:
    if {"color", "pose"} & listing.folders:
        return "frames_25k" if "intrinsics_color.txt" in listing.files else "exporter"
    if any(_CPP_FRAME.fullmatch(name) for name in listing.files):
        return "cpp"
    if "intrinsic.txt" in listing.files and any(
        match[2] == "txt" for match in map(_FLAT_FRAME.fullmatch, listing.files) if match
    ):
        return "mmdetection3d"
    return None


def _by_stem(folder: Path, endings: tuple[str, ...]) -> dict[str, Path]:
    if not folder.is_dir():
        raise DataError(f"{folder.parent} has no folder {folder.name}: {WANTED}")
    paths = (folder / name for name in Listing.of(folder).files)
    return _pick(endings, ((path.stem, path, path.suffix.lower()) for path in paths))


def _pick(endings: tuple[str, ...], files: Iterable[tuple[str, Path, str]]) -> dict[str, Path]:
    """Return the path of each name; if it has several endings, that which comes last in ``endings``."""
    fitting = [(endings.index(ending), name, path) for name, path, ending in files if ending in endings]
    return {name: path for _, name, path in sorted(fitting)}
