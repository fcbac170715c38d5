# SPDX-License-Identifier: Apache-2.0
"""A film's frames and cameras as a scan that ``predict`` reads: nerfstudio's ``transforms.json``.

Beside what nerfstudio writes there stands what it does not know, up and unit, in ``raytran_world``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from raytran.capture.nerfstudio import NAMES, WORLD, WORLD_METRES, WORLD_UP
from raytran.capture.orientation import OPENGL
from raytran.capture.poses.film import Film
from raytran.capture.poses.mapping import FoundCameras
from raytran.data.files import whole_file, write_json
from raytran.errors import DataError

IMAGES = "images"
LISTED = NAMES[0]

_QUALITY = 95
_DIGITS = 9
"""Digits behind the point of poses."""


def write_images(
    film: Film,
    frames: Sequence[int],
    folder: Path,
    longest_side: int,
    *,
    progress: Callable[[Iterable[int], int], Iterable[int]] | None = None,
) -> list[str]:
    """Write frames of a film as JPEG files; those that are there already stay.

    Args:
        film: the film.
        frames: numbers of the frames.
        folder: where to.
        longest_side: most pixels of the longer side; larger frames are made smaller.
        progress: given the frames and how many they are, yields them again.

    Returns:
        Names of the files.

    Raises:
        DataError: a frame is of another size than the first.
    """
    folder.mkdir(parents=True, exist_ok=True)
    names = [f"{film.names[frame]}.jpg" for frame in frames]
    size: tuple[int, int] | None = None
    for frame in frames if progress is None else progress(frames, len(frames)):
        path = folder / f"{film.names[frame]}.jpg"
        if path.is_file():
            continue
        image = Image.fromarray(film.read(frame))
        if size is not None and image.size != size:
            raise DataError(
                f"frame {film.names[frame]} of {film.path} is {image.width}x{image.height} and others are "
                f"{size[0]}x{size[1]}: give images that one camera took, held one way"
            )
        size = image.size
        image.thumbnail((longest_side, longest_side), Image.Resampling.LANCZOS)
        with whole_file(path) as temporary:
            image.save(temporary, format="JPEG", quality=_QUALITY)
    return names


def write_scene(
    folder: Path,
    found: FoundCameras,
    world_from_model: NDArray[np.float64],
    *,
    is_level: bool,
    is_metric: bool,
    made_from: Mapping[str, Any],
) -> Path:
    """Write ``transforms.json`` into the folder of the images.

    Args:
        folder: with ``images/``.
        found: the cameras.
        world_from_model: ``(4, 4)`` rotation, scale and shift, for up, metres and the floor at 0.
        is_level: whether +z is up in this world for certain.
        is_metric: whether its unit is the metre for certain.
        made_from: what to remember beside, values that JSON can hold.

    Returns:
        Path of the file.
    """
    height, width = found.image_size
    scale = np.cbrt(np.linalg.det(world_from_model[:3, :3]))
    poses = world_from_model @ found.world_from_camera
    poses[:, :3, :3] = poses[:, :3, :3] / scale @ OPENGL
    world = {"up": WORLD_UP if is_level else None, "unit": WORLD_METRES if is_metric else None}
    listed = folder / LISTED
    write_json(
        listed,
        {
            "camera_model": "OPENCV",
            **{"w": width, "h": height, "fl_x": found.focal, "fl_y": found.focal},
            **{"cx": found.center[0], "cy": found.center[1], "k1": found.distortion},
            WORLD: world | dict(made_from),
            "frames": [
                {"file_path": f"{IMAGES}/{name}", "transform_matrix": pose.round(_DIGITS).tolist()}
                for name, pose in zip(found.names, poses, strict=True)
            ],
        },
    )
    return listed
