# SPDX-License-Identifier: Apache-2.0
"""Write everything a prediction holds into one folder."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import trimesh

from raytran.errors import ShapeError
from raytran.export.mesh import write_glb, write_meshes
from raytran.export.scene_json import write_scene_json
from raytran.types import ScenePrediction


def write_prediction(
    folder: Path, prediction: ScenePrediction, meshes: Sequence[trimesh.Trimesh | None]
) -> list[Path]:
    """Write ``scene.json``, ``scene.glb`` and ``meshes/NN.ply``.

    The JSON is written last, so a folder that holds it is complete.

    Args:
        folder: made if it is missing.
        prediction: ``M`` objects, possibly none.
        meshes: for each object its mesh in world coordinates (metres), or None.

    Returns:
        The files, ``scene.json`` first.

    Raises:
        ShapeError: there are not as many meshes as objects.
    """
    objects = prediction.objects
    if len(meshes) != len(objects):
        raise ShapeError(
            f"expected one mesh or None per object, got {len(meshes)} for {len(objects)} objects"
        )
    folder.mkdir(parents=True, exist_ok=True)
    names = write_meshes(folder, objects, meshes)
    glb = write_glb(folder / "scene.glb", objects, meshes)
    scene = write_scene_json(folder / "scene.json", prediction, names)
    return [scene, glb, *(folder / name for name in names if name is not None)]
