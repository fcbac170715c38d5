# SPDX-License-Identifier: Apache-2.0
"""Write everything a prediction holds into one folder."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import trimesh

from raytran.errors import ShapeError
from raytran.export.glb import write_glb
from raytran.export.mesh import write_meshes
from raytran.export.occupancy import write_occupancy
from raytran.export.scene_json import write_scene_json
from raytran.geometry.camera import Cameras
from raytran.structs import ScenePrediction


def write_prediction(
    folder: Path,
    prediction: ScenePrediction,
    meshes: Sequence[trimesh.Trimesh | None],
    *,
    cameras: Cameras | None = None,
    frame_ids: Sequence[str] = (),
    grid_extent: tuple[float, float, float] | None = None,
) -> list[Path]:
    """Write ``scene.json``, ``scene.glb``, ``meshes/`` and ``occupancy.ply``.

    The JSON is written last, so a folder that holds it is complete.

    Args:
        folder: made if it is missing.
        prediction: ``M`` objects, possibly none.
        meshes: for each object its mesh in world coordinates (metres), or None.
        cameras: ``(N,)`` cameras of the frames used, for ``scene.glb``; None: it has none.
        frame_ids: the name of each of the ``N`` frames.
        grid_extent: sizes of the voxel grid, metres; without them, or without an occupancy, there is no
            ``occupancy.ply``.

    Returns:
        The files, ``scene.json`` first.

    Raises:
        ShapeError: there are not as many meshes as objects, or frame names as cameras.
    """
    objects = prediction.objects
    if len(meshes) != len(objects):
        raise ShapeError(
            f"expected one mesh or None per object, got {len(meshes)} for {len(objects)} objects"
        )
    if cameras is not None and len(frame_ids) != len(cameras.intrinsics):
        raise ShapeError(
            f"expected a name for each frame, got {len(frame_ids)} for {len(cameras.intrinsics)} cameras"
        )
    folder.mkdir(parents=True, exist_ok=True)
    names = write_meshes(folder, objects, meshes)
    files = [write_glb(folder / "scene.glb", objects, meshes, cameras=cameras, frame_ids=frame_ids)]
    if (occupancy := prediction.occupancy) is not None and grid_extent is not None:
        path, center = folder / "occupancy.ply", prediction.grid_center
        files.append(write_occupancy(path, occupancy, center=center, extent=grid_extent))
    files += [folder / name for name in names if name is not None]
    return [write_scene_json(folder / "scene.json", prediction, names), *files]
