# SPDX-License-Identifier: Apache-2.0
"""The one command for a machine with a GPU, on the pretend device, and with steps that end badly."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from device import Device
from fit import random_batch, step_config
from gpu_day import environment
from gpu_day.checks import Check, Checks, read_entries
from gpu_day.context import Context, Sizes
from gpu_day.report import Part, write_report
from gpu_day.training import compare_ranks
from torch.utils import backend_registration

from raytran.run.plan.camera_paths import walk
from raytran.run.train.build import build_model

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"
SCRIPT = BENCHMARKS / "gpu_day.py"
COUNTED = ("waits in a step of", "kernels launched in a step of")


def run(*arguments, script=SCRIPT, **options):
    command = [sys.executable, str(script), *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False, **options)


def read(folder):
    report = json.loads((folder / "report.json").read_text())
    return report, {check["name"]: check for part in report["parts"] for check in part["checks"]}


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_a_machine_without_a_gpu_is_told_so(tmp_path):
    done = run("--output", tmp_path / "day")
    assert done.returncode == 1
    assert (
        done.stderr.strip() == "gpu_day.py needs an NVIDIA GPU that this torch can use, and finds none here"
    )
    assert not (tmp_path / "day").exists()


@pytest.mark.nightly
@pytest.mark.skipif(
    not hasattr(backend_registration, "_setup_privateuseone_for_python_backend"),
    reason="this torch takes no backend in Python",
)
def test_the_whole_day_on_the_pretend_device(tmp_path):
    pytest.importorskip("triton", reason="Triton is not installed: the kernels have nothing to run on")
    done = run("--output", tmp_path, "--device", "pretend")
    report, checks = read(tmp_path)
    text = (tmp_path / "report.md").read_text()
    assert [part["state"] for part in report["parts"]] == ["done"] * 5, text + done.stderr
    failed = [name for name, check in checks.items() if check["verdict"] == "FAIL"]
    # How often the host waits is counted here as it is; other tests hold that down.
    assert all(name.startswith(COUNTED) for name in failed), text
    assert report["failed"] == len(failed)
    assert done.returncode == (1 if failed else 0), done.stderr
    assert all(f"| {name} |" in text for name in checks)
    assert all(f"**{name}**" in text for name in failed)

    for stage in ("stage1", "stage2", "stage3"):
        waits = checks[f"waits in a step of {stage}"]
        assert int(waits["measured"]) == sum(int(line.split("×")[0]) for line in waits["notes"])
        assert all(".py:" in line for line in waits["notes"])
        assert int(checks[f"kernels launched in a step of {stage}"]["measured"].replace(",", "")) > 100
    for name in (
        "traversal",
        "attention, pixels to voxels, float32, heads of 32",
        "gradients by finite differences, voxels to pixels, float32",
        "splat, float32",
        "network tiny, stage2, small size: the device against the CPU",
        "network tiny, stage2, small size: attention fused against sparse",
        "network tiny, stage2, full size: the device against the CPU",
        "curriculum in 32-true",
        "loss of stage3 in 32-true",
        "F1 at IoU 0.25 of the training rooms, 32-true",
        "predict after 32-true",
        "killed by SIGKILL and resumed",
        "exact box IoU, the device against the CPU",
    ):
        assert checks[name]["verdict"] == "pass", name
    assert checks["bits of the resumed run"]["measured"] == "every weight has the same bits"
    timed = [name for name, check in checks.items() if "no clock and no memory" in check["why"]]
    for start in (
        "traversal, ",
        "attention pixels to voxels, forward and backward: against FlexAttention",
        "attention voxels to pixels, forward and backward: against gather",
        "attention voxels to pixels, forward and backward: against the bytes",
        "attention pixels to voxels, 3 frames: memory",
        "training step of stage 2, 2 frames: peak",
        "training step of stage 2, 2 frames: raytran.plan",
        "prediction from 3 frames, 16 at once: peak",
    ):
        assert any(name.startswith(start) for name in timed), start


BADLY = """
import importlib.util, sys
from pathlib import Path

sys.path.insert(0, {benchmarks!r})
spec = importlib.util.spec_from_file_location("day", {script!r})
day = importlib.util.module_from_spec(spec)
sys.modules["day"] = day
spec.loader.exec_module(day)
day.__file__ = __file__
import gpu_day
gpu_day.__path__.append(str(Path(__file__).parent))
day.STEPS = {{name: day.Step(part, f"badly.{{name}}", 6) for name, part in {steps!r}.items()}}
folder = Path(sys.argv[sys.argv.index("--output") + 1])
if "--steps" in sys.argv:
    day.run_here(sys.argv[sys.argv.index("--steps") + 1:], folder, "cuda")
else:
    sys.exit(len(day.run_parts(list(day.PARTS), folder, "cuda")))
"""

MODULE = """
import os, signal, subprocess, sys, time

def well(context):
    context.checks.add("all is well", bar="it is", measured="yes", passed=True)

def raises(context):
    context.checks.add("before the exception", measured="1")
    with context.checks.attempt("one check", "a bar"):
        raise ValueError("of one check\\nand more")
    context.checks.add("between", measured="2")
    raise RuntimeError("of the step")

def dies(context):
    context.checks.add("before the crash", measured="3")
    print("last words", flush=True)
    os.kill(os.getpid(), signal.SIGSEGV)

def hangs(context):
    child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)"])
    (context.output / "child").write_text(str(child.pid))
    time.sleep(600)
"""

STEPS = {"raises": "kernels", "dies": "waits", "hangs": "training", "well": "bars"}


@pytest.mark.slow
@pytest.mark.nightly
def test_what_ends_badly_stops_nothing_else(tmp_path):
    script, folder = tmp_path / "day.py", tmp_path / "report"
    folder.mkdir()
    script.write_text(BADLY.format(benchmarks=str(BENCHMARKS), script=str(SCRIPT), steps=STEPS))
    (tmp_path / "badly.py").write_text(MODULE)
    done = run("--output", folder, script=script)
    report, checks = read(folder)
    assert done.returncode == report["failed"] == 4, done.stderr
    assert checks["one check"]["why"] == "ValueError: of one check"
    assert checks["one check"]["bar"] == "a bar"
    assert checks["before the exception"]["measured"] == "1"
    assert checks["between"]["measured"] == "2"
    assert checks["step raises"]["why"] == "RuntimeError: of the step"
    assert checks["before the crash"]["measured"] == "3"
    assert checks["process of dies"]["why"] == "ended by signal 11 (Segmentation fault)"
    assert "last words" in checks["process of dies"]["notes"]
    assert checks["process of hangs"]["why"] == "stopped after 6 s"
    assert checks["all is well"]["verdict"] == "pass"
    assert [part["state"] for part in report["parts"]] == ["not run", "done", "done", "done", "done"]
    assert report["parts"][3]["seconds"] >= 6
    child = int((folder / "child").read_text())
    assert not Path(f"/proc/{child}").exists() or " Z " in Path(f"/proc/{child}/stat").read_text()


def test_the_report_says_how_far_it_is(tmp_path):
    check = Check("a | b", "≤ 1", "2", "FAIL", why="too\nmuch", notes=("a line",))
    parts = [
        Part("one", "First", [check, Check("c", "", "–", "not measured", "no GPU")], 61.0, "running"),
        Part("two", "Second"),
    ]
    write_report(tmp_path, {"gpu": "1 × X", "driver": "1.2", "date": "2026-01-01"}, parts)
    text = (tmp_path / "report.md").read_text()
    assert "gpu 1 × X, driver 1.2, date 2026-01-01" in text
    assert "1 failed, 1 not measured; still to come: one, two" in text
    assert "- **a | b**: 2; bar ≤ 1; too\nmuch" in text
    assert "| a \\| b | ≤ 1 | 2 | FAIL: too much |" in text
    assert "| c | – | – | not measured: no GPU |" in text
    assert "running, 0:01:01" in text
    assert "```\na line\n```" in text
    assert json.loads((tmp_path / "report.json").read_text())["failed"] == 1


def test_lines_that_a_crash_cut_short_are_left_out(tmp_path):
    path = tmp_path / "checks.jsonl"
    assert read_entries(path) == []
    Checks(path).add("first", measured="1")
    with path.open("a") as file:
        file.write('{"check": {"na')
    assert [entry["check"]["name"] for entry in read_entries(path)] == ["first"]
    Checks(path).add("second", measured="2")
    assert [entry["check"]["name"] for entry in read_entries(path)] == ["first", "second"]


@pytest.mark.nightly
def test_ranks_take_the_steps_of_one(tmp_path, monkeypatch):
    """What several GPUs are asked for, by two processes on the CPU."""
    monkeypatch.setenv("OMP_NUM_THREADS", "1")

    small = [
        "rooms.num_val=1",
        "rooms.frames=6",
        "rooms.image_size=[64,64]",
        "rooms.max_objects=3",
        "rooms.processes=1",
        "views.image_size=[64,64]",
        "views.num_views=3",
        "model.grid_resolution=[8,8,4]",
    ]
    path = tmp_path / "checks.jsonl"
    context = Context(Checks(path), Device(), Sizes(training=tuple(small)), tmp_path)
    compare_ranks(context, tmp_path, 2, one=["trainer=cpu"], several=["trainer=ddp_cpu"])
    (entry,) = read_entries(path)
    assert entry["check"]["verdict"] == "pass", entry
    assert "in 20 steps" in entry["check"]["measured"]
    assert (tmp_path / "several" / "finished.json").is_file()


@pytest.mark.parametrize(
    ("version", "verdict", "words"),
    [
        (90701, "pass", "9.7.1"),
        (90800, "FAIL", "9.8.0"),
        (91002, "FAIL", "9.10.2"),
        (91500, "pass", "9.15.0"),
    ],
)
def test_a_cudnn_that_torch_does_without_is_named(tmp_path, monkeypatch, version, verdict, words):

    monkeypatch.setattr(torch.backends.cudnn, "version", lambda: version)
    environment.examine(Context(Checks(tmp_path / "checks"), Device(), Sizes(), tmp_path))
    checks = {e["check"]["name"]: e["check"] for e in read_entries(tmp_path / "checks") if "check" in e}
    assert (checks["cuDNN"]["verdict"], checks["cuDNN"]["measured"]) == (verdict, words)
    assert bool(checks["cuDNN"]["why"]) == (verdict == "FAIL")


def test_a_random_scene_can_be_put_into_page_locked_memory():
    """Which no tensor can that is expanded: some of its elements would be written to more than once."""

    cfg = step_config("tiny", "stage3", Device(), ["model.grid_resolution=[4,4,4]"])
    batch = random_batch(walk(2).scaled_to((32, 48)), build_model(cfg, pretrained=False), 2)

    def check(tensor):
        assert tensor.is_contiguous()
        return tensor

    structs = [batch, batch.views, *batch.objects]
    for struct in structs:
        struct._map(lambda item: check(item) if isinstance(item, torch.Tensor) else item)
