# SPDX-License-Identifier: Apache-2.0
"""What is made of CAD models ahead of training: copies, shapes, and the amodal masks of frames."""

from __future__ import annotations

import shutil
from pathlib import Path

import torch

from raytran.data.cache import MaskCache
from raytran.data.files import disk_full
from raytran.data.prepare.annotation import NO_CAD, Entry
from raytran.data.scan2cad import parse_entry, scene_objects
from raytran.data.shapenet.models import copy_model, has_model
from raytran.data.targets import foreground_masks, shape_grids
from raytran.errors import DataError
from raytran.geometry.camera import Cameras

_MASKS_AT_ONCE = 20


def prepare_model(model_id: str, source: Path, output: Path) -> tuple[str, str | None]:
    """Copy a model unless that is done, and cache its shape, a training target.

    Args:
        model_id: ``catid/id``.
        source: folder of ShapeNet, of either version.
        output: the prepared folder.

    Returns:
        the model and, if it cannot be used, why.

    Raises:
        DataError: the disk of ``output`` is full or read-only.
    """
    catid, name = model_id.split("/")
    try:
        if not has_model(source, catid, name):
            return model_id, NO_CAD
        copy_model(source, catid, name, output / "shapenet")
        shape_grids((model_id,), shapenet_root=output / "shapenet", cache=MaskCache(folder=output / "cache"))
    except (DataError, OSError) as error:
        check_disk(error, output)
        shutil.rmtree(output / "shapenet" / model_id, ignore_errors=True)
        return model_id, str(error)
    return model_id, None


def write_masks(entry: Entry, cameras: Cameras, output: Path) -> None:
    """Make the amodal masks that training will need, and cache them.

    Args:
        entry: annotation of the scan.
        cameras: of N frames.
        output: folder with ``shapenet/``; gets ``cache/``.

    Raises:
        DataError: a CAD model cannot be used, or the disk is full.
    """
    objects = scene_objects(parse_entry(entry))
    cache = MaskCache(folder=output / "cache")
    for start in range(0, len(cameras.intrinsics), _MASKS_AT_ONCE):
        chunk = cameras[start : start + _MASKS_AT_ONCE].to(torch.float32)
        foreground_masks(objects, chunk, shapenet_root=output / "shapenet", cache=cache)


def check_disk(error: BaseException, output: Path) -> None:
    """Raise an error for the user if ``error`` comes from a full or read-only disk.

    Raises:
        DataError: it does.
    """
    cause = disk_full(error)
    if cause is not None:
        raise DataError(
            f"cannot go on writing to {output} ({cause.strerror}): make room there and give the same command "
            "again, finished scans are kept"
        ) from error
