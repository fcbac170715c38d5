# SPDX-License-Identifier: Apache-2.0
"""Where rays into the images end: at measured depths, or where two rays to the same point meet."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from raytran.capture.doctor.matches import Matches
from raytran.capture.doctor.recording import Recording

_MOST_FRAMES = 20
_STEP = 8
"""Every how many rows and columns a depth map is sampled."""


@dataclass(frozen=True)
class Sightings:
    """Rays whose ends are known; nothing solid lies between.

    Attributes:
        frame: ``(n,)`` position of the frame in the scan.
        ray: ``(n, 3)`` direction in camera axes, z = 1.
        depth: ``(n,)`` along the camera's z axis, metres.
        source: where the ends come from, for the reader.
    """

    frame: NDArray[np.int64]
    ray: NDArray[np.float64]
    depth: NDArray[np.float64]
    source: str

    def __len__(self) -> int:
        return len(self.frame)

    def in_world(self, world_from_camera: NDArray[np.float64]) -> tuple[NDArray, NDArray]:
        """Return origins and directions ``(n, 3)``; an end is the origin plus depth times direction."""
        poses = world_from_camera[self.frame]
        return poses[:, :3, 3], np.einsum("nij,nj->ni", poses[:, :3, :3], self.ray)

    def points(self, world_from_camera: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the ``(n, 3)`` ends of the rays in the world."""
        origin, way = self.in_world(world_from_camera)
        return origin + way * self.depth[:, None]


def sightings_from_matches(matches: Matches, depth: NDArray, intrinsics: NDArray) -> Sightings:
    """Return the rays of the first frames to matched points, ``depth`` ``(n,)`` away."""
    return Sightings(matches.frame[:, 0], _rays(matches.pixel[:, 0], intrinsics), depth, "points seen twice")


def sightings_from_depth(recording: Recording, intrinsics: NDArray) -> Sightings | None:
    """Return samples of a scan's depth maps, registered with the colour images; None if it has none."""
    frames = recording.with_depth()
    chosen = frames[:: max(1, len(frames) // _MOST_FRAMES)][:_MOST_FRAMES]
    parts = []
    for frame in chosen:
        depth = recording.read_depth(frame)
        if depth is None:
            continue
        rows, columns = np.mgrid[_STEP // 2 : depth.shape[0] : _STEP, _STEP // 2 : depth.shape[1] : _STEP]
        ends = depth[rows, columns].ravel()
        share = np.stack(
            [(columns.ravel() + 0.5) / depth.shape[1], (rows.ravel() + 0.5) / depth.shape[0]], axis=1
        )
        known = ends > 0
        parts.append((np.full(known.sum(), frame), share[known], ends[known]))
    if not parts:
        return None
    numbers, share, ends = (np.concatenate(columns) for columns in zip(*parts, strict=True))
    return Sightings(numbers, _rays(share * recording.scan.image_size[::-1], intrinsics), ends, "depth maps")


def depth_at(recording: Recording, matches: Matches) -> NDArray[np.float64] | None:
    """Return the measured depth of each match in its first frame, NaN where unknown; None without maps."""
    has_map = set(recording.with_depth())
    if not has_map:
        return None
    height, width = recording.scan.image_size
    measured = np.full(len(matches), np.nan)
    for frame in has_map & set(np.unique(matches.frame[:, 0]).tolist()):
        depth = recording.read_depth(frame)
        if depth is None:
            continue
        here = np.flatnonzero(matches.frame[:, 0] == frame)
        share = matches.pixel[here, 0] / (width, height)
        cell = (share * depth.shape[::-1]).astype(int).clip(0, np.array(depth.shape[::-1]) - 1)
        values = depth[cell[:, 1], cell[:, 0]]
        measured[here] = np.where(values > 0, values, np.nan)
    return measured


def _rays(pixel: NDArray, intrinsics: NDArray) -> NDArray[np.float64]:
    return np.concatenate([pixel, np.ones((len(pixel), 1))], axis=1) @ np.linalg.inv(intrinsics).T
