# SPDX-License-Identifier: Apache-2.0
"""Points of visible surfaces: from depth maps, or triangulated from two frames."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from raytran.capture.doctor.matches import Matches
from raytran.capture.frames import RawScan

_MAX_FRAMES = 20
_STEP = 8
"""Every how many rows and columns a depth map is sampled."""


@dataclass(frozen=True)
class SurfacePoints:
    """Points of surfaces, each seen by a frame: nothing solid lies between it and the camera.

    Attributes:
        frame: ``(n,)`` position of the frame in the scan.
        ray: ``(n, 3)`` direction in camera axes, z = 1.
        depth: ``(n,)`` along the camera's z axis, metres.
        source: where the depths come from, for the reader of the findings.
    """

    frame: NDArray[np.int64]
    ray: NDArray[np.float64]
    depth: NDArray[np.float64]
    source: str

    def __len__(self) -> int:
        return len(self.frame)

    def rays_in_world(self, world_from_camera: NDArray[np.float64]) -> tuple[NDArray, NDArray]:
        """Return origins and directions ``(n, 3)``; a point is the origin plus depth times direction."""
        poses = world_from_camera[self.frame]
        return poses[:, :3, 3], np.einsum("nij,nj->ni", poses[:, :3, :3], self.ray)

    def in_world(self, world_from_camera: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the points ``(n, 3)`` in the world."""
        origin, direction = self.rays_in_world(world_from_camera)
        return origin + direction * self.depth[:, None]


def points_from_matches(matches: Matches, depth: NDArray, intrinsics: NDArray) -> SurfacePoints:
    """Return matched points, seen by their first frames at ``depth`` ``(n,)``; intrinsics of all frames."""
    rays = _rays(matches.pixel[:, 0], intrinsics[matches.frame[:, 0]])
    return SurfacePoints(matches.frame[:, 0], rays, depth, "points seen twice")


def points_from_depth_maps(raw: RawScan, intrinsics: NDArray) -> SurfacePoints | None:
    """Return samples of a scan's depth maps, registered with the colour images; None if it has none.

    Args:
        raw: the scan.
        intrinsics: ``(frames, 3, 3)`` of all its frames.
    """
    with_depth = raw.frames_with_depth()
    chosen = with_depth[:: max(1, len(with_depth) // _MAX_FRAMES)][:_MAX_FRAMES]
    frames, pixels, depths = [], [], []
    for frame in chosen:
        depth = raw.read_depth(frame)
        if depth is None:
            continue
        rows, columns = np.mgrid[_STEP // 2 : depth.shape[0] : _STEP, _STEP // 2 : depth.shape[1] : _STEP]
        values = depth[rows, columns].ravel()
        # Relative positions of the cells' centres: maps may be smaller than the images.
        position = np.stack([columns.ravel() + 0.5, rows.ravel() + 0.5], axis=1) / depth.shape[::-1]
        is_known = values > 0
        frames.append(np.full(is_known.sum(), frame))
        pixels.append(position[is_known] * raw.scan.image_size[::-1])
        depths.append(values[is_known])
    if not frames:
        return None
    rays = _rays(np.concatenate(pixels), intrinsics[np.concatenate(frames)])
    return SurfacePoints(np.concatenate(frames), rays, np.concatenate(depths), "depth maps")


def depth_of_matches(raw: RawScan, matches: Matches) -> NDArray[np.float64] | None:
    """Return each match's depth ``(n,)`` in its first frame's map, NaN where unknown; None without maps."""
    with_depth = set(raw.frames_with_depth())
    if not with_depth:
        return None
    height, width = raw.scan.image_size
    measured = np.full(len(matches), np.nan)
    for frame in with_depth & set(np.unique(matches.frame[:, 0]).tolist()):
        depth = raw.read_depth(frame)
        if depth is None:
            continue
        in_frame = np.flatnonzero(matches.frame[:, 0] == frame)
        position = matches.pixel[in_frame, 0] / (width, height)
        cell = (position * depth.shape[::-1]).astype(int).clip(0, np.array(depth.shape[::-1]) - 1)
        values = depth[cell[:, 1], cell[:, 0]]
        measured[in_frame] = np.where(values > 0, values, np.nan)
    return measured


def _rays(pixel: NDArray, intrinsics: NDArray) -> NDArray[np.float64]:
    """Return directions ``(n, 3)`` in camera axes, z = 1, of pixels ``(n, 2)``, each with its intrinsics."""
    homogeneous = np.concatenate([pixel, np.ones((len(pixel), 1))], axis=1)
    return np.einsum("nij,nj->ni", np.linalg.inv(intrinsics), homogeneous)
