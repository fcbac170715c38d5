# SPDX-License-Identifier: Apache-2.0
"""Opens image files, and reads and resizes the images of a scan, some of which may be damaged."""

from __future__ import annotations

import importlib
import logging
import math
import struct
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cache
from io import BytesIO
from pathlib import Path
from typing import BinaryIO

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError
from torch import Tensor

from raytran.errors import ConfigError, DataError
from raytran.limits import MAX_SIDE

_log = logging.getLogger(__name__)

MIN_VIEWS = 2
"""Fewest different frames from which a scene is reconstructed."""

FILL = (124, 116, 104)
"""Red, green and blue around a picture of another shape: ImageNet's mean, which encoders take for zero."""

_SAME_ASPECT = 0.01
"""Relative difference up to which two images have the same aspect: one row or column of a hundred."""

_ROUNDING = 1e-6

IMAGE_ENDINGS = (".jpg", ".jpeg", ".png", ".webp", ".tif", ".tiff", ".bmp", ".heic", ".heif")
"""Endings of the names of images, the ones to prefer first. What a file is, its first bytes say."""

IMAGE_KINDS = ("JPEG", "PNG", "WEBP", "TIFF", "BMP", "HEIF")
"""Kinds of files that are decoded, by Pillow's names for their decoders. No other decoder sees a byte of a
stranger's file: Pillow has some fifty, one of which starts Ghostscript."""

UNREADABLE = (
    *(OSError, SyntaxError, ValueError, TypeError, LookupError, EOFError, ArithmeticError, RuntimeError),
    *(AttributeError, struct.error, Image.DecompressionBombError),
)
"""What Pillow raises for files that are truncated, damaged, absurdly large or no images."""

_SIGNATURES: tuple[tuple[str, int, tuple[bytes, ...]], ...] = (
    ("JPEG", 0, (b"\xff\xd8\xff",)),
    ("PNG", 0, (b"\x89PNG\r\n\x1a\n",)),
    ("WEBP", 8, (b"WEBP",)),
    ("TIFF", 0, (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")),
    ("BMP", 0, (b"BM",)),
    ("HEIF", 4, tuple(b"ftyp" + brand for brand in (b"heic", b"heix", b"heim", b"heis", b"mif1", b"msf1"))),
    ("PPM", 0, (b"P5",)),
)
"""Kind, offset and bytes by which files are told apart; ``PPM`` is the grey PGM of some depth maps."""

_ORIENTATION_TAG = 0x0112
_WHITE_16 = 65535
_BITS = (8, 10, 12, 14, 16)
_LOOKED_AT = 24

_SIDE_OF_UP = {1: 0, 2: 0, 3: 2, 4: 2, 5: 3, 6: 3, 7: 1, 8: 1}
"""EXIF orientation → side of the stored picture that is up: top, right, bottom or left; as many quarter turns
counter-clockwise show it upright. The even ones up to 4, and 5 and 7, are mirrored besides."""

_MIRRORED = {2: 1, 4: 3, 5: 8, 7: 6}
"""EXIF orientation of a mirrored picture → the one that is left after it was mirrored left to right."""


@contextmanager
def open_image(image: Path | bytes, *, kinds: Sequence[str] = IMAGE_KINDS) -> Iterator[Image.Image]:
    """Open an image by the decoder that its first bytes name, if that is one of ``kinds``.

    This is the one place where files reach Pillow.

    Args:
        image: path or content of a file.
        kinds: Pillow's names of the decoders that may read it.

    Raises:
        OSError and others of ``UNREADABLE``: it cannot be read, or is of another kind.
        ConfigError: it is a HEIC, and pillow-heif is not installed.
    """
    with _stream(image) as stream:
        start = stream.read(16)
        kind = next((k for k, at, known in _SIGNATURES if start[at:].startswith(known)), None)
        if kind is None or kind not in kinds:
            wanted = ", ".join(name for name in kinds if name != "HEIF")
            raise UnidentifiedImageError(f"its first bytes are those of no {wanted} or HEIC")
        if kind == "HEIF":
            _register_heif()
        stream.seek(0)
        with Image.open(stream, formats=[kind]) as opened:
            yield opened


def _stream(image: Path | bytes) -> BinaryIO:
    return BytesIO(image) if isinstance(image, bytes) else image.open("rb")


@cache
def _register_heif() -> None:
    try:
        importlib.import_module("pillow_heif").register_heif_opener()
    except ImportError as error:
        raise ConfigError(
            "HEIC images are decoded by pillow-heif, which is not installed: pip install 'raytran[heic]', or "
            "export the images as JPEG"
        ) from error


@dataclass(frozen=True)
class ImageHeader:
    """What an image's file says of it before it is decoded.

    Attributes:
        size: ``(H, W)`` as stored.
        orientation: EXIF orientation, 1 (upright) to 8; 1 if there is none.
    """

    size: tuple[int, int]
    orientation: int = 1

    @property
    def shown_size(self) -> tuple[int, int]:
        """``(H, W)`` of the image as programs show it that turn it by its orientation."""
        return turned_size(self.size, self.orientation)


@dataclass(frozen=True)
class OrientationTags:
    """Which side of a scan's images is up by their EXIF orientation, and whether they are turned by it.

    Attributes:
        orientation: EXIF orientation, 1 to 8, of each image as it is stored.
        applied: whether poses and intrinsics belong to the image as shown: it is turned when it is read.
    """

    orientation: tuple[int, ...]
    applied: tuple[bool, ...]

    def turn(self, index: int) -> int:
        """Return the EXIF orientation by which an image is turned when it is read; 1: as it is stored."""
        return self.orientation[index] if self.applied[index] else 1

    @property
    def sides(self) -> tuple[int, ...]:
        """Side of each image as it is read at which up is by its tag: top, right, bottom or left, 0 to 3."""
        return tuple(
            0 if applied else _SIDE_OF_UP[tag]
            for tag, applied in zip(self.orientation, self.applied, strict=True)
        )

    def reversed(self, sizes: Sequence[tuple[int, int]]) -> OrientationTags | None:
        """Return the tags with images read the other way whose size ``(H, W)`` stays the same, or None."""
        is_open = [
            tag != 1 and (tag < 5 or height == width)
            for tag, (height, width) in zip(self.orientation, sizes, strict=True)
        ]
        applied = tuple(a != o for a, o in zip(self.applied, is_open, strict=True))
        return OrientationTags(self.orientation, applied) if any(is_open) else None


def orientation_tags(headers: Sequence[ImageHeader | None], *, applied: bool) -> OrientationTags:
    """Return the tags of images; one that cannot be read has none: its neighbour takes its place.

    Args:
        headers: what ``image_headers`` returned for them.
        applied: whether those with a tag are turned by it.
    """
    orientation = tuple(1 if header is None else header.orientation for header in headers)
    return OrientationTags(orientation, tuple(applied and tag != 1 for tag in orientation))


def turned_size(size: tuple[int, int], orientation: int) -> tuple[int, int]:
    """Return ``(H, W)`` of an image of ``size`` after it was turned by an EXIF orientation."""
    return (size[1], size[0]) if orientation >= 5 else size


def turned_image(pixels: NDArray[np.uint8], orientation: int) -> NDArray[np.uint8]:
    """Return ``(H, W, 3)`` pixels turned, or mirrored, as an EXIF orientation asks (EXIF 2.3, §4.6.4)."""
    if orientation in _MIRRORED:
        pixels, orientation = pixels[:, ::-1], _MIRRORED[orientation]
    return np.ascontiguousarray(np.rot90(pixels, _SIDE_OF_UP[orientation]))


def read_header(path: Path) -> ImageHeader:
    """Return size and orientation of an image, without decoding it.

    Raises:
        ConfigError: it is a HEIC, and pillow-heif is not installed.
        DataError: it is no image, or of 0 or more than ``MAX_SIDE`` pixels a side.
    """
    try:
        return _header(path)
    except UNREADABLE as error:
        raise DataError(f"cannot read the image {path} ({error}): copy or export it again") from error


def _header(path: Path) -> ImageHeader:
    with open_image(path) as image:
        _check_sides(image.size, str(path))
        return ImageHeader((image.size[1], image.size[0]), _orientation(image))


def _orientation(image: Image.Image) -> int:
    # Pillow and libheif turn TIFF and HEIF themselves.
    if image.format in ("TIFF", "HEIF"):
        return 1
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of damaged tags, which are none
            value = image.getexif().get(_ORIENTATION_TAG, 1)
    except UNREADABLE:
        return 1
    return value if isinstance(value, int) and 1 <= value <= 8 else 1


def decode_image(
    image: Path | bytes,
    *,
    name: str,
    image_size: tuple[int, int] | None = None,
    stored: tuple[int, int] | None = None,
    orientation: int = 1,
    white: Callable[[], int] | None = None,
) -> Tensor:
    """Read an image that lies in a file of its own or in memory.

    Args:
        image: path or content of a file of one of ``IMAGE_KINDS``.
        name: what to call it in errors.
        image_size: ``(H, W)`` wanted, or None to keep its size.
        stored: ``(H, W)`` that the image must have, or None for any.
        orientation: EXIF orientation by which the stored pixels are turned; both sizes are those after it.
        white: gives the value that is white in grey images of 16 bits, see ``white_level``; None: 65535.

    Returns:
        ``(3, H, W)`` uint8 RGB, a view of ``(H, W, 3)``.

    Raises:
        ConfigError: it is a HEIC, and pillow-heif is not installed.
        DataError: the image is truncated, damaged, of another kind or of numbers whose white is not known, of
            0 or more than ``MAX_SIDE`` pixels a side, or not of size ``stored``.
    """
    try:
        with open_image(image) as opened:
            _check_sides(opened.size, name)
            wanted = None if stored is None else turned_size(stored, orientation)
            if wanted is not None and opened.size != wanted[::-1]:
                raise DataError(
                    f"{name} is {opened.size[0]}x{opened.size[1]}, not {wanted[1]}x{wanted[0]} as the others"
                )
            size = opened.size if image_size is None else turned_size(image_size, orientation)[::-1]
            # A JPEG decodes at ½, ¼ or ⅛ of its size for less time, but not below what is asked for.
            opened.draft("RGB", size)
            pixels = opened if opened.mode == "RGB" else _as_rgb(opened, name, white)
            if pixels.size != size:
                pixels = pixels.resize(size, Image.Resampling.BILINEAR)
            array = np.array(pixels)
    except UNREADABLE as error:
        raise DataError(f"cannot read the image {name} ({error}): copy or export it again") from error
    if orientation != 1:
        array = turned_image(array, orientation)
    return torch.from_numpy(array).permute(2, 0, 1)


def _as_rgb(image: Image.Image, name: str, white: Callable[[], int] | None) -> Image.Image:
    """Return an image of any mode in RGB; Pillow's own conversion cuts off grey beyond 255."""
    if _is_grey_16(image):
        steps = np.asarray(image).astype(np.float32)
        scale = np.float32(255 / (_WHITE_16 if white is None else white()))
        grey = (steps * scale).round().clip(0, 255).astype(np.uint8)
        return Image.fromarray(grey).convert("RGB")
    if image.mode in ("I", "F"):
        raise DataError(
            f"{name} holds {'whole' if image.mode == 'I' else 'real'} numbers of 32 bits, of which none is "
            "known to be white: export it with 8 or 16 bits"
        )
    return image.convert("RGB")


def _is_grey_16(image: Image.Image) -> bool:
    # Before version 11 Pillow opened a PNG of 16 bits in mode I.
    return image.mode.startswith("I;16") or (image.mode == "I" and image.format == "PNG")


def white_level(paths: Sequence[Path]) -> int:
    """Return the value that is white in a scan's grey images of 16 bits.

    Cameras of 10, 12 or 14 bits are often stored in 16 without being scaled. The number of bits is that of
    the brightest pixel in up to ``_LOOKED_AT`` images spread over the scan, one for all of them: a gain that
    changes from image to image would look like changing light.

    Args:
        paths: the scan's images.
    """
    brightest = 0
    for index in np.unique(np.linspace(0, len(paths) - 1, min(len(paths), _LOOKED_AT)).round().astype(int)):
        try:
            with open_image(paths[index]) as image:
                _check_sides(image.size, str(paths[index]))
                if _is_grey_16(image):
                    brightest = max(brightest, int(np.asarray(image).max()))
        except (*UNREADABLE, DataError, ConfigError):
            continue
    bits = next((bits for bits in _BITS if 0 < brightest < 2**bits), 16)
    return 2**bits - 1


def kept_bytes(content: bytes) -> bytes | None:
    """Return a file's content if it is a JPEG or PNG whose pixels are used as they are, else None."""
    if content.startswith(b"\x89PNG"):
        # Bit depth and colour type of the header: grey of 16 bits is scaled by the scan's white level.
        return None if content[24:26] == b"\x10\0" else content
    return content if content.startswith(b"\xff\xd8\xff") else None


def resize(pixels: NDArray[np.uint8], image_size: tuple[int, int]) -> NDArray[np.uint8]:
    """Resize ``(H, W, 3)`` pixels to ``image_size`` (H, W) as the images of files are."""
    return np.array(Image.fromarray(pixels).resize(image_size[::-1], Image.Resampling.BILINEAR))


def has_shape(size: tuple[int, int], other: tuple[int, int]) -> bool:
    """Whether images of two sizes ``(H, W)`` have one aspect, so that one may be the other resized."""
    return abs((size[1] / size[0]) / (other[1] / other[0]) - 1) <= _SAME_ASPECT


def is_turned(size: tuple[int, int], other: tuple[int, int]) -> bool:
    """Whether images of one size ``(H, W)`` have the shape of another's turned by 90°, and not its own."""
    return has_shape(size, other[::-1]) and not has_shape(size, other)


def box_within(size: tuple[int, int], canvas: tuple[int, int]) -> tuple[int, int, int, int]:
    """Return where images of one size lie when they are brought to another, (left, top, right, bottom).

    Images of the same aspect fill it all. Others keep their aspect: they are scaled until they just fit and
    put into the middle, to a pixel.

    Args:
        size: ``(H, W)`` of the images.
        canvas: ``(H, W)`` to which they are brought.
    """
    height, width = canvas
    if has_shape(size, canvas):
        return 0, 0, width, height
    scale = min(height / size[0], width / size[1])
    h, w = max(1, round(size[0] * scale)), max(1, round(size[1] * scale))
    left, top = (width - w) // 2, (height - h) // 2
    return left, top, left + w, top + h


def fill_up(
    pixels: NDArray[np.uint8],
    box: Sequence[float],
    canvas: tuple[int, int],
    image_size: tuple[int, int] | None = None,
) -> NDArray[np.uint8]:
    """Return an image of a larger size that shows pixels in a box and ``FILL`` around them.

    Args:
        pixels: ``(h, w, 3)``.
        box: left, top, right and bottom of where they come to lie on the canvas.
        canvas: ``(H, W)``.
        image_size: ``(H', W')`` to which the canvas is resized; None: as it is.

    Returns:
        ``(H', W', 3)``. Where the box ends within a pixel, that pixel is filled up.
    """
    height, width = image_size or canvas
    scale_x, scale_y = width / canvas[1], height / canvas[0]
    left, top, right, bottom = box[0] * scale_x, box[1] * scale_y, box[2] * scale_x, box[3] * scale_y
    # Whole pixels, and the part of the picture that they show: its place stays exact.
    x0, y0 = math.ceil(left - _ROUNDING), math.ceil(top - _ROUNDING)
    x1, y1 = math.floor(right + _ROUNDING), math.floor(bottom + _ROUNDING)
    image = np.empty((height, width, 3), dtype=np.uint8)
    image[:] = FILL
    if x1 > x0 and y1 > y0:
        rows, columns = pixels.shape[:2]
        across, down = columns / (right - left), rows / (bottom - top)
        part = (
            max((x0 - left) * across, 0.0),
            max((y0 - top) * down, 0.0),
            min((x1 - left) * across, columns),
            min((y1 - top) * down, rows),
        )
        shown = Image.fromarray(pixels).resize((x1 - x0, y1 - y0), Image.Resampling.BILINEAR, box=part)
        image[y0:y1, x0:x1] = np.array(shown)
    return image


def read_frames(
    read: Callable[[int], Tensor],
    num_frames: int,
    chosen: Sequence[int],
    *,
    where: Path,
    min_views: int = MIN_VIEWS,
) -> tuple[Tensor, list[int]]:
    """Read the chosen frames; an unreadable one is replaced by the nearest one not yet taken.

    If all frames are taken the nearest readable one comes twice, so that there are N images in any case.

    Args:
        read: returns ``(3, H, W)`` uint8 of the frame at a position, or raises DataError if it is damaged.
        num_frames: number of frames of the scan.
        chosen: positions of N of them.
        where: what to name in messages.
        min_views: fewest different images, or as many as were chosen if that is less.

    Returns:
        ``(N, 3, H, W)`` uint8 and the N positions that were read.

    Raises:
        DataError: fewer than ``min_views`` different images can be read.
    """
    reader = _Reader(read, len(chosen))
    good = [position for position in chosen if reader.can_read(position)]
    for position in [position for position in chosen if position in reader.failed]:
        near_to_far = np.argsort(np.abs(np.arange(num_frames) - position), kind="stable").tolist()
        # The nearest frame that is not used yet, or if there is none the nearest that is used comes again.
        unused = (other for other in near_to_far if other not in good and reader.can_read(other))
        used_again = (other for other in near_to_far if other in good)
        replacement = next(unused, next(used_again, None))
        if replacement is not None:
            good.append(replacement)
    if reader.failed:
        first = next(iter(reader.failed.values()))
        _warn_once(f"skipped {len(reader.failed)} unreadable images of {where}: {first}")
    if len(set(good)) < min(min_views, len(chosen)):
        raise DataError(
            f"only {len(set(good))} of {num_frames} usable frames in {where} can be read and "
            f"{min_views} are needed: copy or export them again"
        )
    used = sorted(good)
    return reader.images_at(used), used


class _Reader:
    """Reads each image of a scan at most once, into one tensor, and records those that cannot be read."""

    def __init__(self, read: Callable[[int], Tensor], count: int) -> None:
        self.failed: dict[int, DataError] = {}
        self._read, self._count = read, count
        self._images = torch.empty(0)
        self._row: dict[int, int] = {}

    def can_read(self, position: int) -> bool:
        """Read the image at ``position``, if that was not tried before, and return whether it is there."""
        if position not in self._row and position not in self.failed:
            try:
                image = self._read(position)
            except DataError as error:
                self.failed[position] = error
                return False
            if not self._row:
                self._images = torch.empty(self._count, *image.shape, dtype=image.dtype)
            self._row[position] = len(self._row)
            # Copied at once, so that all images reuse the memory of one: new memory costs more than the copy.
            self._images[self._row[position]] = image
        return position in self._row

    def images_at(self, positions: Sequence[int]) -> Tensor:
        """Return the images at positions that were read, ``(N, 3, H, W)``."""
        rows = [self._row[position] for position in positions]
        return self._images if rows == list(range(self._count)) else self._images[rows]


def stored_size(paths: Sequence[Path]) -> tuple[int, int]:
    """Return the most frequent ``(H, W)`` of the images whose headers can be read.

    Raises:
        ConfigError: it is a HEIC, and pillow-heif is not installed.
        DataError: there is none, or they are larger than ``MAX_SIDE``.
    """
    return most_frequent_header(paths).size


def most_frequent_header(
    paths: Sequence[Path], headers: Sequence[ImageHeader | None] | None = None
) -> ImageHeader:
    """Return what most of the images say that have a header that can be read.

    Args:
        paths: the images.
        headers: what ``image_headers`` returned for them, if they were read already.

    Raises:
        ConfigError, DataError: see ``stored_size``.
    """
    headers = image_headers(paths) if headers is None else headers
    counts = Counter(header for header in headers if header is not None)
    if counts:
        return counts.most_common(1)[0][0]
    if paths and paths[0].is_file():
        with suppress(*UNREADABLE):
            _header(paths[0])  # It may say why.
    raise DataError(f"no image in {paths[0].parent} can be read: copy or export them again")


def image_headers(paths: Sequence[Path]) -> list[ImageHeader | None]:
    """Return the header of each image, None where it cannot be read or claims too many pixels."""
    headers: list[ImageHeader | None] = []
    for path in paths:
        try:
            headers.append(_header(path))
        except (*UNREADABLE, DataError, ConfigError):
            headers.append(None)
    return headers


def _check_sides(size: tuple[int, int], name: str) -> None:
    if min(size) < 1:
        raise DataError(f"{name} is of {size[0]}x{size[1]} pixels, so it shows nothing: export it again")
    if max(size) > MAX_SIDE:
        raise DataError(
            f"{name} claims {size[0]}x{size[1]} pixels, and at most {MAX_SIDE} a side are read: make the "
            "images smaller, and scale the first row of the intrinsics by W'/W and the second by H'/H"
        )


@cache
def _warn_once(message: str) -> None:
    _log.warning(message)
