# SPDX-License-Identifier: Apache-2.0
"""``scene.json``: the predicted objects of one scene as a text file that other programs read."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from raytran.data.files import write_text
from raytran.errors import DataError
from raytran.geometry.rotation import yaw_from_rotation
from raytran.structs import CLASSES, ObjectSet, ScenePrediction

FORMAT = "raytran.scene/1"
"""Value of ``format``; the number rises when a reader of the old form could misread the new one."""


def write_scene_json(path: Path, prediction: ScenePrediction, mesh_names: Sequence[str | None]) -> Path:
    """Write a prediction's objects, in their order.

    ``center`` and ``rotation`` are in the world of the input poses (+Z up, metres); ``size`` and ``rotation``
    follow the object frame (x width, y height, z depth; +Y up, front -Z); ``yaw`` is in radians. Where views
    were counted, ``num_views`` says how many saw the object's box and ``confidence`` is the score times
    ``n / (n + 1)`` of that number: what few saw is less certain than its score.

    Args:
        path: the file; written whole or not at all.
        prediction: its objects may be none.
        mesh_names: for each of the ``M`` objects the mesh file relative to ``path``'s folder, or None.

    Returns:
        ``path``.
    """
    objects = prediction.objects
    yaw = yaw_from_rotation(objects.rotation.double())
    entries = []
    for i, mesh in enumerate(mesh_names):
        entry: dict[str, Any] = {
            "category": CLASSES[int(objects.label[i])],
            "score": float(objects.score[i]),
            "center": objects.center[i].tolist(),
            "size": objects.size[i].tolist(),
            "rotation": objects.rotation[i].tolist(),
            "yaw": float(yaw[i]),
            "mesh": mesh,
        }
        if objects.num_views is not None:
            views = float(objects.num_views[i])
            entry |= {"num_views": round(views, 1), "confidence": entry["score"] * views / (views + 1)}
        if objects.model_id and objects.model_id[i]:
            entry["catid_cad"], entry["id_cad"] = objects.model_id[i].split("/", 1)
        entries.append(entry)
    content = {"format": FORMAT, "scene_id": prediction.scene_id, "up": "+z", "unit": "m", "objects": entries}
    write_text(path, json.dumps(content, indent=1, allow_nan=False) + "\n")
    return path


def read_scene_json(path: Path) -> ScenePrediction:
    """Read what ``write_scene_json`` wrote; the numbers are float64, as written.

    Returns:
        The objects, with symmetry 1 and no shapes. The file does not hold the voxel grid, so ``grid_center``
        is NaN.

    Raises:
        DataError: the file is missing, damaged, of another format, or names an unknown category.
    """
    try:
        content = json.loads(Path(path).read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise DataError(f"no scene file at {path}; write one with `python -m raytran.predict`") from error
    except (OSError, ValueError, RecursionError) as error:
        raise DataError(f"cannot read {path} as JSON ({error}); write it again") from error
    found = content.get("format") if isinstance(content, dict) else None
    if found != FORMAT:
        raise DataError(f"{path} has format {found!r}, this version reads {FORMAT!r}; write it again")
    try:
        return ScenePrediction(
            scene_id=str(content["scene_id"]),
            objects=_objects(content["objects"]),
            grid_center=torch.full((3,), torch.nan),
        )
    except (KeyError, TypeError, ValueError, RuntimeError, AttributeError, OverflowError) as error:
        raise DataError(
            f"an object in {path} is incomplete or malformed ({error!r}); write it again"
        ) from error


def _objects(entries: Sequence[dict[str, Any]]) -> ObjectSet:
    count = len(entries)

    def column(key: str, *shape: int) -> torch.Tensor:
        return torch.tensor([entry[key] for entry in entries], dtype=torch.float64).reshape(count, *shape)

    models = tuple("/".join((e["catid_cad"], e["id_cad"])) if e.get("id_cad") else "" for e in entries)
    return ObjectSet(
        label=torch.tensor([CLASSES.index(entry["category"]) for entry in entries], dtype=torch.int64),
        center=column("center", 3),
        size=column("size", 3),
        rotation=column("rotation", 3, 3),
        symmetry=torch.ones(count, dtype=torch.int64),
        score=column("score"),
        model_id=models if any(models) else (),
    )
