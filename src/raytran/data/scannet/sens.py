# SPDX-License-Identifier: Apache-2.0
"""ScanNet's ``.sens`` recordings (version 4): frames found by seeking, decoded one at a time."""

from __future__ import annotations

import logging
import os
import struct
import zlib
from functools import cached_property
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np
from numpy.typing import NDArray

from raytran.data.images import decode_image, resize
from raytran.errors import DataError
from raytran.limits import MAX_SIDE

_log = logging.getLogger(__name__)

_VERSION = 4
_COLOR = {0: "raw", 1: "png", 2: "jpeg"}
_DEPTH = {0: "raw", 1: "zlib", 2: "occi"}
_FRAME_HEADER = struct.Struct("<64s4Q")
_CALIBRATION = struct.Struct("<64f2i4IfQ")

_MAX_NAME = 4096
_MAX_FRAMES = 1_000_000
"""Ten hours of video; an index of so many frames takes 88 MB."""
_MAX_BYTES_PER_PIXEL = 8
"""No JPEG, PNG or zlib stream of a real frame has more; a larger one is damaged and is never read."""


class SensFile:
    """A recording, open for reading; close it, or use it in a ``with`` statement.

    Opening reads the header; the first use of a frame hops over all of them, reading the 96 bytes before
    each, so memory stays small however long the recording is. A file that ends early gives the frames before
    the cut. The IMU block at the end is not read and may be missing.

    Args:
        path: a ``.sens`` file.

    Attributes:
        path: as given.
        num_stated: number of frames that the header promises; ``len()`` is the number that is there.
        color_compression: ``"raw"``, ``"png"`` or ``"jpeg"``.
        depth_compression: ``"raw"``, ``"zlib"`` or ``"occi"``.
        color_size: ``(H, W)``.
        depth_size: ``(H, W)`` of the depth maps.
        depth_shift: depth units in a metre.
        color_intrinsics: ``(4, 4)`` float64, pixels.
        depth_intrinsics: ``(4, 4)`` float64, pixels.

    Raises:
        DataError: the file is missing, is no ``.sens`` of version 4, or its header is cut or absurd.
    """

    def __init__(self, path: Path) -> None:
        self.path = Path(path)
        try:
            self._file = self.path.open("rb", buffering=0)
        except OSError as error:
            raise DataError(f"cannot open {self.path} ({error.strerror}): check the path") from error
        try:
            self._size = os.fstat(self._file.fileno()).st_size
            self._first_frame = self._read_header()
        except BaseException:
            self._file.close()
            raise

    def __len__(self) -> int:
        return len(self.world_from_camera)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the file; what was read of it stays."""
        self._file.close()

    @property
    def world_from_camera(self) -> NDArray[np.float64]:
        """``(n, 4, 4)``, metres; not finite where tracking was lost.

        Raises:
            DataError: there are more than a million frames.
        """
        return self._index[0]

    @property
    def num_frames_at_most(self) -> int:
        """Number of frames by the header and the file's size, known before any frame is visited."""
        return min(self.num_stated, (self._size - self._first_frame) // _FRAME_HEADER.size)

    @property
    def num_color_bytes(self) -> NDArray[np.uint64]:
        """``(n,)`` bytes of each frame's colour, 0 where it has none."""
        return self._index[1][:, 1]

    @property
    def damage(self) -> str | None:
        """A sentence about a file that ends early, or None."""
        if len(self) == self.num_stated:
            return None
        return (
            f"{self.path} ends after {len(self)} of the {self.num_stated} frames that its header promises: "
            "copy it again, or go on with these"
        )

    def color_bytes(self, index: int) -> bytes | None:
        """Return frame ``index`` as stored if that is a JPEG or PNG, else None.

        Raises:
            DataError: the frame has no colour, or claims more bytes than an image can have.
        """
        return None if self.color_compression == "raw" else self._color_blob(index)

    def read_color(self, index: int, image_size: tuple[int, int] | None = None) -> NDArray[np.uint8]:
        """Return ``(H, W, 3)`` RGB, resized to ``image_size`` if given.

        Raises:
            DataError: the frame is damaged or of another size than the header states.
        """
        blob = self._color_blob(index)
        if self.color_compression == "raw":
            pixels = np.frombuffer(blob, np.uint8).reshape(*self.color_size, 3)
            return pixels.copy() if image_size in (None, self.color_size) else resize(pixels, image_size)
        image = decode_image(
            blob, name=f"frame {index} of {self.path}", image_size=image_size, stored=self.color_size
        )
        return image.permute(1, 2, 0).numpy()

    def read_depth(self, index: int) -> NDArray[np.uint16] | None:
        """Return ``(H, W)`` depth along z in units of 1 / ``depth_shift`` metres, 0 where unknown.

        Returns:
            The map, or None if the frame has none.

        Raises:
            DataError: the map is damaged, or packed with Occipital's closed codec.
        """
        start, num_color, num_depth = (int(value) for value in self._index[1][index])
        if num_depth == 0:
            return None
        height, width = self.depth_size
        wanted = height * width * 2
        if self.depth_compression == "occi":
            raise DataError(
                f"the depth in {self.path} is packed with Occipital's closed codec: export the scan with "
                "ScanNet's own tool, or do without depth"
            )
        if not 0 < self.depth_shift < np.inf:
            raise DataError(f"{self.path} states {self.depth_shift} depth units in a metre: copy it again")
        blob = self._blob(index, "depth", start + num_color, num_depth, height * width)
        try:
            pixels = (
                zlib.decompressobj().decompress(blob, wanted + 1)
                if self.depth_compression == "zlib"
                else blob
            )
        except zlib.error as error:
            raise DataError(
                f"the depth of frame {index} of {self.path} is damaged ({error}): copy it again"
            ) from error
        if len(pixels) != wanted:
            raise DataError(
                f"the depth of frame {index} of {self.path} is not {width}x{height}: copy the file again"
            )
        return np.frombuffer(pixels, "<u2").astype(np.uint16, copy=False).reshape(height, width)

    def _color_blob(self, index: int) -> bytes:
        start, num_bytes = (int(value) for value in self._index[1][index][:2])
        pixels = self.color_size[0] * self.color_size[1]
        if num_bytes == 0 or (self.color_compression == "raw" and num_bytes != pixels * 3):
            raise DataError(
                f"frame {index} of {self.path} has {num_bytes} bytes of {self.color_compression} colour for "
                f"{self.color_size[1]}x{self.color_size[0]} pixels: copy the file again"
            )
        return self._blob(index, "colour", start, num_bytes, pixels)

    def _blob(self, index: int, what: str, start: int, num_bytes: int, pixels: int) -> bytes:
        if num_bytes > pixels * _MAX_BYTES_PER_PIXEL + 65536:
            raise DataError(
                f"frame {index} of {self.path} claims {num_bytes} bytes of {what}, more than an image can "
                "have: copy the file again"
            )
        blob = self._read_at(start, num_bytes)
        if len(blob) < num_bytes:
            raise DataError(f"{self.path} became shorter while it was read: copy it again")
        return blob

    def _read_at(self, offset: int, num_bytes: int) -> bytes:
        try:
            self._file.seek(offset)
            # An unbuffered file may return less than was asked for.
            pieces, missing = [], num_bytes
            while missing and (piece := self._file.read(missing)):
                pieces.append(piece)
                missing -= len(piece)
        except OSError as error:
            raise DataError(f"cannot read {self.path} ({error.strerror}): copy it again") from error
        return b"".join(pieces)

    def _read_header(self) -> int:
        """Read what comes before the frames and return the offset of the first."""
        start = self._read_at(0, 12)
        version, name_bytes = struct.unpack("<IQ", start) if len(start) == 12 else (None, 0)
        if version != _VERSION or name_bytes > _MAX_NAME:
            raise DataError(
                f"{self.path} is no .sens recording of version {_VERSION}: download it again, or give a "
                "folder of exported frames"
            )
        raw = self._read_at(12 + name_bytes, _CALIBRATION.size)
        if len(raw) < _CALIBRATION.size:
            raise DataError(f"{self.path} ends within its header: copy it again")
        *matrices, color, depth, width, height, depth_width, depth_height, shift, stated = (
            _CALIBRATION.unpack(raw)
        )
        if color not in _COLOR or depth not in _DEPTH:
            raise DataError(
                f"{self.path} has colour of kind {color} and depth of kind {depth}, which no reader knows: "
                "download it again"
            )
        if not (
            0 < width <= MAX_SIDE and 0 < height <= MAX_SIDE and max(depth_width, depth_height) <= MAX_SIDE
        ):
            raise DataError(
                f"{self.path} claims frames of {width}x{height} and depth of {depth_width}x{depth_height}: "
                "its header is damaged, copy it again"
            )
        self.color_compression, self.depth_compression = _COLOR[color], _DEPTH[depth]
        self.color_size, self.depth_size = (height, width), (depth_height, depth_width)
        self.depth_shift, self.num_stated = float(shift), int(stated)
        calibration = np.array(matrices, dtype=np.float64).reshape(4, 4, 4)
        self.color_intrinsics, color_extrinsic, self.depth_intrinsics, _ = calibration
        if not np.allclose(color_extrinsic, np.eye(4), atol=1e-3):
            _log.warning(
                "%s: poses are taken as the colour camera's though its colour extrinsic is not the identity",
                self.path,
            )
        return 12 + int(name_bytes) + _CALIBRATION.size

    @cached_property
    def _index(self) -> tuple[NDArray[np.float64], NDArray[np.uint64]]:
        """Read the header of every whole frame; return poses, and where data start and how long they are.

        Returns:
            ``(n, 4, 4)`` poses and ``(n, 3)``: offset of the colour, bytes of colour, bytes of depth.
        """
        offset = self._first_frame
        poses, extents = bytearray(), bytearray()
        for count in range(self.num_stated):
            raw = self._read_at(offset, _FRAME_HEADER.size)
            if len(raw) < _FRAME_HEADER.size:
                break
            pose, _, _, num_color, num_depth = _FRAME_HEADER.unpack(raw)
            start = offset + _FRAME_HEADER.size
            offset = start + num_color + num_depth
            if offset > self._size:
                break
            if count == _MAX_FRAMES:
                raise DataError(f"{self.path} has more than {_MAX_FRAMES} frames: no scan is that long")
            poses += pose
            extents += struct.pack("=3Q", start, num_color, num_depth)
        table = np.frombuffer(extents, "=u8").reshape(-1, 3)
        # In a damaged file a pose may be a signalling NaN, which the conversion would warn of.
        with np.errstate(invalid="ignore"):
            return np.frombuffer(poses, "<f4").reshape(-1, 4, 4).astype(np.float64), table
