# SPDX-License-Identifier: Apache-2.0
"""Metres in a unit of a model, from what a person with a phone knows.

That is how high the phone was held above the floor, which the model's points show; or a distance between two
things, each marked in two frames or more.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from raytran.capture.lens import load_pycolmap
from raytran.capture.poses.floor import Floor
from raytran.capture.poses.mapping import CAMERA_MODEL, FoundCameras
from raytran.errors import ConfigError, DataError

_MARK_ERROR = 0.015
"""Largest distance, in widths of the image, between a mark and the point that all marks of it make."""

_LEAST_ANGLE_DEG = 2.0
"""Least angle between the rays to a marked point."""


def unit_by_height(floor: Floor | None, cameras: NDArray[np.float64], camera_height: float) -> float:
    """Return the metres in a unit of a model in which the phone was held at a height.

    Args:
        floor: the floor, or None if none was found.
        cameras: ``(n, 3)`` positions of the cameras.
        camera_height: metres from the floor to the camera, in the mean over the film.

    Raises:
        DataError: there is no floor.
    """
    if floor is None:
        raise DataError(
            "no floor is found below the cameras, so camera_height= tells no unit: film the floor too, or "
            "give distance= and marks="
        )
    return camera_height / (float(np.mean(cameras[:, 2])) - floor.height)


def unit_by_distance(found: FoundCameras, distance: float, marks: Sequence[Sequence[Any]]) -> float:
    """Return the metres in a unit of a model by a known distance between two points.

    Args:
        found: the model.
        distance: between the points, metres.
        marks: at least two of (frame, u1, v1, u2, v2): a frame's name or number, and the pixels in it at
            which the two points are.

    Raises:
        ConfigError: marks are no such lists, are of fewer than two frames, or disagree.
        DataError: a frame has no pose.
    """
    rows = [_mark(found, mark) for mark in marks]
    if len({frame for frame, _ in rows}) < 2:
        raise ConfigError("marks= must mark both points in two frames or more: [[12,u1,v1,u2,v2],[40,…]]")
    poses = found.world_from_camera[[frame for frame, _ in rows]]
    pixels = np.array([pixel for _, pixel in rows])
    ends = [_triangulated(found, poses, pixels[:, i], which) for i, which in enumerate(("first", "second"))]
    length = float(np.linalg.norm(ends[0] - ends[1]))
    if not length > 0:
        raise ConfigError("marks= mark one point twice: mark two points whose distance is known")
    return distance / length


def _mark(found: FoundCameras, mark: Any) -> tuple[int, NDArray[np.float64]]:
    """Return the position of a mark's frame, and its two pixels ``(2, 2)``."""
    try:
        name, *numbers = mark
        pixels = np.array([float(value) for value in numbers]).reshape(2, 2)
        if not np.isfinite(pixels).all():
            raise ValueError(mark)
    except (TypeError, ValueError) as error:
        raise ConfigError(
            f"{str(mark)[:60]} in marks= is no frame,u1,v1,u2,v2: give a frame and two pixels of its image"
        ) from error
    stems = [file.rpartition(".")[0] for file in found.names]
    # Hydra reads 000012 as the number 12.
    same = [
        i for i, stem in enumerate(stems) if stem == str(name) or (stem.isdecimal() and _is(name, int(stem)))
    ]
    if not same:
        raise DataError(
            f"marks= names the frame {str(name)[:40]}, which has no pose: take one of those that "
            f"transforms.json lists, e.g. {stems[0]}"
        )
    height, width = found.image_size
    if not ((pixels >= 0) & (pixels <= (width, height))).all():
        raise ConfigError(
            f"marks= of frame {name} lie outside of its {width}x{height} pixels: give pixels of images/"
        )
    return same[0], pixels


def _is(name: Any, number: int) -> bool:
    return isinstance(name, int) and name == number


def _triangulated(
    found: FoundCameras, poses: NDArray[np.float64], pixels: NDArray[np.float64], which: str
) -> NDArray[np.float64]:
    """Return the point ``(3,)`` nearest to the rays through pixels ``(n, 2)`` of cameras ``(n, 4, 4)``.

    Raises:
        ConfigError: it is not seen near all pixels, or the rays are almost parallel.
    """
    pycolmap = load_pycolmap()
    height, width = found.image_size
    params = [found.focal, *found.center, found.distortion]
    camera = pycolmap.Camera(model=CAMERA_MODEL, width=width, height=height, params=params)
    plane = np.asarray(camera.cam_from_img(pixels))
    rays = np.einsum("nij,nj->ni", poses[:, :3, :3], np.column_stack([plane, np.ones(len(plane))]))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    angle = np.degrees(np.arccos(np.clip((rays @ rays.T).min(), -1, 1)))
    if angle < _LEAST_ANGLE_DEG:
        raise ConfigError(
            f"marks= see the {which} point from directions only {angle:.1f}° apart: take frames that are "
            "farther from each other"
        )
    # The sum of squared distances to the rays is least where this linear system says.
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    point: NDArray[np.float64] = np.linalg.solve(
        across.sum(axis=0), np.einsum("nij,nj->i", across, poses[:, :3, 3])
    )
    seen = np.einsum("nji,nj->ni", poses[:, :3, :3], point - poses[:, :3, 3])
    off = np.linalg.norm(np.asarray(camera.img_from_cam(seen)) - pixels, axis=1).max() / width
    if not (seen[:, 2] > 0).all() or not off < _MARK_ERROR:
        raise ConfigError(
            f"marks= of the {which} point do not fit each other, by {100 * off:.1f} % of the image's width: "
            "mark the same point in each frame"
        )
    return point
