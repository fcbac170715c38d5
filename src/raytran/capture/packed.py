# SPDX-License-Identifier: Apache-2.0
"""Packed recordings: ``.r3d`` of Record3D and ``.zip`` of any app, unpacked into a temporary folder.

What an archive claims is not believed: of its members only those are written that a reader has a use for,
under the folder and nowhere else, and not more than an archive of such files can hold.
"""

from __future__ import annotations

import lzma
import os
import struct
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray

from raytran.capture.names import is_hidden
from raytran.capture.video import VIDEO_ENDINGS
from raytran.data.images import IMAGE_ENDINGS
from raytran.data.scan import OpenScan
from raytran.errors import DataError

PACKED_ENDINGS = (".zip", ".r3d")

_WANTED = (
    *(*IMAGE_ENDINGS, *VIDEO_ENDINGS),
    *("", ".json", ".txt", ".csv", ".bin", ".tum", ".traj", ".pincam", ".sens"),
)
"""Endings of the files that are unpacked; depth maps in formats of their own stay packed."""

_MAX_DIRECTORY = 16 * 2**20
"""Bytes of an archive's list of members: some 200,000."""

_MAX_GROWTH = 100
_ALWAYS = 64 * 2**20
_MAX_TOTAL = 64 * 2**30
"""Bounds of the unpacked bytes: times the archive's, and at least and at most so many."""

_CHUNK = 1 << 20
_DAMAGED = (zipfile.BadZipFile, zlib.error, lzma.LZMAError, EOFError, ValueError, RuntimeError, struct.error)
"""What ``zipfile`` raises for archives that are damaged, encrypted or of foreign versions."""


def is_packed(path: Path) -> bool:
    """Whether a file is an archive by its ending."""
    return path.suffix.lower() in PACKED_ENDINGS and os.path.isfile(path)


def unpack(path: Path) -> TemporaryDirectory[str]:
    """Unpack an archive; the files lie in a folder of the archive's name in the one that is returned.

    Raises:
        DataError: it is no archive, is damaged or encrypted, claims more than it can hold, names files
            outside of its folder, or the disk is full.
    """
    folder = TemporaryDirectory(prefix="raytran-")
    try:
        _check_directory(path)
        with zipfile.ZipFile(path) as archive:
            members = [member for member in archive.infolist() if _is_wanted(member)]
            total, packed = sum(member.file_size for member in members), path.stat().st_size
            if total > min(_MAX_TOTAL, max(_ALWAYS, _MAX_GROWTH * packed)):
                raise DataError(
                    f"{path} of {packed / 2**20:.3g} MB claims to hold {total / 2**20:.3g} MB, which no "
                    "recording does: unpack it yourself and give the folder"
                )
            root = Path(folder.name) / (path.stem.strip(". ") or "scene")
            root.mkdir()
            for member in members:
                _write(archive, member, root, path)
    except BaseException as error:
        folder.cleanup()
        if isinstance(error, _DAMAGED) and not isinstance(error, DataError):
            raise DataError(
                f"cannot unpack {path} ({str(error)[:80]}): unpack it yourself and give the folder"
            ) from error
        if isinstance(error, OSError):
            raise DataError(
                f"cannot unpack {path} ({error.strerror or error}): unpack it yourself and give the folder"
            ) from error
        raise
    return folder


@dataclass(frozen=True, kw_only=True)
class UnpackedScan(OpenScan):
    """A scan in a temporary folder, which goes when the scan is closed.

    Attributes:
        archive: file that it was packed in.
        stored: the scan.
        folder: the temporary folder.
    """

    archive: Path
    stored: OpenScan
    folder: TemporaryDirectory[str]

    @property
    def path(self) -> Path:
        """The archive."""
        return self.archive

    def color_bytes(self, index: int) -> bytes | None:
        """See ``OpenScan``."""
        return self.stored.color_bytes(index)

    def read_color(self, index: int, image_size: tuple[int, int] | None = None) -> NDArray[np.uint8]:
        """See ``OpenScan``."""
        return self.stored.read_color(index, image_size)

    def close(self) -> None:
        """Close the scan and remove its files."""
        self.stored.close()
        self.folder.cleanup()


def _check_directory(path: Path) -> None:
    """Raise if an archive's list of members is so long that reading it alone takes much memory."""
    with path.open("rb") as file:
        size = file.seek(0, 2)
        file.seek(max(0, size - 65_557 - 20 - 56))
        tail = file.read()
    end = tail.rfind(b"PK\x05\x06")
    if end < 0 or len(tail) < end + 22:
        raise zipfile.BadZipFile("no zip archive")
    (length,) = struct.unpack_from("<I", tail, end + 12)
    large = tail.rfind(b"PK\x06\x06", 0, end)
    if length == 0xFFFFFFFF and large >= 0:
        (length,) = struct.unpack_from("<Q", tail, large + 40)
    if length > _MAX_DIRECTORY:
        raise zipfile.BadZipFile("its list of files is longer than that of any recording")


def _is_wanted(member: zipfile.ZipInfo) -> bool:
    """Whether a member is a file that a reader may want."""
    name = PurePosixPath(member.filename.replace("\\", "/"))
    return not (member.is_dir() or any(map(is_hidden, name.parts)) or name.suffix.lower() not in _WANTED)


def _write(archive: zipfile.ZipFile, member: zipfile.ZipInfo, root: Path, path: Path) -> None:
    """Write a member below a folder.

    Raises:
        DataError: it does not belong there.
    """
    parts = member.filename.replace("\\", "/").split("/")
    if member.filename.startswith(("/", "\\")) or any(part in ("", "..") or ":" in part for part in parts):
        raise DataError(
            f"{path} names the file {member.filename[-100:]!r}, which is outside of it: unpack it with care "
            "and give the folder"
        )
    if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise zipfile.BadZipFile("packed by another method than deflate")
    target = root.joinpath(*parts)
    target.parent.mkdir(parents=True, exist_ok=True)
    with archive.open(member) as packed, target.open("xb") as file:
        while chunk := packed.read(_CHUNK):
            file.write(chunk)
