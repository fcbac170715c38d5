# SPDX-License-Identifier: Apache-2.0
"""The same points found in two frames, by the images alone, and how well cameras explain them."""

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

_NUM_POINTS = 600
_NUM_STARTS = 14
_WANTED = 1500
"""Matches after which no more frames are compared."""

_FEWEST = 15
"""Matches below which a pair of frames does not count: they show different places, or blur."""

_LEAST_MOTION = 0.03
"""Median shift of a pair's matches, image widths; a smaller one says little about depth."""


@dataclass(frozen=True)
class Matches:
    """Points seen twice.

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


def match_frames(read_grey: Callable[[int, int], tuple[NDArray, float]], num_frames: int) -> Matches:
    """Match points between frames that are near in time, at places spread over the scan.

    The gap between two frames follows from the images: it grows until points move enough to tell depth and
    shrinks when too few are found again. Poses are not used.

    Args:
        read_grey: gives frame i at most W columns wide in [0, 1], and its size relative to the stored one.
        num_frames: frames of the scan.
    """
    matcher = _Matcher(read_grey)
    gap, found = 1, 0
    parts: list[tuple[int, int, NDArray]] = []
    starts = (
        np.linspace(0, max(num_frames - 2, 0), min(_NUM_STARTS, max(num_frames - 1, 0))).round().astype(int)
    )
    order = np.argsort([int(f"{i:08b}"[::-1], 2) for i in range(len(starts))], kind="stable")
    for start in starts[order].tolist():
        for _ in range(3):
            stop = start + gap if start + gap < num_frames else start - gap
            if stop < 0:
                gap = max(1, gap // 2)
                continue
            pixels = matcher.match(start, stop)
            shift = (
                float(np.median(np.linalg.norm(pixels[:, 0] - pixels[:, 1], axis=1))) if len(pixels) else 0.0
            )
            if len(pixels) < _FEWEST:
                gap = max(1, gap // 2)
            elif shift < _LEAST_MOTION * matcher.width:
                gap *= 2
            else:
                parts.append((start, stop, pixels))
                found += len(pixels)
                break
        if found >= _WANTED:
            break
    frames = [np.tile([[a, b]], (len(pixels), 1)) for a, b, pixels in parts]
    tolerance = _TOLERANCE_PX / matcher.factor
    if not parts:
        return Matches(np.zeros((0, 2), np.int64), np.zeros((0, 2, 2)), tolerance)
    return Matches(np.concatenate(frames), np.concatenate([pixels for *_, pixels in parts]), tolerance)


def triangulate(
    matches: Matches, world_from_camera: NDArray, intrinsics: NDArray
) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
    """Say which matches the cameras explain, and how far away their points are.

    A match agrees if its Sampson distance (Hartley & Zisserman 2004, §11.4.3) is within the tolerance and the
    two rays pass each other in front of both cameras.

    Args:
        matches: n of them.
        world_from_camera: ``(frames, 4, 4)``.
        intrinsics: ``(3, 3)``.

    Returns:
        ``(n,)`` bool, and ``(n,)`` depths in the first frame, unit of the poses.
    """
    first, second = world_from_camera[matches.frame[:, 0]], world_from_camera[matches.frame[:, 1]]
    relative = np.linalg.inv(second) @ first
    turn, shift = relative[:, :3, :3], relative[:, :3, 3]
    rays = np.concatenate([matches.pixel, np.ones((*matches.pixel.shape[:2], 1))], axis=2)
    rays = rays @ np.linalg.inv(intrinsics).T
    one, two = np.einsum("nij,nj->ni", turn, rays[:, 0]), rays[:, 1]
    line = np.cross(shift, one)
    residual = np.abs((line * two).sum(axis=1))
    back = np.einsum("nji,nj->ni", turn, np.cross(two, shift))
    focal = np.array([intrinsics[0, 0], intrinsics[1, 1]])
    slope = np.concatenate([line[:, :2] / focal, back[:, :2] / focal], axis=1)
    distance = residual / np.maximum(np.linalg.norm(slope, axis=1), 1e-12)
    across = np.cross(one, two)
    square = np.maximum((across**2).sum(axis=1), 1e-12)
    depth_one = (np.cross(two, shift) * across).sum(axis=1) / square
    depth_two = (np.cross(one, shift) * across).sum(axis=1) / square
    return (distance < matches.tolerance_px) & (depth_one > 0) & (depth_two > 0), depth_one


class _Matcher:
    """Finds points once per frame."""

    def __init__(self, read_grey: Callable[[int, int], tuple[NDArray, float]]) -> None:
        self._read_grey = read_grey
        self._points: dict[int, tuple[NDArray, NDArray]] = {}
        self.factor, self.width = 1.0, _WIDTH

    def match(self, first: int, second: int) -> NDArray[np.float64]:
        """Return ``(n, 2, 2)`` matched pixels of two frames, at the stored size."""
        (a, code_a), (b, code_b) = self._find(first), self._find(second)
        if len(a) < _FEWEST or len(b) < _FEWEST:
            return np.zeros((0, 2, 2))
        pairs = match_descriptors(code_a, code_b, cross_check=True, max_ratio=0.8)
        return np.stack([a[pairs[:, 0]], b[pairs[:, 1]]], axis=1)

    def _find(self, frame: int) -> tuple[NDArray, NDArray]:
        if frame not in self._points:
            grey, self.factor = self._read_grey(frame, _WIDTH)
            self.width = round(grey.shape[1] / self.factor)
            detector = ORB(n_keypoints=_NUM_POINTS, fast_threshold=0.04)
            try:
                detector.detect_and_extract(grey)
                # Points are given as (row, column) of pixel centres; (0, 0) is the corner of the image here.
                points = (detector.keypoints[:, ::-1] + 0.5) / self.factor
                self._points[frame] = points, detector.descriptors
            except (RuntimeError, ValueError, IndexError):
                # What scikit-image raises when an image has no corners.
                self._points[frame] = np.zeros((0, 2)), np.zeros((0, 256), dtype=bool)
        return self._points[frame]
