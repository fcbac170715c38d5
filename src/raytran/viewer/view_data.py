# SPDX-License-Identifier: Apache-2.0
"""``view/``: what ``python -m raytran.view`` shows besides the objects and their meshes.

``view.json`` names everything else: small JPEGs of the frames with their cameras, and for each voxel volume
gzipped arrays of what is occupied, how many views saw it and which pixels it read. Where the true objects are
known they are there, with the errors of the predicted ones.
"""

from __future__ import annotations

import gzip
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from PIL import Image
from torch import Tensor

from raytran.data.files import write_json
from raytran.geometry.grid import VoxelGrid
from raytran.structs import CLASSES, ObjectSet, ScenePrediction, Views
from raytran.viewer.view_errors import object_errors
from raytran.viewer.view_reads import VoxelReads, pack_reads

FORMAT = "raytran.view/1"
"""Value of ``format``; the number rises when a reader of the old form could misread the new one."""

FOLDER = "view"

_LONGEST_SIDE = 480
_QUALITY = 80


@dataclass(frozen=True)
class ViewedVolume:
    """One voxel volume that was predicted.

    Attributes:
        grid: of one scene, ``center`` ``(3,)``.
        frames: which of the scene's frames it was predicted from.
        occupancy: ``(X, Y, Z)`` probability, or None.
        seen: ``(X, Y, Z)`` int, how many views have a ray through each voxel; or None.
        reads: which pixels each voxel read, numbered over ``frames``; or None.
    """

    grid: VoxelGrid
    frames: Sequence[int]
    occupancy: Tensor | None = None
    seen: Tensor | None = None
    reads: VoxelReads | None = None


def write_view_data(
    folder: Path,
    prediction: ScenePrediction,
    views: Views,
    frame_ids: Sequence[str],
    *,
    volumes: Sequence[ViewedVolume],
    truth: ObjectSet | None = None,
) -> Path:
    """Write ``view/`` into a result's folder.

    Args:
        folder: an existing folder, that of ``scene.json``.
        prediction: its objects in the order of ``scene.json``.
        views: B = 1, all frames.
        frame_ids: name of each frame.
        volumes: none if the network has no voxels.
        truth: the annotated objects, or None if they are not known.

    Returns:
        ``view/view.json``, which is written last.
    """
    target = folder / FOLDER
    (target / "frames").mkdir(parents=True, exist_ok=True)
    content: dict[str, Any] = {
        "format": FORMAT,
        "scene_id": prediction.scene_id,
        "image_size": list(views.image_size),
        "frames": [_write_frame(target, views, n, name) for n, name in enumerate(frame_ids)],
        "volumes": [_write_volume(target, n, volume) for n, volume in enumerate(volumes)],
        "truth": None,
        "errors": None,
    }
    if truth is not None:
        content["truth"] = _objects(truth)
        content["errors"] = object_errors(prediction.objects, truth)
    write_json(target / "view.json", content)
    return target / "view.json"


def _write_frame(target: Path, views: Views, index: int, name: str) -> dict[str, Any]:
    pixels = views.images[0, index, :3].cpu()
    if pixels.is_floating_point():
        pixels = (pixels * 255).round().clamp(0, 255).to(torch.uint8)
    image = Image.fromarray(pixels.permute(1, 2, 0).numpy())
    image.thumbnail((_LONGEST_SIDE, _LONGEST_SIDE))
    file = f"frames/{index:04d}.jpg"
    image.save(target / file, quality=_QUALITY)
    return {
        "name": name,
        "image": file,
        "intrinsics": views.intrinsics[0, index].tolist(),
        "world_from_camera": views.world_from_camera[0, index].tolist(),
    }


def _write_volume(target: Path, number: int, volume: ViewedVolume) -> dict[str, Any]:
    grid = volume.grid
    entry: dict[str, Any] = {
        "resolution": list(grid.resolution),
        "extent": list(grid.extent),
        "center": grid.center.tolist(),
        "frames": list(volume.frames),
        "occupancy": None,
        "seen": None,
        "reads": None,
    }

    def write(name: str, values: Tensor) -> str:
        file = f"volume{number}_{name}.gz"
        content = values.detach().cpu().numpy()
        little_endian = content.astype(content.dtype.newbyteorder("<")).tobytes()
        (target / file).write_bytes(gzip.compress(little_endian, 6, mtime=0))
        return file

    if volume.occupancy is not None:
        entry["occupancy"] = write("occupancy", (volume.occupancy * 255).round().to(torch.uint8))
    if volume.seen is not None:
        entry["seen"] = write("seen", volume.seen.clamp(max=2**15 - 1).to(torch.int16))
    if volume.reads is not None:
        packed = pack_reads(volume.reads)
        entry["reads"] = {
            "feature_size": list(volume.reads.feature_size),
            "cut": packed.cut / 255,
            "offsets": write("offsets", packed.offsets),
            "steps": write("steps", packed.steps),
            "weights": write("weights", packed.weights),
        }
    return entry


def _objects(objects: ObjectSet) -> list[dict[str, Any]]:
    return [
        {
            "category": CLASSES[int(objects.label[i])],
            "center": objects.center[i].tolist(),
            "size": objects.size[i].tolist(),
            "rotation": objects.rotation[i].tolist(),
            "symmetry": int(objects.symmetry[i]),
        }
        for i in range(len(objects))
    ]
