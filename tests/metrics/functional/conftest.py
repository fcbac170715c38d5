# SPDX-License-Identifier: Apache-2.0
"""Random annotations and predictions in the published formats, made to hit every rule of the scripts."""

from __future__ import annotations

import json
from dataclasses import dataclass

import numpy as np
import pytest
import torch

from raytran.data.scan2cad import read_annotations, scene_alignments
from raytran.structs import CadAlignments

NAMED = ["02808440", "02871439", "02933112", "03001627", "03211117", "04256520", "04379243", "02747177"]
UNNAMED = ["02818832", "03337140", "03636649"]
SYMMETRIES = ["__SYM_NONE", "__SYM_ROTATE_UP_2", "__SYM_ROTATE_UP_4", "__SYM_ROTATE_UP_INF"]


def product(p, q):
    """Hamilton's product of quaternions [w, x, y, z]."""
    a, b, c, d = p
    e, f, g, h = q
    return [
        a * e - b * f - c * g - d * h,
        a * f + b * e + c * h - d * g,
        a * g - b * h + c * e + d * f,
        a * h + b * g - c * f + d * e,
    ]


def turn(axis, degrees):
    half = np.radians(degrees) / 2
    return [
        float(np.cos(half)),
        *(float(np.sin(half) * part) for part in np.array(axis) / np.linalg.norm(axis)),
    ]


def as_matrix(q):
    """Columns are the images q v q* of the axes."""
    q = np.array(q) / np.linalg.norm(q)
    conjugate = [q[0], -q[1], -q[2], -q[3]]
    return np.array([product(product(q, [0.0, *axis]), conjugate)[1:] for axis in np.eye(3)]).T


def place(trs):
    """The 4 x 4 matrix T R S."""
    matrix = np.eye(4)
    matrix[:3, :3] = as_matrix(trs["rotation"]) @ np.diag(trs["scale"])
    matrix[:3, 3] = trs["translation"]
    return matrix


@dataclass
class Benchmark:
    """``annotations`` as in full_annotations.json; ``results[scene]``: rows (catid, id, t, q, s, score)."""

    annotations: list
    results: dict

    def truths(self, folder) -> dict[str, CadAlignments]:
        path = folder / "full_annotations.json"
        path.write_text(json.dumps(self.annotations))
        return {name: scene_alignments(scene) for name, scene in read_annotations(path).items()}

    def predictions(self) -> dict[str, CadAlignments]:
        return {name: alignments_of(rows) for name, rows in self.results.items()}


def alignments_of(rows) -> CadAlignments:
    numbers = torch.tensor([[*r[2], *r[3], *r[4], r[5]] for r in rows], dtype=torch.float64).reshape(-1, 11)
    catid, id_cad = tuple(r[0] for r in rows), tuple(r[1] for r in rows)
    return CadAlignments(catid, id_cad, numbers[:, :3], numbers[:, 3:7], numbers[:, 7:10], numbers[:, 10])


def random_pool(rng):
    """CAD models: (catid, id) to half box, box centre and symmetry."""
    pool = {}
    for catid in NAMED + UNNAMED:
        for index in range(int(rng.integers(1, 4))):
            half, center = rng.uniform(0.15, 0.4, 3).tolist(), rng.uniform(-0.1, 0.1, 3).tolist()
            pool[catid, f"cad{index}"] = half, center, str(rng.choice(SYMMETRIES))
    return pool


def random_scene(rng, name, pool, used):
    shape = rng.uniform(0.8, 1.2, 3) if rng.random() < 0.1 else np.ones(3)
    scan = {
        "translation": rng.uniform(-3, 3, 3).tolist(),
        "rotation": turn([1, 0, 0], -90) if rng.random() < 0.5 else turn(rng.normal(size=3), 70),
        "scale": shape.tolist(),
    }
    keys = [used[i] for i in rng.integers(0, len(used), int(rng.integers(0, 9)))]
    models = []
    for catid, id_cad in keys:
        half, center, symmetry = pool[catid, id_cad]
        if rng.random() < 0.1:  # annotators disagree
            symmetry = str(rng.choice(SYMMETRIES))
        upright = product(turn([0, 1, 0], rng.uniform(0, 360)), turn(rng.normal(size=3), rng.uniform(0, 5)))
        sign = rng.choice([-1.0, 1.0])
        models.append(
            {
                "trs": {
                    "translation": rng.uniform(0, 1.2, 3).tolist(),
                    "rotation": [sign * part for part in upright],
                    "scale": rng.uniform(0.6, 1.6, 3).tolist() if rng.random() < 0.97 else [1.0, 0.0005, 1.0],
                },
                "bbox": half,
                "center": center,
                "sym": symmetry,
                "id_cad": id_cad,
                "catid_cad": catid,
            }
        )
    return {"id_scan": name, "trs": scan, "n_aligned_models": len(models), "aligned_models": models}


def random_row(rng, scene, model, pool):
    """A prediction of a model: right, or wrong by about as much as is allowed in one or more respects."""
    matrix = np.linalg.inv(place(scene["trs"])) @ place(model["trs"])
    point = rng.choice([0.0, -1.0]) * np.array(model["center"])
    scale = np.linalg.norm(matrix[:3, :3], axis=0)
    world = product(
        [scene["trs"]["rotation"][0], *(-p for p in scene["trs"]["rotation"][1:])], model["trs"]["rotation"]
    )
    level = float(rng.choice([0.0, 0.3, 1.0]))
    rotation = product(
        world, turn([0, 1, 0], float(rng.choice([0, 0, 0, 90, 180, 40])) + level * rng.normal() * 12)
    )
    rotation = product(rotation, turn(rng.normal(size=3), level * rng.normal() * 8))
    length = float(rng.choice([-1.0, 1.0, 1.0, 1.0, 1.004, 0.99]))
    catid, id_cad = model["catid_cad"], model["id_cad"]
    kind = rng.random()
    if kind < 0.1:  # another model of the category
        id_cad = str(rng.choice([key[1] for key in pool if key[0] == catid]))
    elif kind < 0.15:
        catid, id_cad = list(pool)[int(rng.integers(len(pool)))]
    elif kind < 0.18:
        id_cad = "unknown"
    return (
        catid,
        id_cad,
        ((matrix @ [*point, 1.0])[:3] + level * rng.normal(size=3) * 0.08).tolist(),
        [length * part for part in rotation],
        (scale * rng.uniform(1 - 0.3 * level, 1 + 0.35 * level, 3)).tolist(),
        float(rng.choice([rng.random(), 0.5], p=[0.9, 0.1])),
    )


@pytest.fixture(scope="session")
def make_benchmark():
    """Function of a seed and a number of scenes."""

    def make(seed: int, count: int) -> Benchmark:
        rng = np.random.default_rng(seed)
        pool = random_pool(rng)
        keys = list(pool)
        annotations, results = [], {}
        for index in range(count):
            used = [keys[i] for i in rng.integers(0, len(keys), int(rng.integers(1, 5)))]
            scene = random_scene(rng, f"scene{index:04d}_00", pool, used)
            annotations.append(scene)
            models = scene["aligned_models"]
            chosen = rng.integers(0, len(models), int(rng.integers(0, 14))) if models else []
            if rng.random() > 0.15:
                results[scene["id_scan"]] = [random_row(rng, scene, models[i], pool) for i in chosen]
        return Benchmark(annotations, results)

    return make
