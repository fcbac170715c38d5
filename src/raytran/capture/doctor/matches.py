# SPDX-License-Identifier: Apache-2.0
"""Points matched between frames by their images alone, and whether cameras explain the matches."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from skimage.feature import ORB, match_descriptors

_WIDTH = 480
"""Columns of the images in which points are sought; pixel errors are measured at this size."""

_TOLERANCE_PX = 1.5
"""Largest distance of a match from its epipolar line, pixels of an image ``_WIDTH`` wide."""

_PATCH = 16
"""Pixels around a point that ORB reads, about."""

_NUM_POINTS = 600
_NUM_STARTS = 14
_ENOUGH = 1500
"""Matches after which no more frames are compared."""

_MIN_PER_PAIR = 15
"""Matches below which a pair of frames does not count: they show different places, or blur."""

_MIN_MOTION = 0.03
"""Median shift of a pair's matches, image widths; a smaller one says little about depth."""


@dataclass(frozen=True)
class Matches:
    """n points, each in two frames.

    Attributes:
        frame: ``(n, 2)`` positions of the two frames in the scan.
        pixel: ``(n, 2, 2)`` the point in each of them, (u, v) pixels of the stored image.
        tolerance_px: largest error that counts as agreement, pixels of the stored image.
    """

    frame: NDArray[np.int64]
    pixel: NDArray[np.float64]
    tolerance_px: float

    def __len__(self) -> int:
        return len(self.frame)


def match_frames(
    read_grey: Callable[[int, int], tuple[NDArray, float]],
    num_frames: int,
    *,
    picture: NDArray[np.float64] | None = None,
) -> Matches:
    """Match points between frames that are near in time, at places spread over the scan.

    The gap between two frames follows from the images: it grows until points move enough to tell depth and
    shrinks when too few are found again. Poses are not used.

    Args:
        read_grey: gives frame i at most W columns wide in [0, 1], and its size relative to the stored one.
        num_frames: frames of the scan.
        picture: ``(num_frames, 4)`` left, top, right and bottom of what each frame shows, pixels of the
            stored image, outside of which no points are sought; None: all of it.
    """
    matcher = _Matcher(read_grey, picture)
    gap, count = 1, 0
    pairs: list[tuple[int, int, NDArray]] = []
    for start in _spread_starts(num_frames):
        for _ in range(3):
            stop = start + gap if start + gap < num_frames else start - gap
            if stop < 0:
                gap = max(1, gap // 2)
                continue
            pixels = matcher.match(start, stop)
            if len(pixels) < _MIN_PER_PAIR:
                gap = max(1, gap // 2)
            elif np.median(np.linalg.norm(pixels[:, 0] - pixels[:, 1], axis=1)) < _MIN_MOTION * matcher.width:
                gap *= 2
            else:
                pairs.append((start, stop, pixels))
                count += len(pixels)
                break
        if count >= _ENOUGH:
            break
    tolerance = _TOLERANCE_PX / matcher.factor
    if not pairs:
        return Matches(np.zeros((0, 2), np.int64), np.zeros((0, 2, 2)), tolerance)
    frames = np.concatenate([np.tile([[a, b]], (len(pixels), 1)) for a, b, pixels in pairs])
    return Matches(frames, np.concatenate([pixels for *_, pixels in pairs]), tolerance)


def _spread_starts(num_frames: int) -> list[int]:
    """Return frames spread evenly over a scan, ordered so that the first few are spread too."""
    count = min(_NUM_STARTS, max(num_frames - 1, 0))
    starts = np.linspace(0, max(num_frames - 2, 0), count).round().astype(int)
    # By the reversed bits of their numbers (van der Corput's sequence).
    order = np.argsort([int(f"{i:08b}"[::-1], 2) for i in range(count)], kind="stable")
    return starts[order].tolist()


def triangulate(
    matches: Matches, world_from_camera: NDArray, intrinsics: NDArray
) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
    """Return which matches the cameras explain, and how far away their points are.

    A match agrees if its Sampson distance (Hartley & Zisserman 2004, §11.4.3) is within the tolerance and the
    two rays pass each other in front of both cameras.

    Args:
        matches: n of them.
        world_from_camera: ``(frames, 4, 4)``.
        intrinsics: ``(frames, 3, 3)``.

    Returns:
        ``(n,)`` bool, and ``(n,)`` depths in the first frame, unit of the poses.
    """
    first, second = world_from_camera[matches.frame[:, 0]], world_from_camera[matches.frame[:, 1]]
    relative = np.linalg.inv(second) @ first
    rotation, translation = relative[:, :3, :3], relative[:, :3, 3]
    rays = np.concatenate([matches.pixel, np.ones((*matches.pixel.shape[:2], 1))], axis=2)
    rays = np.einsum("npij,npj->npi", np.linalg.inv(intrinsics)[matches.frame], rays)
    # Both rays in the axes of the second camera.
    first_ray, second_ray = np.einsum("nij,nj->ni", rotation, rays[:, 0]), rays[:, 1]
    # Sampson distance: the epipolar residual over its slope in the pixels of both images.
    line = np.cross(translation, first_ray)
    residual = np.abs((line * second_ray).sum(axis=1))
    line_in_first = np.einsum("nji,nj->ni", rotation, np.cross(second_ray, translation))
    focal = intrinsics[matches.frame][:, :, [0, 1], [0, 1]]
    slope = np.concatenate([line[:, :2] / focal[:, 1], line_in_first[:, :2] / focal[:, 0]], axis=1)
    distance = residual / np.maximum(np.linalg.norm(slope, axis=1), 1e-12)
    # Depths at which the rays are closest to each other.
    normal = np.cross(first_ray, second_ray)
    square = np.maximum((normal**2).sum(axis=1), 1e-12)
    first_depth = (np.cross(second_ray, translation) * normal).sum(axis=1) / square
    second_depth = (np.cross(first_ray, translation) * normal).sum(axis=1) / square
    in_front = (first_depth > 0) & (second_depth > 0)
    return (distance < matches.tolerance_px) & in_front, first_depth


class _Matcher:
    """Matches ORB features (Rublee et al. 2011) of two frames; those of a frame are computed once."""

    def __init__(
        self, read_grey: Callable[[int, int], tuple[NDArray, float]], picture: NDArray[np.float64] | None
    ) -> None:
        self._read_grey, self._picture = read_grey, picture
        self._features: dict[int, tuple[NDArray, NDArray]] = {}
        self.factor, self.width = 1.0, _WIDTH

    def match(self, first: int, second: int) -> NDArray[np.float64]:
        """Return ``(n, 2, 2)`` matched pixels of two frames, at the stored size."""
        (a, descriptors_a), (b, descriptors_b) = self._features_of(first), self._features_of(second)
        if len(a) < _MIN_PER_PAIR or len(b) < _MIN_PER_PAIR:
            return np.zeros((0, 2, 2))
        pairs = match_descriptors(descriptors_a, descriptors_b, cross_check=True, max_ratio=0.8)
        return np.stack([a[pairs[:, 0]], b[pairs[:, 1]]], axis=1)

    def _features_of(self, frame: int) -> tuple[NDArray, NDArray]:
        if frame not in self._features:
            grey, self.factor = self._read_grey(frame, _WIDTH)
            self.width = round(grey.shape[1] / self.factor)
            detector = ORB(n_keypoints=_NUM_POINTS, fast_threshold=0.04)
            try:
                detector.detect_and_extract(grey)
                # Points are given as (row, column) of pixel centres; (0, 0) is the corner of the image here.
                points = (detector.keypoints[:, ::-1] + 0.5) / self.factor
                inside = self._is_inside(frame, points)
                self._features[frame] = points[inside], detector.descriptors[inside]
            except (RuntimeError, ValueError, IndexError):
                # What scikit-image raises when an image has no corners.
                self._features[frame] = np.zeros((0, 2)), np.zeros((0, 256), dtype=bool)
        return self._features[frame]

    def _is_inside(self, frame: int, points: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return which points are so far inside a frame's picture that their patch is, ``(n,)``."""
        if self._picture is None:
            return np.ones(len(points), dtype=np.bool_)
        low, high = self._picture[frame, :2], self._picture[frame, 2:]
        margin = _PATCH / self.factor
        return np.asarray(((points >= low + margin) & (points < high - margin)).all(axis=1))
