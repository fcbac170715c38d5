# SPDX-License-Identifier: Apache-2.0
"""A scan as its files say it is: images, depth maps where there are any, cameras not yet believed."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from raytran.data.images import MAX_SIDE
from raytran.data.scan import OpenScan
from raytran.data.scannet.scan import Scan, SensScan
from raytran.errors import DataError

_MILLIMETRES = 1000.0
"""Steps of ScanNet's exported depth maps in a metre."""


@dataclass(frozen=True)
class Recording:
    """The usable frames of one scan; nothing is changed or left out that could show a fault.

    Attributes:
        scan: what the scan's files say.
        stored: ``(n, 4, 4)`` float64, the matrices of the pose files.
        intrinsics: ``(3, 3)`` float64, as stored.
        axis_alignment: ``(4, 4)`` float64, aligned_from_world; identity if the scan has none.
    """

    scan: OpenScan
    stored: NDArray[np.float64]
    intrinsics: NDArray[np.float64]
    axis_alignment: NDArray[np.float64]

    @staticmethod
    def of(scan: OpenScan) -> Recording:
        """Return the recording of an open scan, which must stay open."""
        stored, intrinsics, alignment = (
            tensor.double().numpy()
            for tensor in (scan.world_from_camera, scan.intrinsics, scan.axis_alignment)
        )
        return Recording(scan, stored, intrinsics, alignment)

    def __len__(self) -> int:
        return len(self.scan)

    def read_grey(self, frame: int, width: int) -> tuple[NDArray[np.float32], float]:
        """Return a frame at most ``width`` columns wide in [0, 1], and its size relative to the stored one.

        An unreadable image is black; the check of the files names it.
        """
        height, stored_width = self.scan.image_size
        factor = min(1.0, width / stored_width)
        size = (round(height * factor), round(stored_width * factor))
        try:
            color = Image.fromarray(self.scan.read_color(frame, size))
        except DataError:
            return np.zeros(size, dtype=np.float32), factor
        return np.asarray(color.convert("L"), dtype=np.float32) / np.float32(255), factor

    def read_depth(self, frame: int) -> NDArray[np.float64] | None:
        """Return a frame's depth map, metres, 0 where unknown; None if it has none or a damaged one."""
        try:
            if isinstance(self.scan, SensScan):
                steps = self.scan.file.read_depth(self.scan.file_index[frame])
                return None if steps is None else steps / float(self.scan.file.depth_shift)
            path = _depth_path(self.scan, frame)
            if path is None:
                return None
            with Image.open(path) as image:
                if max(image.size) > MAX_SIDE:
                    return None
                depth = np.asarray(image, dtype=np.float64) / _MILLIMETRES
            return depth if depth.ndim == 2 else None
        except (DataError, OSError, SyntaxError, ValueError, Image.DecompressionBombError):
            return None

    def with_depth(self) -> list[int]:
        """Return the frames that have a depth map."""
        if isinstance(self.scan, SensScan):
            return list(range(len(self)))
        return [i for i in range(len(self)) if _depth_path(self.scan, i) is not None]

    def unreadable_images(self, *, most: int) -> tuple[int, list[str]]:
        """Decode up to ``most`` images, spread evenly; return how many, and a sentence about each failure."""
        chosen = np.unique(np.linspace(0, len(self) - 1, min(most, len(self))).round().astype(int)).tolist()
        failed = []
        for frame in chosen:
            try:
                self.scan.read_color(frame)
            except DataError as error:
                failed.append(str(error))
        return len(chosen), failed


def _depth_path(scan: OpenScan, frame: int) -> Path | None:
    """Return the depth map beside a frame's image, as ScanNet's two exporters write it."""
    if not isinstance(scan, Scan):
        return None
    image, name = scan.image_path[frame], scan.frame_id[frame]
    beside = (
        image.parent.parent / "depth" / f"{name}.png",
        image.with_name(image.name.replace(".color.", ".depth.")).with_suffix(".pgm"),
    )
    return next((path for path in beside if path != image and path.is_file()), None)
