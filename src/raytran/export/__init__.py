# SPDX-License-Identifier: Apache-2.0
"""Predictions as files: ``scene.json``, one mesh per object, one coloured scene; and read back from files."""

from raytran.export.read import read_scene_json
from raytran.export.write import FORMAT, write_meshes, write_prediction, write_scene_json

__all__ = ["FORMAT", "read_scene_json", "write_meshes", "write_prediction", "write_scene_json"]
