# SPDX-License-Identifier: Apache-2.0
"""``viewer.npz``: what the viewer shows of a prediction besides its objects and meshes.

One file of plain arrays, read without pickle: small JPEGs of the frames with their cameras; for each voxel
volume what is occupied, how many views saw it and which pixels it read; the true objects if they are known.
"""

from __future__ import annotations

import io
import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
import trimesh
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from raytran.classes import PAPER_CLASSES, Classes
from raytran.data.images import decode_image
from raytran.data.scannet.text import are_rigid
from raytran.data.text import as_name, parse_json
from raytran.errors import DataError, RaytranError
from raytran.export import read_scene_json
from raytran.geometry.camera import Cameras
from raytran.geometry.grid import VoxelGrid
from raytran.limits import (
    BOX_SIDE,
    FOCAL_LENGTH,
    MATRIX_ENTRY,
    PIXEL,
    POSITION,
    SCORE,
    SIDE,
    Quantity,
    as_count,
    as_numbers,
    shown,
)
from raytran.ops.traverse import trace_pairs
from raytran.pictures.overlay import frame_image
from raytran.structs import ObjectSet, ScenePrediction, Views
from raytran.viewer.archive import read_arrays
from raytran.viewer.attention import ReadPixels, VoxelReads, attention_weights, pack_reads
from raytran.viewer.truth import ObjectError, object_errors

if TYPE_CHECKING:
    # Not to read a result: the network alone takes seconds to import.
    from raytran.model import RayTran
    from raytran.viewer.attention_record import ObservedAttention

FILE = "viewer.npz"
FORMAT = "raytran.viewer/1"
"""Value of ``format``; the number rises when a reader of the old form could misread the new one."""

SCENE = "scene.json"
MAX_SCENES = 1000
"""Scenes to choose from; of more, the first by name."""

_DEPTH = 3
"""Folders below the one given that are searched."""

_TRUTH = ("label", "center", "size", "rotation", "symmetry", "score")
"""What is stored of the true objects, in the order of ``ObjectSet``."""

_INTRINSIC = Quantity("a focal length or a pixel", PIXEL.low, FOCAL_LENGTH.high)

_LONGEST_SIDE = 480
_QUALITY = 80


@dataclass(frozen=True)
class VoxelVolume:
    """One voxel volume that was predicted.

    Attributes:
        grid: of one scene, ``center`` ``(3,)``.
        frames: which of the scene's frames it was predicted from.
        occupancy: ``(X, Y, Z)`` probability, or None.
        view_count: ``(X, Y, Z)`` int, how many views have a ray through each voxel; or None.
        reads: which pixels each voxel read, of the views in ``frames``; or None.
    """

    grid: VoxelGrid
    frames: Sequence[int]
    occupancy: Tensor | None = None
    view_count: Tensor | None = None
    reads: VoxelReads | None = None

    def voxel_at(self, point: NDArray[np.float64]) -> tuple[int, int, int] | None:
        """Return the indices of the voxel at a point ``(3,)`` in the world, None outside."""
        x, y, z = self.grid.voxel_from_world(torch.as_tensor(point)[None])[0].floor().long().tolist()
        inside = all(0 <= i < n for i, n in zip((x, y, z), self.grid.resolution, strict=True))
        return (x, y, z) if inside else None

    def pixels_of(self, voxel: tuple[int, int, int]) -> ReadPixels | None:
        """Return what a voxel read, the views numbered as the scene's frames; None if it is not known."""
        if self.reads is None:
            return None
        pixels = self.reads.of_voxel(int(self.grid.flat_index(torch.tensor(voxel))))
        return pixels._replace(view=np.asarray(self.frames, dtype=np.int64)[pixels.view])


@dataclass(frozen=True)
class ViewerScene:
    """A result as the viewer shows it.

    Attributes:
        scene_id: name.
        objects: the ``M`` predicted objects, surest first.
        meshes: of each object, in the world; None: empty shape.
        frame_ids: name of each of the ``N`` frames.
        images: of each frame, ``(rows, columns, 3)`` uint8, smaller than the camera's image size.
        cameras: ``(N,)``.
        volumes: the first is the whole one; if there are more, these know what their voxels read.
        truth: the true objects, or None if they are not known.
        errors: of each object where the truth is known, see ``object_errors``.
    """

    scene_id: str
    objects: ObjectSet
    meshes: Sequence[trimesh.Trimesh | None]
    frame_ids: Sequence[str]
    images: Sequence[NDArray[np.uint8]]
    cameras: Cameras
    volumes: Sequence[VoxelVolume]
    truth: ObjectSet | None
    errors: Sequence[ObjectError | None]

    def camera(self, frame: int) -> Cameras:
        """Return the camera of one frame, no leading dimensions."""
        return self.cameras[frame]

    @property
    def occupancy(self) -> Tensor | None:
        """``(X, Y, Z)`` probability in the first volume, or None."""
        return self.volumes[0].occupancy if self.volumes else None

    def volume_at(self, point: NDArray[np.float64]) -> VoxelVolume | None:
        """Return the volume whose voxel at a point to show: the nearest of those that know what it read."""
        there = [volume for volume in self.volumes if volume.voxel_at(point) is not None]
        knowing = [volume for volume in there if volume.reads is not None] or there

        def distance(volume: VoxelVolume) -> float:
            offset = (torch.as_tensor(point) - volume.grid.center) / torch.tensor(volume.grid.extent)
            return float(offset.norm())

        return min(knowing, key=distance, default=None)


def predicted_volumes(
    model: RayTran,
    views: Views,
    prediction: ScenePrediction,
    observed: ObservedAttention | None,
    *,
    parts: Sequence[tuple[Tensor, Sequence[int]]] = (),
) -> list[VoxelVolume]:
    """Return the voxels of a prediction, and from which pixels the last block gathered what they hold.

    Args:
        model: the network that ran.
        views: B = 1, all frames.
        prediction: its result, on the CPU.
        observed: what was recorded while it ran (``observe_attention``), or None.
        parts: centre ``(3,)`` and frames of each run of the network, if it was not one on all frames.

    Returns:
        the prediction's grid, and if there are several parts each of these with what it read; none if the
        prediction has no voxels.
    """
    whole = whole_volume(prediction, views)
    if not whole or observed is None:
        return whole
    runs = parts or [(prediction.grid_center, whole[0].frames)]
    read = _read_volumes(model, views, observed, runs)
    return [replace(whole[0], reads=read[0].reads)] if len(read) == 1 else [*whole, *read]


def whole_volume(prediction: ScenePrediction, views: Views) -> list[VoxelVolume]:
    """Return the one volume of a prediction, of which is not known what it read; none if it has no voxels."""
    if prediction.occupancy is None or prediction.grid_extent is None:
        return []
    x, y, z = prediction.occupancy.shape
    grid = VoxelGrid((x, y, z), prediction.grid_extent, prediction.grid_center)
    return [VoxelVolume(grid, range(views.images.shape[1]), prediction.occupancy, prediction.seen)]


def _read_volumes(
    model: RayTran, views: Views, observed: ObservedAttention, runs: Sequence[tuple[Tensor, Sequence[int]]]
) -> list[VoxelVolume]:
    """Return the volume of each run of the network with what its voxels read."""
    stride, (height, width) = model.backbone.stride, views.image_size
    size = (height // stride, width // stride)
    features = observed.runs([len(frames) * size[0] * size[1] for _, frames in runs])
    volumes = []
    for (center, frames), (query, key) in zip(runs, features, strict=True):
        cameras = Cameras.of(views.scene())[list(frames)].to("cpu")
        grid = VoxelGrid(model.grid_resolution, model.grid_extent, center.to(cameras.position))
        pairs = trace_pairs(cameras, grid, size, model.rays_per_cell)
        reads = pack_reads(attention_weights(query, key, pairs), pairs, size)
        volumes.append(VoxelVolume(grid, frames, reads=reads))
    return volumes


def write_viewer_data(
    folder: Path,
    views: Views,
    frame_ids: Sequence[str],
    *,
    volumes: Sequence[VoxelVolume],
    truth: ObjectSet | None = None,
) -> Path:
    """Write ``viewer.npz`` into a result's folder.

    Args:
        folder: an existing folder, that of ``scene.json``.
        views: B = 1, all frames.
        frame_ids: name of each frame.
        volumes: none if the network has no voxels.
        truth: the annotated objects, or None if they are not known.

    Returns:
        the file.
    """
    about: dict[str, Any] = {
        "format": FORMAT,
        "image_size": views.image_size,
        "frame_ids": list(frame_ids),
        "volumes": [_about_volume(volume) for volume in volumes],
        "has_truth": truth is not None,
    }
    if truth is not None and truth.classes != PAPER_CLASSES:
        about["classes"] = truth.classes.settings()
    arrays: dict[str, NDArray[Any]] = {
        "about": np.frombuffer(json.dumps(about).encode(), dtype=np.uint8),
        "intrinsics": views.intrinsics[0].double().cpu().numpy(),
        "world_from_camera": views.world_from_camera[0].double().cpu().numpy(),
    }
    if views.picture is not None:
        arrays["picture"] = views.picture[0].double().cpu().numpy()
    for n in range(len(frame_ids)):
        arrays[f"frame{n}"] = _jpeg(frame_image(views, n))
    for n, volume in enumerate(volumes):
        arrays |= {f"volume{n}_{name}": values for name, values in _volume_arrays(volume).items()}
    if truth is not None:
        for name in _TRUTH:
            arrays[f"truth_{name}"] = getattr(truth, name).cpu().numpy()
    np.savez_compressed(folder / FILE, **arrays)  # type: ignore[arg-type]
    return folder / FILE


def _about_volume(volume: VoxelVolume) -> dict[str, Any]:
    grid = volume.grid
    return {
        "resolution": grid.resolution,
        "extent": grid.extent,
        "center": grid.center.tolist(),
        "frames": list(volume.frames),
        "feature_size": volume.reads.feature_size if volume.reads is not None else None,
    }


def _volume_arrays(volume: VoxelVolume) -> dict[str, NDArray[Any]]:
    arrays: dict[str, NDArray[Any]] = {}
    if volume.occupancy is not None:
        arrays["occupancy"] = (volume.occupancy * 255).round().to(torch.uint8).cpu().numpy()
    if volume.view_count is not None:
        arrays["view_count"] = volume.view_count.clamp(max=2**15 - 1).to(torch.int16).cpu().numpy()
    if volume.reads is not None:
        arrays |= {name: getattr(volume.reads, name) for name in ("offsets", "steps", "weights")}
    return arrays


def _jpeg(image: Image.Image) -> NDArray[np.uint8]:
    image.thumbnail((_LONGEST_SIDE, _LONGEST_SIDE))
    content = io.BytesIO()
    image.save(content, format="jpeg", quality=_QUALITY)
    return np.frombuffer(content.getvalue(), dtype=np.uint8)


def read_viewer_scene(folder: Path) -> ViewerScene:
    """Read a result: ``scene.json``, ``meshes/NN.ply`` and ``viewer.npz``.

    Without the latter, the result of ``viewer=false`` or of another program, there are objects alone.

    Raises:
        DataError: a file is damaged or of another format.
    """
    result = read_scene_json(folder / SCENE)
    objects = result.objects
    meshes = [_read_mesh(folder / f"meshes/{i:02d}.ply") for i in range(len(objects))]
    about: dict[str, Any] = {"frame_ids": [], "image_size": (1, 1), "volumes": [], "has_truth": False}
    arrays: dict[str, NDArray[Any]] = {
        "intrinsics": np.zeros((0, 3, 3)),
        "world_from_camera": np.zeros((0, 4, 4)),
    }
    path = folder / FILE
    try:
        if path.exists():
            arrays = read_arrays(path)
            about = parse_json(arrays["about"].tobytes().decode(), "its description")
            if about["format"] != FORMAT:
                raise ValueError(f"format {shown(about['format'])}, this version reads {FORMAT!r}")
        truth = _truth(arrays, Classes.of(about.get("classes"))) if about["has_truth"] else None
        if truth is not None and truth.classes.names != objects.classes.names:
            raise ValueError(f"its true objects have other classes than {SCENE}")
        names = [as_name(name, "a frame's name") for name in about["frame_ids"]]
        return ViewerScene(
            scene_id=result.scene_id,
            objects=objects,
            meshes=meshes,
            frame_ids=names,
            images=[_image(arrays[f"frame{n}"]) for n in range(len(names))],
            cameras=_cameras(arrays, about["image_size"], len(names)),
            volumes=[_volume(entry, n, arrays, len(names)) for n, entry in enumerate(about["volumes"])],
            truth=truth,
            errors=[None] * len(objects) if truth is None else object_errors(objects, truth),
        )
    except (OSError, ValueError, KeyError, TypeError, RuntimeError, RaytranError) as error:
        raise DataError(f"cannot read {path} ({str(error)[:120]}): predict again") from error


def _cameras(arrays: Mapping[str, NDArray[Any]], image_size: Any, count: int) -> Cameras:
    height, width = as_numbers(image_size, (2,), SIDE, "image_size").astype(int).tolist()
    intrinsics = as_numbers(
        arrays["intrinsics"],
        (count, 3, 3),
        _INTRINSIC,
        "intrinsics",
    )
    poses = as_numbers(arrays["world_from_camera"], (count, 4, 4), MATRIX_ENTRY, "world_from_camera")
    if (intrinsics[:, [0, 1], [0, 1]] < FOCAL_LENGTH.low).any() or not are_rigid(poses).all():
        raise ValueError("a camera is none that can be")
    picture = None
    if "picture" in arrays:
        picture = torch.from_numpy(as_numbers(arrays["picture"], (count, 4), PIXEL, "picture"))
    return Cameras(torch.from_numpy(intrinsics), torch.from_numpy(poses), (height, width), picture)


def _read_mesh(path: Path) -> trimesh.Trimesh | None:
    if not path.is_file():
        return None
    try:
        with np.errstate(all="ignore"):  # what numbers there are is looked at below
            mesh = trimesh.load_mesh(path, process=False, skip_materials=True)
    except Exception as error:  # trimesh raises whatever its parser stumbles over
        raise DataError(f"cannot read the mesh {path} ({str(error)[:80]!r}): predict again") from error
    if not isinstance(mesh, trimesh.Trimesh) or not (np.abs(mesh.vertices) <= POSITION.high).all():
        raise DataError(f"the mesh {path} has vertices that are nowhere, or none at all: predict again")
    return mesh


def _image(content: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return decode_image(content.tobytes(), name=f"of a frame in {FILE}").permute(1, 2, 0).numpy()


def _truth(arrays: Mapping[str, NDArray[Any]], classes: Classes) -> ObjectSet:
    label, center, size, rotation, symmetry, score = (arrays[f"truth_{name}"] for name in _TRUTH)
    count = len(label)
    as_numbers(label, (count,), Quantity("a class", 0, len(classes) - 1), "label")
    as_numbers(symmetry, (count,), Quantity("a symmetry", 0, 64), "symmetry")
    as_numbers(center, (count, 3), POSITION, "center")
    as_numbers(size, (count, 3), BOX_SIDE, "size")
    as_numbers(rotation, (count, 3, 3), MATRIX_ENTRY, "rotation")
    as_numbers(score, (count,), SCORE, "score")
    return ObjectSet(
        label=torch.from_numpy(label.astype(np.int64)),
        center=torch.from_numpy(center),
        size=torch.from_numpy(size),
        rotation=torch.from_numpy(rotation),
        symmetry=torch.from_numpy(symmetry.astype(np.int64)),
        score=torch.from_numpy(score),
        classes=classes,
    )


def _volume(
    entry: Mapping[str, Any], number: int, arrays: Mapping[str, NDArray[Any]], num_frames: int
) -> VoxelVolume:
    x, y, z = entry["resolution"]
    a, b, c = entry["extent"]
    center = torch.from_numpy(as_numbers(entry["center"], (3,), POSITION, "center"))
    grid = VoxelGrid((x, y, z), (a, b, c), center)
    frames = [as_count(frame, 0, num_frames - 1, "a frame") for frame in entry["frames"]]
    occupancy = arrays.get(f"volume{number}_occupancy")
    view_count = arrays.get(f"volume{number}_view_count")
    reads = None
    if entry["feature_size"] is not None:
        reads = _reads(entry["feature_size"], number, arrays, num_voxels=x * y * z, num_views=len(frames))
    return VoxelVolume(
        grid=grid,
        frames=frames,
        occupancy=None if occupancy is None else torch.from_numpy(occupancy).reshape(x, y, z) / 255,
        view_count=None if view_count is None else torch.from_numpy(view_count).reshape(x, y, z),
        reads=reads,
    )


def _reads(
    feature_size: Any, number: int, arrays: Mapping[str, NDArray[Any]], *, num_voxels: int, num_views: int
) -> VoxelReads:
    """Return which pixels voxels read, after checking that each is one of the volume's views."""
    offsets, steps, weights = (arrays[f"volume{number}_{n}"] for n in ("offsets", "steps", "weights"))
    height, width = as_numbers(feature_size, (2,), SIDE, "feature_size").astype(int).tolist()
    are_whole = all(values.dtype.kind in "iu" and values.ndim == 1 for values in (offsets, steps, weights))
    if not are_whole or len(steps) != len(weights) or len(offsets) != num_voxels + 1:
        raise ValueError(f"volume {number} has other arrays than voxels")
    if offsets[0] != 0 or offsets[-1] != len(steps) or (np.diff(offsets.astype(np.int64)) < 0).any():
        raise ValueError(f"volume {number} reads other pixels than there are")
    # The distances of a voxel's pixels add up from its first: no voxel's sum may pass the last pixel.
    total = np.concatenate([[0], steps.astype(np.int64).cumsum()])
    if len(steps) and (steps.min() < 0 or np.diff(total[offsets]).max() >= num_views * height * width):
        raise ValueError(f"volume {number} reads other pixels than there are")
    return VoxelReads(offsets, steps, weights, (height, width))


def find_scenes(folder: Path) -> dict[str, Path]:
    """Return the results in a folder, by the name to call each.

    Args:
        folder: one result of ``raytran.predict``, or a folder with results in it or a little below.

    Raises:
        DataError: the folder is missing or holds none.
    """
    if not folder.is_dir():
        raise DataError(f"no folder {folder}: give the output folder of `raytran predict`")
    folder = folder.resolve()
    if (folder / SCENE).is_file():
        return {folder.name: folder}
    scenes: dict[str, Path] = {}
    for where, below, files in os.walk(folder):
        path = Path(where)
        if SCENE in files:
            scenes[path.relative_to(folder).as_posix()] = path
        finished = SCENE in files or len(path.relative_to(folder).parts) >= _DEPTH
        below[:] = [] if finished else sorted(name for name in below if not name.startswith("."))
    if not scenes:
        raise DataError(
            f"{folder} holds no {SCENE}: give the output folder of `raytran predict`, "
            "or one with such folders in it"
        )
    return dict(sorted(scenes.items())[:MAX_SCENES])
