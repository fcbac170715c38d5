# SPDX-License-Identifier: Apache-2.0
"""Predictions as files: ``scene.json``, one mesh per object, and one coloured scene."""

from raytran.export.mesh import write_meshes
from raytran.export.scene_json import FORMAT, read_scene_json, write_scene_json
from raytran.export.write import write_prediction

__all__ = ["FORMAT", "read_scene_json", "write_meshes", "write_prediction", "write_scene_json"]
