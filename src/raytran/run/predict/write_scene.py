# SPDX-License-Identifier: Apache-2.0
"""Write a predicted scene: every file a user looks at, in one folder."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import trimesh

from raytran.errors import ConfigError
from raytran.export import write_prediction
from raytran.export.cad_alignments import ALIGNMENTS, write_alignments_csv
from raytran.export.glb import write_glb
from raytran.export.nearest_cad import NearestCads, nearest_cads
from raytran.geometry.camera import Cameras
from raytran.pictures.overlay import draw_overlays
from raytran.pictures.topdown import draw_topdown
from raytran.pictures.turntable import draw_turntable
from raytran.run.output import replaced_folder
from raytran.structs import ObjectSet, ScenePrediction, Views
from raytran.viewer import has_viser
from raytran.viewer.data import VoxelVolume, write_viewer_data

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


def write_scene(
    output: Path,
    scene: PredictedScene,
    views: Views,
    frame_ids: Sequence[str],
    *,
    grid_extent: tuple[float, float, float],
    num_overlays: int = 4,
    turntable: int = 24,
    truth: ObjectSet | None = None,
) -> None:
    """Write what ``docs/outputs.md`` lists, all or nothing.

    Args:
        output: folder; replaced if it is an earlier result.
        scene: what was predicted.
        views: B = 1, what it was predicted from.
        frame_ids: name of each frame.
        grid_extent: sizes of the voxel grid, metres.
        num_overlays: frames to draw over.
        turntable: pictures of the turn in ``turntable.gif``; 0: there is none.
        truth: annotated objects to draw in the plan and to compare with, or None.

    Raises:
        ConfigError: ``output`` holds something that is no earlier result.
    """
    prediction = scene.prediction
    cameras = Cameras.of(views.scene())
    with replaced_folder(output, marker=MARKER) as folder:
        draw_topdown(
            folder / "topdown.png", prediction, truth=truth, cameras=cameras, grid_extent=grid_extent
        )
        if turntable:
            draw_turntable(
                folder / "turntable.gif",
                prediction.objects,
                scene.meshes,
                cameras=cameras,
                num_frames=turntable,
            )
        draw_overlays(folder / "overlays", views, frame_ids, prediction, scene.meshes, count=num_overlays)
        if scene.cads is not None:
            write_alignments_csv(folder / ALIGNMENTS, scene.cads.alignments())
            write_glb(folder / "cads.glb", prediction.objects, scene.cads.meshes())
        if scene.volumes is not None:
            write_viewer_data(folder, views, frame_ids, volumes=scene.volumes, truth=truth)
        write_prediction(
            folder, prediction, scene.meshes, cameras=cameras, frame_ids=frame_ids, grid_extent=grid_extent
        )
        if scene.volumes is not None and has_viser():
            # Here, since the package that draws is an extra.
            from raytran.viewer.server import write_html

            write_html(folder)
