# SPDX-License-Identifier: Apache-2.0
"""Protocol ``odam`` against the published procedure written as plain loops."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from raytran.data.scan2cad import read_annotations, scene_alignments
from raytran.errors import ShapeError
from raytran.geometry.boxes import OrientedBoxes, box_iou
from raytran.metrics import OrientedBoxF1
from raytran.metrics.functional.cad_errors import cad_half_extents
from raytran.metrics.functional.odam import bev_iou
from raytran.structs import CadAlignments

EIGHT = {"03211117", "04379243", "02808440", "02747177", "04256520", "03001627", "02933112", "02871439"}
THRESHOLDS = (0.1, 0.25, 0.5)


def rotated(q, v):
    w, u = q[0], np.array(q[1:])
    return v + 2 * np.cross(u, np.cross(u, v) + w * v)


def corners_of(q, t, size):
    q = np.array(q) / np.linalg.norm(q)
    x, y, z = (np.array(signs.split(), dtype=float) for signs in
               ("1 -1 -1 1 1 -1 -1 1", "1 1 1 1 -1 -1 -1 -1", "1 1 -1 -1 1 1 -1 -1"))  # fmt: skip
    local = (np.stack([x, y, z], axis=1) * np.array(size) / 2).astype(np.float32).astype(float)
    return [rotated(q, corner) + t for corner in local]


def true_corners(scene, model):
    """In the scan: inv(scan) T R, without the scale, after the box has its size."""
    size = 2 * np.array(model["bbox"]) * model["trs"]["scale"]
    in_world = corners_of(model["trs"]["rotation"], model["trs"]["translation"], size)
    q = np.array(scene["trs"]["rotation"]) / np.linalg.norm(scene["trs"]["rotation"])
    back = [rotated([q[0], *-q[1:]], corner - scene["trs"]["translation"]) for corner in in_world]
    return [corner / scene["trs"]["scale"] for corner in back]


def clipped(polygon, a, b):
    """The part of a polygon on the left of the line from a to b (Sutherland and Hodgman)."""
    kept = []
    for p, q in zip(polygon, polygon[1:] + polygon[:1], strict=True):
        d_p, d_q = ((b[0] - a[0]) * (r[1] - a[1]) - (b[1] - a[1]) * (r[0] - a[0]) for r in (p, q))
        if d_p >= 0:
            kept.append(p)
        if (d_p >= 0) != (d_q >= 0):
            s = d_p / (d_p - d_q)
            kept.append((p[0] + s * (q[0] - p[0]), p[1] + s * (q[1] - p[1])))
    return kept


def plain_iou(first, second):
    polygon, outline = ([tuple(box[i][:2]) for i in (3, 2, 1, 0)] for box in (first, second))
    for a, b in zip(outline, outline[1:] + outline[:1], strict=True):
        polygon = clipped(polygon, a, b)
    area = sum(p[0] * q[1] - p[1] * q[0] for p, q in zip(polygon, polygon[1:] + polygon[:1], strict=True)) / 2
    shared = area * max(0.0, min(first[0][2], second[0][2]) - max(first[4][2], second[4][2]))
    volumes = [
        math.prod(math.dist(box[i], box[j]) for i, j in ((0, 1), (1, 2), (0, 4))) for box in (first, second)
    ]
    return shared / (sum(volumes) - shared)


def official(annotations, results, boxes, threshold):
    """TP, predictions and true boxes by catid."""
    counts = {catid: [0, 0, 0] for catid in EIGHT}
    for scene in annotations:
        if scene["id_scan"] not in results:
            continue
        truth = [
            m for m in scene["aligned_models"] if m["catid_cad"] in EIGHT and min(m["trs"]["scale"]) >= 1e-3
        ]
        used = [False] * len(truth)
        for model in truth:
            counts[model["catid_cad"]][2] += 1
        for catid, id_cad, t, q, s, _ in results[scene["id_scan"]]:
            if catid not in EIGHT:
                continue
            counts[catid][1] += 1
            half = boxes.get((catid, id_cad))
            if half is None:
                continue
            box = corners_of(q, t, 2 * np.array(half) * s)
            for index, model in enumerate(truth):
                if model["catid_cad"] != catid or used[index]:
                    continue
                if plain_iou(box, true_corners(scene, model)) > threshold:
                    used[index] = True
                    counts[catid][0] += 1
    return counts


def evaluate(truths, predictions, **options):
    metric = OrientedBoxF1(protocol="odam", cad_half_extents=cad_half_extents(truths.values()), **options)
    metric.update([predictions.get(name) for name in truths], list(truths.values()), list(truths))
    return metric.compute()


@pytest.mark.parametrize("seed", range(20, 23))
def test_counts_equal_the_published_procedure(seed, make_benchmark, tmp_path):
    benchmark = make_benchmark(seed, 70)
    for scene in benchmark.annotations:  # a scaled scan shears boxes, of which the script does not speak
        scene["trs"]["scale"] = [1.0, 1.0, 1.0]
    boxes = {
        (m["catid_cad"], m["id_cad"]): m["bbox"] for a in benchmark.annotations for m in a["aligned_models"]
    }
    result = evaluate(benchmark.truths(tmp_path), benchmark.predictions(), iou_thresholds=THRESHOLDS)
    assert result["n_scenes"] == len(benchmark.results)
    for threshold in THRESHOLDS:
        counts = official(benchmark.annotations, benchmark.results, boxes, threshold)
        found = result["per_threshold"][f"{threshold:g}"]
        assert 0.1 < found["f1"] < 0.95
        matched, predicted, true = np.array(list(counts.values())).sum(axis=0).tolist()
        assert (found["n_matched"], found["n_predicted"], found["n_true"]) == (matched, predicted, true)
        precision, recall = matched / predicted, matched / true
        assert found["f1"] == pytest.approx(2 * precision * recall / (precision + recall))
        by_class = sorted([*counts.values()])
        names = [
            [part[key] for key in ("n_matched", "n_predicted", "n_true")]
            for part in found["per_class"].values()
        ]
        assert sorted(names) == [entry for entry in by_class if any(entry[1:])]


def random_corners(rng, count, tilt):
    boxes = []
    for _ in range(count):
        yaw, lean = rng.uniform(0, np.pi), np.radians(rng.uniform(0, tilt)) / 2
        axis = rng.normal(size=3)
        up = np.array([np.cos(np.pi / 4), np.sin(np.pi / 4), 0, 0])
        about_z = np.array([np.cos(yaw), 0, 0, np.sin(yaw)])
        about_axis = np.array([np.cos(lean), *(np.sin(lean) * axis / np.linalg.norm(axis))])
        place, size = rng.uniform(0, 1, 3), rng.uniform(0.2, 1.5, 3)
        local = corners_of(up, np.zeros(3), size)
        boxes.append([rotated(about_axis, rotated(about_z, corner)) + place for corner in local])
    return boxes


@pytest.mark.parametrize("tilt", [0, 5, 30, 85])
def test_overlap_equals_clipping_polygon_by_polygon(tilt):
    rng = np.random.default_rng(tilt)
    first, second = random_corners(rng, 30, tilt), random_corners(rng, 30, tilt)
    expected = [[plain_iou(a, b) for b in second] for a in first]
    found = bev_iou(torch.tensor(np.array(first)), torch.tensor(np.array(second)))
    assert (found > 0).sum() > 100
    np.testing.assert_allclose(found.numpy(), expected, atol=1e-9)


def upright(yaw: float, center=(0.0, 0.0, 0.0), size=(1.0, 0.8, 0.6)) -> torch.Tensor:
    q = [math.cos(yaw / 2), 0, 0, math.sin(yaw / 2)]
    local = corners_of([math.sqrt(0.5), math.sqrt(0.5), 0, 0], np.zeros(3), size)
    return torch.tensor(np.array([[rotated(q, corner) + center for corner in local]]))


@pytest.mark.parametrize("yaw", [0.0, 0.3, 1.0, 2.5])
@pytest.mark.parametrize("shift", [0.0, 1e-12, 0.25, 1.0, 3.0])
def test_shared_edges_are_no_trouble(yaw, shift):
    """Copies shifted along an axis of their own, on which the script fails."""
    moved = upright(yaw, center=(shift * math.cos(yaw), shift * math.sin(yaw), 0.0))
    expected = max(0.0, 1 - shift) / (1 + min(shift, 1.0))
    assert bev_iou(upright(yaw), moved).item() == pytest.approx(expected, abs=1e-6)
    assert bev_iou(moved, upright(yaw)).item() == pytest.approx(expected, abs=1e-6)


def test_without_tilt_it_is_the_exact_iou():
    rng = np.random.default_rng(5)
    sizes, places, yaws = rng.uniform(0.3, 1.5, (40, 3)), rng.uniform(0, 1, (40, 3)), rng.uniform(0, 6, 40)
    corners = torch.cat([upright(*parts) for parts in zip(yaws, places, sizes, strict=True)])
    axes = torch.stack(
        [corners[:, 0] - corners[:, 1], corners[:, 0] - corners[:, 4], corners[:, 1] - corners[:, 2]], -1
    )
    size = axes.norm(dim=1)
    exact, _ = box_iou(*[OrientedBoxes(corners.mean(dim=1), size, axes / size[:, None])] * 2)
    torch.testing.assert_close(bev_iou(corners, corners), exact, atol=1e-6, rtol=0)


@pytest.mark.parametrize(("tilt", "expected"), [(3, 0.9945), (10, 0.941), (25, 0.697)])
def test_a_tilted_box_does_not_cover_itself(tilt, expected):
    """cos² a / (2 - cos² a) for a turn by a about an axis of the box (protocols.md §2.3)."""
    half = math.radians(tilt) / 2
    lean = [math.cos(half), math.sin(half), 0, 0]
    corners = torch.tensor(np.array([[rotated(lean, corner) for corner in upright(0.0)[0].numpy()]]))
    assert bev_iou(corners, corners).item() == pytest.approx(expected, abs=6e-4)


def test_boxes_on_their_head_and_of_no_size_share_nothing():
    head = upright(0.0)[:, [4, 5, 6, 7, 0, 1, 2, 3]]
    assert bev_iou(head, upright(0.0)).item() == bev_iou(head, head).item() == 0
    flat = upright(0.0, size=(1.0, 0.8, 0.0))
    for bad in (flat, flat * torch.nan):
        assert (
            bev_iou(bad, upright(0.0)).item()
            == bev_iou(upright(0.0), bad).item()
            == bev_iou(bad, bad).item()
            == 0
        )
    assert bev_iou(upright(0.0)[:0], upright(0.0)).shape == (0, 1)


CHAIR, LAMP = "03001627", "03636649"


def scene_of(shared_dir) -> CadAlignments:
    path = shared_dir / "realdata" / "scene0470_00" / "scan2cad" / "full_annotations.json"
    return scene_alignments(read_annotations(path)["scene0470_00"])


def test_annotations_find_themselves_although_tilted(shared_dir):
    truth = scene_of(shared_dir)
    found = evaluate({"a": truth}, {"a": replace(truth, half_extent=None)})["per_threshold"]
    assert [found[key]["n_matched"] for key in ("0.25", "0.5")] == [7, 7]


def test_one_prediction_takes_several_objects(make_benchmark, tmp_path):
    """There is no break: two objects in one place are both found by one prediction, and precision is 2."""
    model = {
        "trs": {"translation": [0, 0, 0], "rotation": [1, 0, 0, 0], "scale": [1, 1, 1]},
        "bbox": [0.5, 0.5, 0.5], "center": [0, 0, 0], "sym": "__SYM_NONE", "id_cad": "x", "catid_cad": CHAIR,
    }  # fmt: skip
    turned = {
        "translation": [0, 0, 0],
        "rotation": [math.sqrt(0.5), -math.sqrt(0.5), 0, 0],
        "scale": [1, 1, 1],
    }
    sliver = model | {"trs": model["trs"] | {"scale": [1, 1e-4, 1]}}
    scene = {
        "id_scan": "a",
        "trs": turned,
        "aligned_models": [model, model, sliver, model | {"catid_cad": LAMP}],
    }
    path = tmp_path / "annotations.json"
    path.write_text(json.dumps([scene]))
    truth = scene_alignments(read_annotations(path)["a"])
    one, lamp = truth.select(torch.tensor([0])), truth.select(torch.tensor([3]))
    scores = evaluate({"a": truth}, {"a": one})["per_threshold"]["0.5"]
    assert (scores["n_matched"], scores["n_predicted"], scores["n_true"]) == (2, 1, 2)
    assert scores["best"]["n_matched"] == 2
    assert 0 <= scores["average_precision"] <= 1
    metric = OrientedBoxF1(protocol="odam")
    metric.update([one], [truth.select(torch.tensor([3, 2, 1]))], ["a"])
    assert [(row["object"], row["category"], row["matched_0.5"]) for row in metric.rows()] == [
        (2, "chair", True)
    ]
    assert metric.rows("scene")[0]["n_true"] == 1
    # A lamp is no prediction; the empty scene and not the missing one counts.
    for prediction, n_true in ((lamp, 2), (CadAlignments.empty(), 2), (None, 0)):
        scores = evaluate({"a": truth}, {"a": prediction})["per_threshold"]["0.5"]
        assert (scores["n_matched"], scores["n_predicted"], scores["n_true"]) == (0, 0, n_true)


def test_best_threshold_is_the_best_of_all(make_benchmark, tmp_path):
    """Leaving out all predictions below a score, for every score, gives the same as the sorted pass."""
    benchmark = make_benchmark(30, 40)
    truths, predictions = benchmark.truths(tmp_path), benchmark.predictions()
    best = evaluate(truths, predictions)["per_threshold"]["0.25"]["best"]
    levels = sorted({float(s) for scene in predictions.values() for s in scene.score})
    tried = []
    for level in [*levels[::5], best["score_threshold"]]:
        kept = {name: scene.select(scene.score >= level) for name, scene in predictions.items()}
        tried.append(evaluate(truths, kept)["per_threshold"]["0.25"]["f1"])
    assert best["f1"] == pytest.approx(tried[-1])
    assert max(tried) <= best["f1"] + 1e-12


def test_annotations_are_needed():
    with pytest.raises(ShapeError, match="annotated"):
        OrientedBoxF1(protocol="odam", cad_half_extents={}).update(
            [None, CadAlignments.empty()], [None, CadAlignments.empty()], ["a", "b"]
        )
