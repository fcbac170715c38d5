# SPDX-License-Identifier: Apache-2.0
"""A prediction as a recording of Rerun (extra ``rerun``): boxes, meshes, a camera with its frames in time.

Everything is in the world of the input poses: metres, right-handed, +Z up.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import trimesh

from raytran.errors import ConfigError
from raytran.export.glb import object_name
from raytran.geometry.rotation import quaternion_from_matrix
from raytran.pictures.overlay import frame_image
from raytran.structs import ObjectSet, ScenePrediction, Views

if TYPE_CHECKING:
    import rerun

_TIMELINE = "frame"
_CAMERA = "world/camera"
_EDGE = 0.01
"""Radius of the lines of boxes, metres."""

_JPEG_QUALITY = 85


def check_rerun() -> None:
    """Raise unless the package that writes recordings is installed.

    Raises:
        ConfigError: it is not.
    """
    if importlib.util.find_spec("rerun") is None:
        raise ConfigError("rerun=true writes by the package rerun-sdk: pip install 'raytran[rerun]'")


def write_rerun(
    path: Path,
    prediction: ScenePrediction,
    meshes: Sequence[trimesh.Trimesh | None],
    views: Views | None = None,
    frame_ids: Sequence[str] = (),
) -> Path:
    """Write a scene as ``.rrd``; ``rerun FILE`` shows it.

    Boxes are ``world/objects/NN_class/box``, meshes ``…/mesh``; the camera ``world/camera`` moves along the
    timeline ``frame``, which counts the frames used from 0, and carries the image of each.

    Args:
        path: the file.
        prediction: ``M`` objects.
        meshes: of each object its mesh in world coordinates, or None.
        views: B = 1, what it was predicted from; None: there are no cameras.
        frame_ids: the name of each of its ``N`` frames.

    Returns:
        ``path``.

    Raises:
        ConfigError: the package that writes it is not installed.
    """
    check_rerun()
    import rerun

    # The same prediction makes the same recording: by default its name is drawn at random.
    recording = rerun.RecordingStream("raytran", recording_id=prediction.scene_id or "scene")
    memory = recording.memory_recording()
    recording.log("world", rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    for index, mesh in enumerate(meshes):
        _log_object(recording, prediction.objects, index, mesh)
    if views is not None:
        _log_cameras(recording, views, frame_ids)
    path.write_bytes(memory.drain_as_bytes())  # not `save`, which loses the error of a full disk
    return path


def _log_object(
    recording: rerun.RecordingStream, objects: ObjectSet, index: int, mesh: trimesh.Trimesh | None
) -> None:
    import rerun

    name = f"world/objects/{object_name(objects, index)}"
    color = objects.classes.colors[int(objects.label[index])]
    real, *imaginary = quaternion_from_matrix(objects.rotation[index].double()).tolist()
    box = rerun.Boxes3D(
        centers=[objects.center[index].tolist()],
        sizes=[objects.size[index].tolist()],
        quaternions=[rerun.Quaternion(xyzw=[*imaginary, real])],
        colors=[color],
        radii=[_EDGE],
        labels=[f"{objects.category[index]} {float(objects.score[index]):.2f}"],
    )
    recording.log(f"{name}/box", box, static=True)
    if mesh is not None:
        solid = rerun.Mesh3D(
            vertex_positions=np.asarray(mesh.vertices, np.float32),
            triangle_indices=np.asarray(mesh.faces, np.uint32),
            vertex_normals=np.asarray(mesh.vertex_normals, np.float32),
            albedo_factor=[*color, 255],
        )
        recording.log(f"{name}/mesh", solid, static=True)


def _log_cameras(recording: rerun.RecordingStream, views: Views, frame_ids: Sequence[str]) -> None:
    import rerun

    height, width = views.images.shape[-2:]
    for n, name in enumerate(frame_ids):
        recording.set_time(_TIMELINE, sequence=n)
        pose = views.world_from_camera[0, n].double().cpu().numpy()
        recording.log(_CAMERA, rerun.Transform3D(translation=pose[:3, 3], mat3x3=pose[:3, :3]))
        lens = rerun.Pinhole(
            image_from_camera=views.intrinsics[0, n].double().cpu().numpy(),
            resolution=[width, height],
            camera_xyz=rerun.ViewCoordinates.RDF,
        )
        recording.log(f"{_CAMERA}/image", lens)
        pixels = np.asarray(frame_image(views, n))
        recording.log(f"{_CAMERA}/image", rerun.Image(pixels).compress(jpeg_quality=_JPEG_QUALITY))
        recording.log(f"{_CAMERA}/name", rerun.TextLog(name))
