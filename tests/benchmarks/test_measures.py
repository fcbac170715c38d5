# SPDX-License-Identifier: Apache-2.0
"""How the benchmarks measure: what counts as memory, what a failure ends, what a step is."""

from __future__ import annotations

import csv
import math
import subprocess
import sys
import warnings
from pathlib import Path

import fit
import flex
import pytest
import ray_attention
import torch
from device import Device, Gpu
from fit import random_batch, run_steps, step_config
from timing import measure, reason

from raytran.geometry.grid import VoxelGrid
from raytran.run.plan.camera_paths import walk
from raytran.run.train.build import build_model, build_module

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"
SMALL = [
    "model.grid_resolution=[4,4,4]",
    "views.image_size=[32,48]",
    "model.backbone.channels=16",
    "model.backbone.encoder.width=8",
]


class Ledger(Device):
    """A device whose memory is what a test says."""

    def __init__(self):
        self.used = self.most = 100

    def held(self):
        self.most = self.used
        return self.used

    def peak(self):
        return self.most


def test_memory_is_what_is_taken_beyond_what_is_held_and_returned():
    device = Ledger()

    def run():
        device.most = max(device.most, device.used + 1000)
        out = torch.zeros(100, dtype=torch.uint8)
        return out, [out.view(10, 10), torch.zeros(50, dtype=torch.int32)]  # a view takes nothing more

    taken = measure({"run": run}, 2, device)["run"]
    assert (taken.peak, taken.returned, taken.extra) == (1000, 300, 700)
    assert taken.seconds >= 0
    assert taken.error == ""


@pytest.mark.parametrize("times", [0, 2, 3], ids=["at once", "when measured", "in the last round"])
def test_a_failure_ends_one_candidate(times):
    calls = []

    def fails():
        calls.append(1)
        if len(calls) > times:
            raise torch.OutOfMemoryError("no room\nfor this") from ValueError("the cause\nin two lines")

    taken = measure({"first": lambda: None, "fails": fails, "last": lambda: None}, 2, Device())
    assert taken["fails"].error == "ValueError: the cause"
    assert taken["fails"].seconds is None
    assert taken["first"].seconds is not None
    assert taken["last"].seconds is not None


def test_a_reason_is_one_line():
    assert reason(KeyError()) == "KeyError"
    assert reason(RuntimeError("a\nb")) == "RuntimeError: a"


def make_case(direction="pixels_to_voxels", device=None):
    cameras = walk(2)
    grid = VoxelGrid((6, 6, 4), (9.0, 9.0, 3.5), cameras.position.mean(dim=0))
    return ray_attention.Case(cameras, grid, direction, torch.float32, device or Device(), (3, 4), 2)


def test_a_baseline_that_is_wrong_or_does_not_run_ends_its_own_row(monkeypatch):
    monkeypatch.setattr(ray_attention, "gather_segment", lambda query, *_: torch.zeros_like(query))
    monkeypatch.setattr(ray_attention.Case, "flex", lambda self: 1 / 0)
    rows = ray_attention.measure_case(make_case(), ["gather", "dense", "flex"], 1.0, 1, 1e9)
    found = {(row["what"], row["job"]): row for row in rows}
    for job in ray_attention.JOBS:
        assert "differs from ray_attention in" in found["gather + segment softmax", job]["error"]
        assert found["FlexAttention", job]["error"] == "ZeroDivisionError: division by zero"
        assert found["ray_attention", job]["error"] == ""
        assert found["ray_attention", job]["ratio"] == 1
    assert found["dense masked SDPA", "forward"]["error"] == ""
    assert found["dense masked SDPA", "forward"]["ratio"] > 0


@pytest.mark.parametrize("direction", ["pixels_to_voxels", "voxels_to_pixels"])
def test_least_bytes_are_those_of_inputs_outputs_and_orders(direction):
    case = make_case(direction)
    voxels, pixels = 6 * 6 * 4, 2 * 3 * 4
    targets, sources = (voxels, pixels) if direction == "pixels_to_voxels" else (pixels, voxels)
    element = 2 * 32 * 4  # heads, channels, bytes
    pairs = len(case.listed)
    by_target, by_source = (4 * (rows + 1) + 4 * pairs + 8 * pairs for rows in (targets, sources))
    forward = (2 * targets + 2 * sources) * element + by_target
    assert case.least_bytes("forward") == forward
    backward = (4 * targets + 4 * sources) * element + by_target + by_source
    assert case.least_bytes("forward + backward") == forward + backward


def test_flex_attention_is_compiled_for_each_case_or_not_at_all(monkeypatch):
    compiled, resets = [], []
    monkeypatch.setattr(torch._dynamo, "reset", lambda: resets.append(1))

    def compile(function, **options):
        compiled.append(options)
        return function

    monkeypatch.setattr(torch, "compile", compile)
    for direction in ("pixels_to_voxels", "voxels_to_pixels"):
        case = make_case(direction)
        flex.flex_ray_attention(case.listed, case.cameras, case.grid, (3, 4), direction)
    # fullgraph raises where torch.compile would run the function as it is.
    assert compiled == [{"fullgraph": True, "dynamic": False}] * 2
    assert len(resets) == 2


def test_waits_of_a_gpu_are_named_by_the_line_that_waits(monkeypatch):
    modes = []
    monkeypatch.setattr(torch.cuda, "get_sync_debug_mode", lambda: 0)
    monkeypatch.setattr(torch.cuda, "set_sync_debug_mode", modes.append)
    with warnings.catch_warnings(record=True) as others:
        warnings.simplefilter("always")
        with Gpu().waits() as found:
            for _ in range(2):
                warnings.warn("called a synchronizing CUDA operation (…)", UserWarning, stacklevel=1)
            warnings.warn("something else", UserWarning, stacklevel=1)
    assert [str(other.message) for other in others] == ["something else"]
    assert len(found) == 2
    assert all("benchmarks/test_measures.py:" in place for place in found)
    assert modes == ["warn", 0]


def test_a_batch_has_the_targets_of_its_stage():
    cfg = step_config("tiny", "stage3", Device(), SMALL)
    model, cameras = build_model(cfg, pretrained=False), walk(2).scaled_to((32, 48))
    first, third = (random_batch(cameras, model, 2, targets) for targets in (["occupancy"], ["shapes"]))
    assert first.objects is None
    assert first.foreground is None
    assert first.occupancy.shape == (2, 4, 4, 4)
    assert third.occupancy is None
    assert third.objects[1].shape.shape == (10, 63, 63, 63)


def test_a_steps_peak_is_taken_from_before_there_is_a_network(monkeypatch):
    """So that weights, gradients and moments are in it, and not only what comes on top."""
    order = []

    class Noting(Device):
        def held(self):
            order.append("held")
            return super().held()

        def peak(self):
            order.append("peak")
            return super().peak()

    def build(*arguments, **options):
        order.append("build")
        return build_model(*arguments, **options)

    monkeypatch.setattr(fit, "build_model", build)
    cfg = step_config("tiny", "stage2", Device(), [*SMALL, "model.backbone.encoder.width=64"])
    steps = run_steps(cfg, walk(2).scaled_to((32, 48)), Noting(), timed=3, warm_up=1)
    assert order == ["held", "peak", "build", "peak"]  # on a CPU what is held is the peak until now
    assert len(steps.losses) == 1 + 1 + 3 + 1
    assert all(math.isfinite(loss) for loss in steps.losses)
    assert steps.losses[-1] < steps.losses[0]
    assert 0 < steps.seconds < 60
    module = build_module(cfg, build_model(cfg, pretrained=False))
    module.stage.freeze(module.model)
    trained = sum(p.numel() for p in module.model.parameters() if p.requires_grad)
    assert steps.peak > 4 * 4 * trained


@pytest.mark.nightly
def test_step_measures_every_stage_and_writes_a_row(tmp_path):
    for stage, name in (("stage1", "step-tiny-stage1.csv"), ("stage3", "step-tiny-stage3.csv")):
        command = [sys.executable, str(BENCHMARKS / "step.py"), "--preset", "tiny", "--stage", stage]
        options = ["--views", "2", "--rounds", "1", "--output", str(tmp_path)]
        done = subprocess.run([*command, *options, *SMALL], capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        with (tmp_path / name).open() as file:
            rows = {row["part"]: row for row in csv.DictReader(file)}
        assert float(rows["whole step"]["seconds"]) > 0
        assert float(rows["whole step"]["peak_mib"]) > 0
        assert float(rows["whole step"]["forecast_mib"]) > 0
        assert rows["whole step"]["precision"] == "32-true"
        assert ("occupancy head" in rows) == (stage == "stage1")
        assert "objects head" not in rows


@pytest.mark.nightly
def test_a_prediction_that_fails_ends_its_own_row(tmp_path):
    command = [sys.executable, str(BENCHMARKS / "prediction.py"), "--preset", "tiny", *SMALL]
    options = ["--views", "2", "--views-at-once", "all", "0", "--output", str(tmp_path)]
    done = subprocess.run([*command, *options], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    with (tmp_path / "prediction-tiny-2.csv").open() as file:
        right, wrong = csv.DictReader(file)
    assert float(right["peak_mib"]) > 0
    assert right["error"] == ""
    assert wrong["error"]
    assert wrong["peak_mib"] == ""
