# SPDX-License-Identifier: Apache-2.0
"""Write a predicted scene: every file a user looks at, in one folder."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import trimesh

from raytran.errors import ConfigError, ShapeError
from raytran.export import write_prediction
from raytran.export.cad_alignments import ALIGNMENTS, write_alignments_csv
from raytran.export.glb import write_glb
from raytran.export.nearest_cad import NearestCads, nearest_cads
from raytran.export.rerun_file import write_rerun
from raytran.export.simplify import MESH_ERROR, simplify
from raytran.geometry.camera import Cameras
from raytran.pictures.overlay import draw_overlays
from raytran.pictures.topdown import draw_topdown
from raytran.pictures.turntable import draw_turntable
from raytran.postprocess import object_meshes
from raytran.run.output import replaced_folder
from raytran.structs import ObjectSet, ScenePrediction, Views
from raytran.viewer import MISSING, has_viser
from raytran.viewer.data import VoxelVolume, whole_volume, write_viewer_data

MARKER = "scene.json"
"""The file that tells a finished result."""


@dataclass(frozen=True)
class PredictedScene:
    """A prediction whose best objects were chosen, and what was made of it.

    Attributes:
        prediction: its ``M`` objects.
        meshes: of each object, in the world; None: empty shape.
        cads: the CAD model of each object; None: not asked for.
        volumes: the voxels for the viewer; None: nothing is written for it.
    """

    prediction: ScenePrediction
    meshes: Sequence[trimesh.Trimesh | None]
    cads: NearestCads | None = None
    volumes: Sequence[VoxelVolume] | None = None

    @staticmethod
    def of(
        prediction: ScenePrediction,
        *,
        mesh_error: float = MESH_ERROR,
        volumes: Sequence[VoxelVolume] | None = None,
    ) -> PredictedScene:
        """Return a prediction with the meshes of its objects.

        Args:
            prediction: on the CPU.
            mesh_error: farthest that a mesh may lie from the surface of its shape, metres; 0: every triangle.
            volumes: as of the attribute.

        Raises:
            ConfigError: ``mesh_error`` is no length.
        """
        meshes = [None if mesh is None else simplify(mesh, mesh_error) for mesh in object_meshes(prediction)]
        return PredictedScene(prediction, meshes, volumes=volumes)

    def with_cads(self, root: Path) -> PredictedScene:
        """Return the scene with the CAD models of a library that its objects are most like.

        Raises:
            DataError: ``root`` holds no CAD model.
        """
        cads = nearest_cads(self.prediction.objects, root)
        return replace(self, prediction=replace(self.prediction, objects=cads.objects), cads=cads)


def check_pictures(**counts: object) -> None:
    """Raise unless each of the settings is a number of pictures.

    Raises:
        ConfigError: one is not; it is named.
    """
    for name, count in counts.items():
        if isinstance(count, bool) or not isinstance(count, int) or count < 0:
            raise ConfigError(f"{name}={count} is no number of pictures: give 0 or more")


def save_prediction(
    folder: Path,
    prediction: ScenePrediction,
    views: Views | None,
    *,
    frame_ids: Sequence[str] = (),
    mesh_error: float = MESH_ERROR,
    obj: bool = False,
) -> Path:
    """See ``ScenePrediction.save``."""
    prediction = prediction.to("cpu")
    if not prediction.scene_id:
        prediction = replace(prediction, scene_id=folder.resolve().name)
    if views is None:
        scene = PredictedScene.of(prediction, mesh_error=mesh_error)
        write_scene(folder, scene, obj=obj)
        return folder
    views = views.to("cpu")
    names = tuple(frame_ids) or tuple(f"{number:06d}" for number in range(views.images.shape[1]))
    if len(names) != views.images.shape[1]:
        raise ShapeError(f"expected a name for each view, got {len(names)} for {views.images.shape[1]} views")
    volumes = whole_volume(prediction, views)
    write_scene(
        folder, PredictedScene.of(prediction, mesh_error=mesh_error, volumes=volumes), views, names, obj=obj
    )
    return folder


def show_prediction(prediction: ScenePrediction, views: Views | None, *, height: int) -> None:
    """See ``ScenePrediction.show``."""
    if not has_viser():
        raise ConfigError(MISSING)
    from raytran.viewer import show

    prediction = prediction.to("cpu")
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        scene = PredictedScene.of(prediction)
        if views is not None:
            views = views.to("cpu")
            names = [f"{number:06d}" for number in range(views.images.shape[1])]
            write_viewer_data(folder, views, names, volumes=whole_volume(prediction, views))
        write_prediction(folder, replace(prediction, scene_id=prediction.scene_id or "scene"), scene.meshes)
        show(folder, height=height)


def write_scene(
    output: Path,
    scene: PredictedScene,
    views: Views | None = None,
    frame_ids: Sequence[str] = (),
    *,
    num_overlays: int = 4,
    turntable: int = 24,
    obj: bool = False,
    rerun: bool = False,
    truth: ObjectSet | None = None,
) -> None:
    """Write what ``docs/outputs.md`` lists, all or nothing.

    Args:
        output: folder; replaced if it is an earlier result.
        scene: what was predicted.
        views: B = 1, what it was predicted from; None: there are no pictures of frames, and no cameras.
        frame_ids: name of each frame.
        num_overlays: frames to draw over.
        turntable: pictures of the turn in ``turntable.gif``; 0: there is none.
        obj: write each mesh as OBJ too.
        rerun: write ``scene.rrd`` too.
        truth: annotated objects to draw in the plan and to compare with, or None.

    Raises:
        ConfigError: ``output`` holds something that is no earlier result.
    """
    prediction = scene.prediction
    cameras = None if views is None else Cameras.of(views.scene())
    with replaced_folder(output, marker=MARKER) as folder:
        draw_topdown(folder / "topdown.png", prediction, truth=truth, cameras=cameras)
        if turntable:
            draw_turntable(
                folder / "turntable.gif",
                prediction.objects,
                scene.meshes,
                cameras=cameras,
                num_frames=turntable,
            )
        if views is not None:
            draw_overlays(folder / "overlays", views, frame_ids, prediction, scene.meshes, count=num_overlays)
        if scene.cads is not None:
            write_alignments_csv(folder / ALIGNMENTS, scene.cads.alignments())
            write_glb(folder / "cads.glb", prediction.objects, scene.cads.meshes())
        if views is not None and scene.volumes is not None:
            write_viewer_data(folder, views, frame_ids, volumes=scene.volumes, truth=truth)
        if rerun:
            write_rerun(folder / "scene.rrd", prediction, scene.meshes, views, frame_ids)
        write_prediction(folder, prediction, scene.meshes, cameras=cameras, frame_ids=frame_ids, obj=obj)
        if views is not None and scene.volumes is not None and has_viser():
            # Here, since the package that draws is an extra.
            from raytran.viewer.server import write_html

            write_html(folder)
