# SPDX-License-Identifier: Apache-2.0
"""What can be scored without looking: ``python benchmarks/layout_prior.py ROOT --split test --output DIR``.

Every scene of the split gets the same furniture around its cameras: the classes, places and directions that
the training rooms hold most often, each with the median height and size of its class there. The files go to
``raytran evaluate predictions=DIR``.
"""

from __future__ import annotations

import argparse
import math
from collections import Counter
from pathlib import Path

import torch
from torch import Tensor

from raytran.data.scan2cad import read_annotations, scene_objects
from raytran.data.scannet.scan import read_scan
from raytran.data.scene_list import read_split
from raytran.export import write_scene_json
from raytran.geometry.rotation import rotation_from_yaw, yaw_from_rotation
from raytran.structs import ObjectSet, ScenePrediction

CELL = 0.4
"""Side of the cells in which places are counted, metres: right to 20 cm in the middle of its cell."""

TURNS = 12
"""Directions that are told apart."""


def camera_center(root: Path, scene_id: str) -> Tensor:
    """Return the mean of the cameras' positions, ``(3,)``, the only thing that is read of a scene."""
    scan = read_scan(root / "scannet" / "scans" / scene_id)
    return torch.as_tensor(scan.world_from_camera)[:, :3, 3].double().mean(dim=0)


def objects_around(root: Path, scene_ids: list[str], objects_of: dict[str, ObjectSet]) -> ObjectSet:
    """Return the objects of all scenes together, places relative to their scene's cameras."""
    parts = [(objects_of[name], camera_center(root, name)) for name in scene_ids]
    return ObjectSet(
        label=torch.cat([objects.label for objects, _ in parts]),
        center=torch.cat([objects.center - center for objects, center in parts]),
        size=torch.cat([objects.size for objects, _ in parts]),
        rotation=torch.cat([objects.rotation for objects, _ in parts]),
        symmetry=torch.cat([objects.symmetry for objects, _ in parts]),
        score=torch.cat([objects.score for objects, _ in parts]),
    )


def most_frequent(known: ObjectSet, count: int) -> ObjectSet:
    """Return the ``count`` most frequent combinations of class, place and direction, with median sizes."""
    cell = (known.center[:, :2] / CELL).round().long()
    turn = (yaw_from_rotation(known.rotation) / (2 * math.pi / TURNS)).round().long() % TURNS
    found = Counter(map(tuple, torch.column_stack([known.label, cell, turn]).tolist())).most_common(count)
    rows = torch.tensor([row for row, _ in found])
    of_class = [known.label == label for label in rows[:, 0]]
    height = torch.stack([known.center[same, 2].median() for same in of_class])
    return ObjectSet(
        label=rows[:, 0],
        center=torch.column_stack([rows[:, 1:3] * CELL, height]),
        size=torch.stack([known.size[same].median(dim=0).values for same in of_class]),
        rotation=rotation_from_yaw(rows[:, 3].double() * (2 * math.pi / TURNS)),
        symmetry=torch.ones(len(rows), dtype=torch.int64),
        score=torch.tensor([times for _, times in found]).double() / found[0][1],
    )


def main() -> None:
    """Write one ``<scene_id>.json`` for every scene of the split."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("root", type=Path, help="data set, as prepare writes it")
    parser.add_argument("--split", default="val")
    parser.add_argument("--output", type=Path, required=True)
    arguments = parser.parse_args()
    annotations = read_annotations(arguments.root / "scan2cad" / "full_annotations.json")
    objects_of = {name: scene_objects(annotation) for name, annotation in annotations.items()}
    train, split = (read_split(arguments.root / "scannet", name) or [] for name in ("train", arguments.split))
    known = objects_around(arguments.root, train, objects_of)
    prior = most_frequent(known, round(len(known) / len(train)))
    arguments.output.mkdir(parents=True, exist_ok=True)
    for name in split:
        center = camera_center(arguments.root, name)
        placed = ObjectSet(**{**vars(prior), "center": prior.center + center})
        write_scene_json(
            arguments.output / f"{name}.json", ScenePrediction(name, placed, center), [None] * len(placed)
        )
    print(
        f"{len(prior)} objects in each of {len(split)} scenes, after {len(train)} rooms: {arguments.output}"
    )


if __name__ == "__main__":
    main()
