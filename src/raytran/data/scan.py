# SPDX-License-Identifier: Apache-2.0
"""A posed scan of any source, open for reading: its cameras, and its images one at a time."""

from __future__ import annotations

import logging
import re
from abc import ABC, abstractmethod
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from raytran.data.images import MIN_VIEWS, read_frames
from raytran.data.views import choose_even
from raytran.errors import DataError
from raytran.geometry.camera import Cameras
from raytran.structs import Views

_log = logging.getLogger(__name__)

LOST = "pose is not finite or out of bounds"
EMPTY = "pose is all zeros"
LEFT_HANDED = "left-handed pose (determinant −1)"
SCALED = "rotation scaled by"
SKEWED = "pose is no rigid motion"
NO_MATRIX = "no camera-to-world matrix of numbers"
NO_IMAGE = "no image"
NEEDS_HEIF = "HEIC image, which pillow-heif decodes"
NO_POSE = "no pose"
OTHER_SHAPE = "image of another shape than its intrinsics are for"
TURNED = "image turned by 90° against its intrinsics"
"""Reasons why a frame is dropped; ``SCALED`` is followed by the scale."""

_REMEDIES = {
    LOST: "tracking was lost in all of them, so record or reconstruct again",
    EMPTY: "tracking was lost in all of them, so record or reconstruct again",
    LEFT_HANDED: "one axis is mirrored, so negate that row (of the world) or column (of the camera) of each",
    SCALED: "divide the upper left 3x3 of each by it, and the positions too if the world was scaled with it",
    SKEWED: "write camera-to-world matrices whose upper left 3x3 is a rotation",
    NO_MATRIX: "give each image a text file of its name with the 16 numbers of a 4x4 matrix",
    NO_POSE: "give each image a pose under its name",
    NEEDS_HEIF: "pip install 'raytran[heic]', or export the images as JPEG",
    NO_IMAGE: "check that its images lie beside it under the names it gives",
}
"""What to do if no frame is left, by the most frequent reason."""

_ROWS, _EXAMPLES = 12, 3
"""Reasons that are listed, and names for each."""


@dataclass(frozen=True, kw_only=True)
class OpenScan(ABC):
    """The usable frames of one scan; use it in a ``with`` statement, or close it.

    Attributes:
        scene_id: e.g. ``scene0470_00``.
        frame_id: name of each usable frame, in the order of the numbers in it.
        world_from_camera: ``(n, 4, 4)`` float64, metres.
        intrinsics: ``(n, 3, 3)`` float64 of each frame, for images of ``image_size``, pixels.
        image_size: ``(H, W)`` as most frames are stored; the others are brought to it.
        picture: ``(n, 4)`` float64 left, top, right and bottom of what a frame shows within an image of
            ``image_size``, pixels; around it the image is filled up. None: every image is all picture.
        axis_alignment: ``(4, 4)`` float64, aligned_from_world; identity if the scan has none.
        dropped: reason for each frame that was left out, by frame name.
        damage: a sentence about a file that ends early, or None.
        world_from_input: ``(4, 4)`` float64, from the world and unit of the poses as they were read to those
            of ``world_from_camera``; None: they are the same.
    """

    scene_id: str
    frame_id: tuple[str, ...]
    world_from_camera: Tensor
    intrinsics: Tensor
    image_size: tuple[int, int]
    axis_alignment: Tensor
    dropped: dict[str, str]
    picture: Tensor | None = None
    damage: str | None = None
    world_from_input: Tensor | None = None

    def __len__(self) -> int:
        return len(self.frame_id)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    @property
    def cameras(self) -> Cameras:
        """The cameras of all usable frames, ``(n,)``, for images of ``image_size``."""
        return Cameras(self.intrinsics, self.world_from_camera, self.image_size, self.picture)

    @property
    @abstractmethod
    def path(self) -> Path:
        """Folder or file that it is read from."""

    @abstractmethod
    def color_bytes(self, index: int) -> bytes | None:
        """Return usable frame ``index`` as stored, if it is a JPEG or PNG that is used as it is, else None.

        Raises:
            DataError: it cannot be read.
        """

    @abstractmethod
    def read_color(self, index: int, image_size: tuple[int, int] | None = None) -> NDArray[np.uint8]:
        """Return ``(H, W, 3)`` RGB of usable frame ``index``, resized to ``image_size`` if given.

        Raises:
            DataError: the image is damaged or of another size than it had when the scan was opened.
        """

    @abstractmethod
    def close(self) -> None:
        """Close the file, if one is open."""


def even_views(
    scan: OpenScan, *, image_size: tuple[int, int], num_views: int
) -> tuple[Views, tuple[str, ...]]:
    """Read evenly spread frames of an open scan; how many have no image or pose is logged.

    Args:
        scan: of any source.
        image_size: ``(H, W)`` to which the images are resized; the intrinsics follow.
        num_views: N.

    Returns:
        the views with B = 1 and the name of each frame.

    Raises:
        DataError: fewer than two images can be read.
    """
    report_dropped(scan)
    views, used = scan_views(scan, choose_even(len(scan), num_views).tolist(), image_size=image_size)
    return views, tuple(scan.frame_id[i] for i in used)


def report_dropped(scan: OpenScan) -> None:
    """Log a table of the frames of a scan that were left out: how many, why, and some of their names."""
    if not scan.dropped:
        return
    by_reason: defaultdict[str, list[str]] = defaultdict(list)
    for name, reason in scan.dropped.items():
        by_reason[reason].append(name)
    ordered = sorted(by_reason.items(), key=lambda item: (-len(item[1]), item[0]))
    shown, rest = ordered[:_ROWS], ordered[_ROWS:]
    rows = [
        (str(len(names)), reason, ", ".join(names[:_EXAMPLES]) + (", …" if len(names) > _EXAMPLES else ""))
        for reason, names in shown
    ]
    if rest:
        rows.append((str(sum(len(names) for _, names in rest)), f"{len(rest)} more reasons", ""))
    wide, long = (max(len(row[column]) for row in rows) for column in (0, 1))
    lines = [f"  {count:>{wide}}  {reason:<{long}}  {names}".rstrip() for count, reason, names in rows]
    total = len(scan) + len(scan.dropped)
    head = f"{scan.scene_id}: left out {len(scan.dropped)} of {total} frames"
    _log.info("%s", "\n".join([head, *lines]))


def none_usable(where: Path, dropped: Mapping[str, str]) -> DataError:
    """Return the error for a scan of which no frame is left, which names the commonest reason and its remedy.

    Args:
        where: the scan.
        dropped: reason for each frame.
    """
    counts = Counter(dropped.values()).most_common()
    reasons = ", ".join(f"{count} {reason}" for reason, count in counts[:3])
    more = f", {len(counts) - 3} more reasons" if len(counts) > 3 else ""
    common = counts[0][0] if counts else NO_IMAGE
    remedy = next((text for reason, text in _REMEDIES.items() if common.startswith(reason)), None)
    return DataError(
        f"none of the {len(dropped)} frames of {where} has an image and a valid pose ({reasons}{more}): "
        f"{remedy or 'export it again'}"
    )


def scan_views(
    scan: OpenScan, chosen: Sequence[int], *, image_size: tuple[int, int], min_views: int = MIN_VIEWS
) -> tuple[Views, list[int]]:
    """Read the chosen frames of a scan; an unreadable one is replaced by its nearest readable neighbour.

    Args:
        scan: what ``open_scan`` or ``read_scan`` returned.
        chosen: positions of N frames in it.
        image_size: ``(H, W)`` to which the images are resized; the intrinsics follow.
        min_views: fewest different frames.

    Returns:
        the views with B = 1 and the positions of the frames that were read.

    Raises:
        DataError: fewer than ``min_views`` different frames can be read.
    """
    images, used = read_frames(
        lambda index: _as_tensor(scan.read_color(index, image_size)),
        len(scan),
        chosen,
        where=scan.path,
        min_views=min_views,
    )
    cameras = scan.cameras[used].scaled_to(image_size).to(torch.float32)[None]
    picture = cameras.picture
    if picture is not None and bool((picture == picture.new_tensor([0, 0, *image_size[::-1]])).all()):
        # None of the frames that are filled up was chosen.
        picture = None
    return Views(images[None], cameras.intrinsics, cameras.world_from_camera, picture), used


def _as_tensor(image: NDArray[np.uint8]) -> Tensor:
    return torch.from_numpy(image).permute(2, 0, 1)


def numbers_first(name: str) -> list[tuple[int, int, str]]:
    """Key that sorts frame names by the numbers in them: 9 before 10, frame-9 before frame-10."""
    parts = re.findall(r"\d+|\D+", name)
    return [(0, int(part), "") if part.isdecimal() else (1, 0, part) for part in parts]
