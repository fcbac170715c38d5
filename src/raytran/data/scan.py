# SPDX-License-Identifier: Apache-2.0
"""A posed scan of any source, open for reading: its cameras, and its images one at a time."""

from __future__ import annotations

import logging
import re
from abc import ABC, abstractmethod
from collections.abc import Sequence
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
from raytran.geometry.camera import Cameras
from raytran.structs import Views

_log = logging.getLogger(__name__)

LOST = "pose is not finite or no rigid motion"
NO_IMAGE = "no image"
NO_POSE = "no pose"
"""Reasons why a frame is dropped."""


@dataclass(frozen=True, kw_only=True)
class OpenScan(ABC):
    """The usable frames of one scan; use it in a ``with`` statement, or close it.

    Attributes:
        scene_id: e.g. ``scene0470_00``.
        frame_id: name of each usable frame, in the order of the numbers in it.
        world_from_camera: ``(n, 4, 4)`` float64, metres.
        intrinsics: ``(3, 3)`` float64 for images of the stored size, pixels.
        image_size: ``(H, W)`` as stored.
        axis_alignment: ``(4, 4)`` float64, aligned_from_world; identity if the scan has none.
        dropped: reason for each frame that was left out, by frame name.
        damage: a sentence about a file that ends early, or None.
    """

    scene_id: str
    frame_id: tuple[str, ...]
    world_from_camera: Tensor
    intrinsics: Tensor
    image_size: tuple[int, int]
    axis_alignment: Tensor
    dropped: dict[str, str]
    damage: str | None = None

    def __len__(self) -> int:
        return len(self.frame_id)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

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
            DataError: the image is damaged or of another size than ``self.image_size``.
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
    """Log how many frames of a scan have no image or pose."""
    if scan.dropped:
        total = len(scan) + len(scan.dropped)
        reasons = ", ".join(sorted(set(scan.dropped.values())))
        _log.info("%s: dropped %d of %d frames (%s)", scan.scene_id, len(scan.dropped), total, reasons)


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
    pose = scan.world_from_camera[used]
    cameras = Cameras(scan.intrinsics.expand(len(used), 3, 3), pose, scan.image_size).scaled_to(image_size)
    return Views(images[None], cameras.intrinsics.float()[None], pose.float()[None]), used


def _as_tensor(image: NDArray[np.uint8]) -> Tensor:
    return torch.from_numpy(image).permute(2, 0, 1)


def numbers_first(name: str) -> list[tuple[int, int, str]]:
    """Key that sorts frame names by the numbers in them: 9 before 10, frame-9 before frame-10."""
    parts = re.findall(r"\d+|\D+", name)
    return [(0, int(part), "") if part.isdecimal() else (1, 0, part) for part in parts]
