# SPDX-License-Identifier: Apache-2.0
"""Protocol ``vid2cad`` against the published procedure written as plain loops."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
import torch

from raytran.metrics import Scan2CADAccuracy
from raytran.metrics.functional.cad_errors import cad_errors, equal_names
from raytran.metrics.functional.vid2cad import _counts
from raytran.structs import CadAlignments

CLASS_OF = {
    "02808440": "bathtub", "02871439": "bookshelf", "02933112": "cabinet", "03001627": "chair",
    "03211117": "display", "04256520": "sofa", "04379243": "table", "02747177": "trashbin", "02818832": "bed",
}  # fmt: skip
COMB = {"__SYM_NONE": 1, "__SYM_ROTATE_UP_2": 2, "__SYM_ROTATE_UP_4": 4, "__SYM_ROTATE_UP_INF": 36}


def hamilton(p, q):
    v = p[0] * np.array(q[1:]) + q[0] * np.array(p[1:]) + np.cross(p[1:], q[1:])
    return np.array([p[0] * q[0] - np.dot(p[1:], q[1:]), *v])


def matrix_of(trs):
    w, *v = np.array(trs["rotation"]) / np.linalg.norm(trs["rotation"])
    cross = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
    out = np.eye(4)
    out[:3, :3] = (np.eye(3) + 2 * w * cross + 2 * cross @ cross) @ np.diag(trs["scale"])
    out[:3, 3] = trs["translation"]
    return out


def taken_apart(matrix):
    """Translation, quaternion (by power iteration on Davenport's matrix of a shifted spectrum) and scale."""
    scale = np.linalg.norm(matrix[:3, :3], axis=0)
    r = matrix[:3, :3] / scale
    z = np.array([r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]])
    k = np.zeros((4, 4))
    k[0, 0], k[0, 1:], k[1:, 0], k[1:, 1:] = np.trace(r), z, z, r + r.T - np.trace(r) * np.eye(3)
    q = np.array([0.1, 0.2, 0.3, 0.4])
    for _ in range(100):
        q = (k + 4 * np.eye(4)) @ q
        q /= np.linalg.norm(q)
    return matrix[:3, 3], q, scale


def least_angle(q, other, turns):
    best = math.inf
    for i in range(turns):
        half = math.pi * i / turns
        dot = abs(float(np.dot(hamilton(q, [math.cos(half), 0, math.sin(half), 0]), other)))
        best = min(best, 0.0 if dot > 1 else math.degrees(2 * math.acos(dot)))
    return best


def symmetry_of(scene, row):
    for model in scene["aligned_models"]:
        if (model["catid_cad"], model["id_cad"]) == row[:2]:
            return model["sym"]
    return "__SYM_NONE"


def without_duplicates(scene, rows):
    rows = [(r[0], r[1], *(np.float32(part) for part in r[2:])) for r in rows]
    rows.sort(key=lambda r: -r[5])
    dead = set()
    for i, a in enumerate(rows):
        for j in range(i + 1, len(rows)):
            b = rows[j]
            if i in dead or j in dead or a[0] != b[0]:
                continue
            near = np.linalg.norm(a[2] - b[2]) <= 0.4 and abs(np.mean(a[4] / b[4]) - 1) <= 0.6
            turns = COMB[symmetry_of(scene, a)]
            p, q = ((row[3] / np.linalg.norm(row[3])).astype(float) for row in (a, b))  # here alone
            if near and least_angle(q, p, turns) <= 60:
                dead.add(j)
    return [row for i, row in enumerate(rows) if i not in dead]


def hits(scene, rows):
    """The classes of the models found."""
    models = [m for m in scene["aligned_models"] if m["catid_cad"] in CLASS_OF]
    quota = {}
    for model in models:
        quota[model["catid_cad"]] = quota.get(model["catid_cad"], 0) + 1
    to_scan, found = np.linalg.inv(matrix_of(scene["trs"])), []
    for row in without_duplicates(scene, rows):
        catid, _, t, q, s, _ = row
        if quota.get(catid, 0) == 0:
            continue
        quota[catid] -= 1
        for model in models:
            t_gt, q_gt, s_gt = taken_apart(to_scan @ matrix_of(model["trs"]))
            t_gt, s_gt = np.float32(t_gt), np.float32(s_gt)
            turns = COMB[model["sym"]] if symmetry_of(scene, row) == model["sym"] else 1
            if (
                model["catid_cad"] == catid
                and np.linalg.norm(t - t_gt) <= 0.2
                and least_angle(q_gt, q.astype(float), turns) <= 20
                and abs(np.mean(s / s_gt) - 1) <= 0.2
            ):
                found.append(CLASS_OF[catid])
                models = [other for other in models if other is not model]
                break
    return found


def official(annotations, results):
    good, total, seen = {}, {}, set()
    for with_rows in (True, False):
        for scene in annotations:
            rows = results.get(scene["id_scan"], [])
            if bool(rows) != with_rows:
                continue
            for model in scene["aligned_models"]:
                name = CLASS_OF.get(model["catid_cad"])
                if name and (with_rows or name in seen):
                    total[name] = total.get(name, 0) + 1
            for name in hits(scene, rows):
                good[name] = good.get(name, 0) + 1
        seen = set(total)
    return good, total


def evaluate(truths, predictions):
    metric = Scan2CADAccuracy(protocol="vid2cad")
    metric.update([predictions.get(name) for name in truths], list(truths.values()), list(truths))
    return metric.compute()


@pytest.mark.parametrize("seed", range(10, 14))
def test_counts_equal_the_published_procedure(seed, make_benchmark, tmp_path):
    benchmark = make_benchmark(seed, 100)
    good, total = official(benchmark.annotations, benchmark.results)
    result = evaluate(benchmark.truths(tmp_path), benchmark.predictions())
    assert 0.15 < sum(good.values()) / sum(total.values()) < 0.8
    assert set(result["per_class"]) == set(CLASS_OF.values())
    for name, entry in result["per_class"].items():
        assert (entry["n_good"], entry["n_total"]) == (good.get(name, 0), total.get(name, 0))
    rounded = {name: round(100 * good.get(name, 0) / total[name], 1) for name in total}
    assert 100 * result["class_average"] == pytest.approx(np.mean(list(rounded.values())))
    rounded.pop("bed", None)
    assert 100 * result["benchmark_class_average"] == pytest.approx(np.mean(list(rounded.values())))
    assert result["global_average"] == pytest.approx(sum(good.values()) / sum(total.values()))
    eight = [sum(counts.get(name, 0) for name in rounded) for counts in (good, total)]
    assert result["benchmark_global_average"] == pytest.approx(eight[0] / eight[1])


def models(
    catid: str, places: list[float], score: list[float] | None = None, symmetry: int = 1
) -> CadAlignments:
    n = len(places)
    place = torch.tensor([[x, 0.0, 0.0] for x in places], dtype=torch.float64)
    return CadAlignments(
        (catid,) * n, ("cad",) * n, place, torch.tensor([[1.0, 0, 0, 0]]).double().expand(n, 4),
        torch.ones(n, 3).double(), torch.tensor(score or [1.0] * n, dtype=torch.float64),
        symmetry=torch.full((n,), symmetry),
    )  # fmt: skip


CHAIR, BED, LAMP = "03001627", "02818832", "03636649"


def test_duplicates_are_removed_before_the_cap():
    truth = models(CHAIR, [0.0, 1.0])
    # Without removal the second row would use up the cap, and the third would not be tried.
    result = evaluate({"a": truth}, {"a": models(CHAIR, [0.0, 0.3, 1.0], [0.9, 0.8, 0.7])})
    assert result["n_good"] == 2


def test_duplicates_are_sought_with_quaternions_of_length_one():
    """Taken as they are, one shorter than one would be 2 acos 0.49 = 121 degrees away and both be kept."""
    short = models(CHAIR, [0.0, 0.3, 1.0], [0.9, 0.8, 0.7])
    short = replace(short, quaternion=short.quaternion * torch.tensor([[1.0], [0.49], [1.0]]).double())
    assert evaluate({"a": models(CHAIR, [0.0, 1.0])}, {"a": short})["n_good"] == 2


def test_the_cap_is_used_up_by_misses():
    truth = models(CHAIR, [0.0])
    assert evaluate({"a": truth}, {"a": models(CHAIR, [5.0, 0.0], [0.9, 0.8])})["n_good"] == 0
    assert evaluate({"a": truth}, {"a": models(CHAIR, [5.0, 0.0], [0.8, 0.9])})["n_good"] == 1


def test_symmetry_counts_only_if_both_models_have_it():
    turned = torch.tensor([[math.cos(0.5), 0, math.sin(0.5), 0]], dtype=torch.float64)
    truth = models(CHAIR, [0.0], symmetry=0)
    same = replace(models(CHAIR, [0.0]), quaternion=turned)
    assert evaluate({"a": truth}, {"a": same})["n_good"] == 1
    assert evaluate({"a": truth}, {"a": replace(same, id_cad=("other",))})["n_good"] == 0


def test_beds_are_a_class_and_lamps_are_not():
    truths = {"a": models(BED, [0.0]), "b": models(LAMP, [0.0])}
    result = evaluate(truths, truths)
    assert result["per_class"]["bed"]["n_good"] == result["n_good"] == result["n_total"] == 1
    assert result["benchmark_global_average"] == 0
    metric = Scan2CADAccuracy(protocol="vid2cad")
    metric.update([truths["b"]], [truths["b"]], ["b"])
    assert metric.rows("object") == []
    row = metric.rows("scene")[0]
    assert (row["n_good"], row["n_total"], row["n_predicted"]) == (0, 0, 1)


def test_scenes_without_rows_add_only_classes_seen_elsewhere():
    truths = {"a": models(CHAIR, [0.0, 2.0]), "b": models(CHAIR, [0.0]), "c": models(BED, [0.0])}
    result = evaluate(truths, {"a": models(CHAIR, [0.0]), "c": CadAlignments.empty()})
    assert (result["n_good"], result["n_total"], result["n_scenes"]) == (1, 3, 3)


def test_class_accuracy_is_rounded():
    result = evaluate({"a": models(CHAIR, [0.0, 2.0, 4.0])}, {"a": models(CHAIR, [0.0])})
    assert (
        result["class_average"] == result["per_class"]["chair"]["accuracy"] == pytest.approx(0.333, abs=1e-9)
    )
    assert result["global_average"] == 1 / 3


def test_duplicates_are_those_of_the_table_of_all_pairs():
    """The table as a whole, as small files had it before; 400 predictions are several parts of it."""
    count, rng = 400, np.random.default_rng(0)
    yaw = rng.uniform(0, 6.3, count) / 2
    quaternion = np.stack([np.cos(yaw), 0 * yaw, np.sin(yaw), 0 * yaw], axis=-1)
    catid = tuple(rng.choice(list(CLASS_OF)[:2], count).tolist())
    ranked = CadAlignments(
        catid=catid,
        id_cad=("a",) * count,
        translation=torch.from_numpy(rng.uniform(0, 2, (count, 3))),
        quaternion=torch.from_numpy(quaternion + rng.normal(size=(count, 4)) * 0.1),
        scale=torch.from_numpy(rng.uniform(0.5, 1.5, (count, 3))),
        score=torch.linspace(1, 0, count).double(),
    )
    symmetry = torch.from_numpy(rng.choice([0, 1, 2, 4], count))
    unit = torch.nn.functional.normalize(ranked.quaternion.float(), dim=-1).double()
    turned = replace(ranked, quaternion=unit)
    turns = symmetry[:, None].expand(-1, count)
    errors = cad_errors(turned, turned, ranked.translation, turns, torch.float32)
    close = equal_names(catid, catid) & errors.within(0.4, 60.0, 0.6)
    expected = torch.ones(count, dtype=torch.bool)
    for index in range(count):
        if expected[index]:
            expected[index + 1 :] &= ~close[index, index + 1 :]
    assert 50 < int(expected.sum()) < 350
    left = Counter(dict.fromkeys(catid, count))
    assert torch.equal(_counts(ranked, symmetry, left), expected)
