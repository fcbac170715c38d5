# SPDX-License-Identifier: Apache-2.0
"""Metrics over objects in a distributed run: two gloo processes with unequal scenes, then one with none."""

from __future__ import annotations

import copy
import json
import pickle
import sys
import warnings
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from raytran.geometry.rotation import rotation_from_yaw
from raytran.metrics import (
    PSNR,
    SSIM,
    ForegroundIoU,
    MatchedShapeScores,
    MeanAveragePrecision,
    NewViewScores,
    OrientedBoxF1,
    Scan2CADAccuracy,
    SceneOccupancyIoU,
    ScoreCalibration,
)
from raytran.metrics.accuracy_curves import AccuracyCurves
from raytran.metrics.error_atlas import ErrorAtlas
from raytran.metrics.functional.cad_errors import cad_half_extents, cad_symmetries
from raytran.structs import CadAlignments, ObjectSet, Views

SCENES = 7
SHARES = {"unequal": ((0, 3, 5, 6), (1, 2, 4)), "one without": ((0, 1, 2, 3, 4, 5, 6), ()),
          "repeated": ((0, 1, 2, 3), (4, 5, 6, 0))}  # fmt: skip


def scene(index: int) -> tuple[ObjectSet, ObjectSet, str]:
    generator = torch.Generator().manual_seed(index)
    count = index  # scene 0 has no objects
    target = ObjectSet(
        label=torch.randint(0, 9, (count,), generator=generator),
        center=torch.rand(count, 3, generator=generator) * 4,
        size=torch.rand(count, 3, generator=generator) + 0.3,
        rotation=rotation_from_yaw(torch.rand(count, generator=generator)),
        symmetry=torch.ones(count, dtype=torch.int64),
        score=torch.ones(count),
        shape=torch.rand(count, 5, 5, 5, generator=generator) > 0.5,
    )
    copies = target.select(torch.randint(0, max(count, 1), (2 * count,), generator=generator))
    shift = 0.08 * torch.randn(2 * count, 3, generator=generator)
    score = torch.rand(2 * count, generator=generator)
    shape = 0.3 * copies.shape + 0.7 * torch.rand(copies.shape.shape, generator=generator)
    prediction = ObjectSet(
        copies.label, copies.center + shift, copies.size, copies.rotation, copies.symmetry, score, shape
    )
    return prediction, target, f"scene{index:04d}_00 – ü"


def cads(index: int) -> tuple[CadAlignments | None, CadAlignments]:
    """The same for the published scripts; scene 4 has no result."""
    generator = torch.Generator().manual_seed(index)
    count = index

    def uniform(rows: int, columns: int, low: float, high: float) -> torch.Tensor:
        return low + (high - low) * torch.rand(rows, columns, generator=generator, dtype=torch.float64)

    standing = torch.tensor([0.5**0.5, 0.5**0.5, 0.0, 0.0], dtype=torch.float64)  # +Y of the CAD goes to +Z
    turn = torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]], dtype=torch.float64)
    translation, scale = uniform(count, 3, 0, 3), uniform(count, 3, 0.8, 1.2)
    pose = torch.eye(4, dtype=torch.float64).repeat(count, 1, 1)
    pose[:, :3, :3], pose[:, :3, 3] = turn * scale[:, None], translation
    kinds = torch.randint(0, 4, (count,), generator=generator).tolist()
    catid = tuple(("03001627", "04379243", "02818832", "03636649")[kind] for kind in kinds)
    target = CadAlignments(
        catid,
        tuple("ab"[kind % 2] for kind in kinds),
        translation,
        standing.expand(count, 4),
        scale,
        torch.ones(count, dtype=torch.float64),
        half_extent=uniform(count, 3, 0.3, 0.6),
        center=uniform(count, 3, -0.05, 0.05),
        symmetry=torch.randint(0, 2, (count,), generator=generator),
        pose=pose,
        annotated_scale=scale,
    )
    source = torch.randint(0, max(count, 1), (2 * count,), generator=generator)
    copies = replace(target, half_extent=None, center=None, symmetry=None, pose=None, annotated_scale=None)
    copies = copies.select(source)
    shifted = copies.translation + uniform(2 * count, 3, -0.12, 0.12)
    scored = replace(copies, translation=shifted, score=uniform(2 * count, 1, 0, 1)[:, 0])
    return None if index == 4 else scored, target


def results(indices: tuple[int, ...], dtype: torch.dtype = torch.float32) -> dict:
    """Everything the metrics return for a share of the scenes, scenes given one by one."""
    of_objects = {"scan2cad": Scan2CADAccuracy(), "box_f1": OrientedBoxF1(), "shape": MatchedShapeScores()}
    of_objects |= {"map": MeanAveragePrecision(), "map_aligned": MeanAveragePrecision(boxes="axis_aligned")}
    of_objects |= {"calibration": ScoreCalibration()}
    of_objects |= {"curves": AccuracyCurves(), "atlas": ErrorAtlas(volume_extent=(9.0, 9.0, 3.5))}
    truths = [cads(index)[1] for index in range(SCENES)]
    of_cads = {
        "official": Scan2CADAccuracy(protocol="scan2cad", cad_symmetries=cad_symmetries(truths)),
        "vid2cad": Scan2CADAccuracy(protocol="vid2cad"),
        "odam": OrientedBoxF1(protocol="odam", cad_half_extents=cad_half_extents(truths)),
    }
    of_cells = {"occupancy": SceneOccupancyIoU(), "foreground": ForegroundIoU()}
    of_images = {"psnr": PSNR(), "ssim": SSIM()}
    new_views = NewViewScores()
    every = of_objects | of_cads | of_cells | of_images | {"new_views": new_views}
    for index in indices:
        prediction, target, name = scene(index)
        for metric in of_objects.values():
            metric.update([prediction], [target], [name])
        found, true = cads(index)
        for metric in of_cads.values():
            metric.update([found], [true], [name])
        generator = torch.Generator().manual_seed(index)
        probability, truth = torch.rand(2, 1, 4, 4, 2, generator=generator)
        for metric in of_cells.values():
            metric.update(probability, truth > 0.5, [name])
        found, true = torch.rand(2, 1, 1 + index, 3, 16, 16, generator=generator)
        for metric in of_images.values():
            metric.update(found, true, [name])
        cameras = torch.eye(3).expand(1, 1 + index, 3, 3), torch.eye(4).expand(1, 1 + index, 4, 4)
        new_views.update(found, Views(true, *cameras), Views(found, *cameras), [name])
        for metric in every.values():  # as Lightning does in a bf16 run
            metric.to(dtype)
    found = {key: metric.compute() for key, metric in every.items()}
    found |= {key: found[key].item() for key in of_cells | of_images}
    for key, metric in (of_objects | of_cads).items():
        for per in ("object", "scene"):
            rows = metric.rows(per)
            found[f"{key} {per}"] = sorted(rows, key=lambda row: (row["scene_id"], row.get("object")))
    return found


@pytest.fixture(scope="module")
def found_by_ranks(tmp_path_factory, command) -> list[dict]:
    """What each of two processes finds, for all shares of the scenes in turn."""
    folder = tmp_path_factory.mktemp("ranks")
    for rank in [command.start(__file__, folder, rank, folder=folder) for rank in "01"]:
        done = rank.wait()
        assert done.returncode == 0, done.stderr
    return [json.loads((folder / f"{rank}.json").read_text()) for rank in "01"]


@pytest.mark.parametrize("share", list(SHARES))
def test_two_ranks_equal_one_process(share, found_by_ranks):
    expected = json.loads(json.dumps(results(tuple(range(SCENES)))))
    assert expected["scan2cad"]["n_good"] > 5
    assert 0 < expected["shape"]["iou"] < 1
    assert 0 < expected["calibration"]["n_right"] < expected["calibration"]["n_predicted"]
    for key in ("official", "vid2cad"):
        assert 0 < expected[key]["n_good"] < expected[key]["n_total"]
    assert expected["odam"]["per_threshold"]["0.25"]["n_matched"] > 3
    for found in (by_share[share] for by_share in found_by_ranks):
        assert found == expected


def test_a_cast_to_bf16_changes_nothing():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert results((1, 5, 6), torch.bfloat16) == results((1, 5, 6))


def test_bf16_predictions_are_judged_as_they_are():
    """Values that bf16 can hold give the same in both types, as nothing is computed in bf16."""
    prediction, target, name = scene(6)
    names = ("center", "size", "rotation", "score", "shape")
    short = replace(prediction, **{key: getattr(prediction, key).bfloat16() for key in names})
    same = replace(short, **{key: getattr(short, key).float() for key in names})
    for metric_class in (Scan2CADAccuracy, OrientedBoxF1, MatchedShapeScores):
        found = []
        for objects in (short, same):
            metric = metric_class()
            with torch.autocast("cpu", torch.bfloat16):
                metric.update([objects], [target], [name])
                found.append((metric.compute(), metric.rows()))
        assert found[0] == found[1]
    image = torch.rand(2, 1, 2, 3, 16, 16).bfloat16()
    for metric in (PSNR(), SSIM()):
        metric.update(image[0], image[1], ["a"])
        assert metric.compute().isfinite()


def test_torchmetrics_own_ways_of_use():
    prediction, target, name = scene(5)
    expected = results((5,))["scan2cad"]
    metric = Scan2CADAccuracy(compute_on_cpu=True)
    assert metric([prediction], [target], [name]) == expected
    metric([prediction], [target], ["another"])
    assert metric.compute()["n_total"] == 2 * expected["n_total"]


def test_copy_reset_and_move():
    prediction, target, name = scene(5)
    metric = Scan2CADAccuracy()
    metric.update([prediction], [target], [name])
    result = metric.compute()
    for twin in (
        copy.deepcopy(metric),
        pickle.loads(pickle.dumps(metric)),
        metric.to("cpu").half(),
        metric.to(torch.bfloat16),
    ):
        twin.update([prediction], [target], ["another"])
        assert twin.compute()["n_total"] == 2 * result["n_total"]
    metric.reset()
    assert metric.rows() == []


def run_rank(folder: str, rank: str) -> None:
    torch.distributed.init_process_group("gloo", f"file://{folder}/meeting", rank=int(rank), world_size=2)
    found = {share: results(scenes[int(rank)]) for share, scenes in SHARES.items()}
    (Path(folder) / f"{rank}.json").write_text(json.dumps(found))
    torch.distributed.destroy_process_group()


if __name__ == "__main__":
    run_rank(*sys.argv[1:])
