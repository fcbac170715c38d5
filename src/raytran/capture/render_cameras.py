# SPDX-License-Identifier: Apache-2.0
"""Cameras from which a scene is to be rendered, listed in our own form or in nerfstudio's."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from raytran.capture.lens import Lens, check_lens
from raytran.capture.nerfstudio import frame_lens, frame_pose, undo_applied
from raytran.capture.orientation import OPENGL
from raytran.capture.recording import numbers
from raytran.data.scannet.text import are_rigid
from raytran.data.text import read_json_object
from raytran.errors import DataError, page
from raytran.geometry.camera import Cameras
from raytran.limits import MATRIX_ENTRY

MAX_CAMERAS = 10_000
"""A list of more is taken for a mistake."""

_FILE_NAME = re.compile(r"[\w-][\w. -]{0,99}")
"""Names that every file system accepts."""


@dataclass(frozen=True)
class RenderCameras:
    """V cameras without images, each with a name and the size of its image.

    Attributes:
        names: of the cameras, all different, fit for file names.
        lenses: V pinholes, for the size of each image.
        world_from_camera: ``(V, 4, 4)`` float64, OpenCV axes, metres.
    """

    names: tuple[str, ...]
    lenses: tuple[Lens, ...]
    world_from_camera: Tensor

    def __len__(self) -> int:
        return len(self.names)

    def scaled_to(self, image_size: tuple[int, int]) -> Cameras:
        """Return the cameras of the same images resized to one size ``(H, W)``, leading shape ``(V,)``."""
        matrices = torch.stack([lens.scaled_to(image_size).matrix for lens in self.lenses])
        return Cameras(matrices.float(), self.world_from_camera.float(), image_size)


def read_render_cameras(path: Path) -> RenderCameras:
    """Read a list of cameras; docs/novel-view.md describes both forms.

    Our own has ``views``, each with ``world_from_camera`` (4×4, OpenCV axes), ``intrinsics`` (3×3, or fx, fy,
    cx, cy), ``image_size`` [H, W] and ``name``; the last is optional, and those before may stand once for all
    beside ``views``. nerfstudio's has ``frames``; distortion is left out.

    Raises:
        DataError: the file is missing, damaged, or lists no cameras; or an entry is no valid camera.
    """
    path = Path(path)
    content = read_json_object(path)
    if "views" not in content and "frames" not in content:
        raise DataError(
            f"{path} has neither views nor frames: write cameras as {page('novel-view.md')} shows"
        )
    key = "views" if "views" in content else "frames"
    listed = content[key]
    if not isinstance(listed, list) or not listed or not all(isinstance(entry, dict) for entry in listed):
        raise DataError(f"{path} lists no cameras under {key}: write at least one, as an object")
    if len(listed) > MAX_CAMERAS:
        raise DataError(
            f"{path} lists {len(listed)} cameras, at most {MAX_CAMERAS} are rendered: divide the list"
        )
    where = [f"{key}[{index}] of {path}" for index in range(len(listed))]
    # What all cameras share may stand once, beside the list.
    entries = [{**content, **entry} for entry in listed]
    if key == "views":
        lenses = [_lens(entry, name) for entry, name in zip(entries, where, strict=True)]
        poses = [
            numbers(entry, "world_from_camera", MATRIX_ENTRY, name, (4, 4))
            for entry, name in zip(entries, where, strict=True)
        ]
    else:
        lenses, poses = _nerfstudio(content, entries, where, path)
    return RenderCameras(_names(listed, where), tuple(lenses), torch.from_numpy(_checked_poses(poses, where)))


def _lens(entry: Mapping[str, Any], where: str) -> Lens:
    try:
        height, width = (int(side) for side in entry["image_size"])
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise DataError(f"{where} has no image_size: write [height, width] in pixels") from error
    try:
        given = np.array(entry["intrinsics"], dtype=np.float64)
    except (KeyError, TypeError, ValueError) as error:
        raise DataError(f"{where} has no intrinsics: write [fx, fy, cx, cy] or a 3x3 matrix") from error
    if given.shape == (3, 3):
        skew = [given[0, 1], given[1, 0], given[2, 0], given[2, 1], given[2, 2] - 1]
        if not np.abs(skew).max() < 1e-6:
            raise DataError(
                f"{where} has intrinsics that are no [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]: mend them"
            )
        given = given[[0, 1, 0, 1], [0, 1, 2, 2]]
    if given.shape != (4,):
        raise DataError(
            f"{where} has intrinsics of {given.size} numbers: write [fx, fy, cx, cy] or a 3x3 matrix"
        )
    fx, fy, cx, cy = given.tolist()
    return check_lens(Lens((height, width), (fx, fy), (cx, cy)), where)


def _nerfstudio(
    content: Mapping[str, Any], entries: Sequence[Mapping[str, Any]], where: Sequence[str], path: Path
) -> tuple[list[Lens], list[NDArray[np.float64]]]:
    undo = undo_applied(content, path)
    lenses, poses = [], []
    for entry, name in zip(entries, where, strict=True):
        lenses.append(frame_lens(entry, None, name, distorted=False))
        pose = frame_pose(entry, undo, name)
        pose[:3, :3] = pose[:3, :3] @ OPENGL
        poses.append(pose)
    return lenses, poses


def _checked_poses(poses: Sequence[NDArray[np.float64]], where: Sequence[str]) -> NDArray[np.float64]:
    """Return poses as ``(V, 4, 4)``; refuse those that are no rigid motion."""
    stacked = np.array(poses)
    for name, is_rigid in zip(where, are_rigid(stacked).tolist(), strict=True):
        if not is_rigid:
            raise DataError(
                f"{name} has a pose that is no rotation and place, or not finite: mend or remove it"
            )
    stacked[:, 3] = [0, 0, 0, 1]
    return stacked


def _names(listed: Sequence[Mapping[str, Any]], where: Sequence[str]) -> tuple[str, ...]:
    """Return the given names, or numbers for those without."""
    digits = max(3, len(str(len(listed) - 1)))
    names = [entry.get("name", f"{index:0{digits}d}") for index, entry in enumerate(listed)]
    used: dict[str, str] = {}
    for name, place in zip(names, where, strict=True):
        if not isinstance(name, str) or not _FILE_NAME.fullmatch(name) or name.endswith((".", " ")):
            raise DataError(f"{place} has the name {str(name)[:50]!r}, no file name: use letters and digits")
        # Some file systems take upper and lower case for the same.
        if name.lower() in used:
            raise DataError(f"{place} has the name of {used[name.lower()]}, {name!r}: give each its own")
        used[name.lower()] = place
    return tuple(names)
