# SPDX-License-Identifier: Apache-2.0
"""The commands that train and evaluate, on generated rooms."""

from __future__ import annotations

import csv
import json
import os
import shutil
import signal
import time

import pytest
import torch

import raytran
from raytran.checkpoints.runs import FINISHED, LAST, read_finished
from raytran.errors import CheckpointError, ConfigError
from raytran.ops.triton import block_pairs
from raytran.run.train.curriculum import run_curriculum
from raytran.training.history import read_history

from .runs import fit


@pytest.fixture(scope="module")
def trained(settings, tmp_path_factory):
    """The folder of a finished curriculum and its results."""
    folder = tmp_path_factory.mktemp("curriculum")
    return folder, run_curriculum(settings, output_dir=folder)


def same_weights(a, b, prefix=""):
    state_a, state_b = (torch.load(path, weights_only=True)["state_dict"] for path in (a, b))
    return {name for name in state_a if name.startswith(prefix) and torch.equal(state_a[name], state_b[name])}


def test_a_curriculum_trains_three_stages(trained):
    folder, fits = trained
    assert [fit.folder.name for fit in fits] == ["stage1", "stage2", "stage3"]
    stages = [read_finished(fit.folder) for fit in fits]
    assert [(mark.stage, mark.preset, mark.steps) for mark in stages] == [
        ("stage1", "tiny", 4),
        ("stage2", "tiny", 4),
        ("stage3", "tiny", 4),
    ]
    cards = [torch.load(fit.checkpoint, weights_only=True) for fit in fits]
    assert cards[0]["parent"] is None
    assert [card["parent"]["path"] for card in cards[1:]] == [str(fit.checkpoint) for fit in fits[:2]]
    assert read_finished(folder).stage == "curriculum"


def test_a_stage_starts_from_its_parent_and_keeps_what_is_frozen(trained):
    _, fits = trained
    names = set(torch.load(fits[1].checkpoint, weights_only=True)["state_dict"])
    kept = same_weights(fits[1].checkpoint, fits[2].checkpoint)
    assert kept == {name for name in names if not name.startswith("model.heads.shape.")}
    # Stage 2 does not train the shape head: it is still that of stage 1.
    assert same_weights(fits[0].checkpoint, fits[1].checkpoint, "model.heads.shape.")


def test_a_trained_head_is_exchanged_where_that_is_asked_for(trained, settings, tmp_path):
    """Another shape head, which reads boxes, on the network of a finished curriculum; then it predicts."""
    parent = trained[1][2].checkpoint
    other = [
        *settings,
        "experiment=stage3",
        f"init_from={parent}",
        "check_parent=none",
        "model/extensions=[proposal_queries,windowed_attention,box_voxels]",
        "trainer.max_steps=2",
    ]
    with pytest.raises(CheckpointError, match="do not fit this model"):
        fit(other, tmp_path / "refused")
    with pytest.raises(ConfigError, match=r"restarted_parts names 'backbone', which stage3 does not train"):
        fit([*other, "stage.restarted_parts=[backbone]"], tmp_path / "frozen")
    run = fit([*other, "stage.restarted_parts=[heads.shape]"], tmp_path / "run")
    kept = same_weights(parent, run.checkpoint)
    assert {"model.backbone.unseen", "model.heads.objects.position.weight"} <= kept
    assert not any(name.startswith("model.heads.shape.start") for name in kept)
    model = raytran.load(run.checkpoint)
    assert type(model.heads["shape"]).__name__ == "BoxVoxelShapeHead"


def test_a_finished_curriculum_is_not_trained_again(trained, settings):
    folder, fits = trained
    before = [fit.checkpoint.stat().st_mtime_ns for fit in fits]
    again = run_curriculum(settings, output_dir=folder)
    assert [fit.checkpoint.stat().st_mtime_ns for fit in again] == before
    assert [fit.seconds for fit in again] == [0, 0, 0]


def test_a_curriculum_with_other_settings_is_not_continued(trained, settings):
    with pytest.raises(ConfigError, match="resume=none to start a new one"):
        run_curriculum([*settings, "seed=3"], output_dir=trained[0])
    with pytest.raises(ConfigError, match=r"stages=\["):
        run_curriculum([*settings, "experiment=stage2"], output_dir=trained[0])


def test_a_killed_curriculum_goes_on_where_it_was(trained, settings, tmp_path):
    folder = tmp_path / "curriculum"
    shutil.copytree(trained[0], folder)
    for gone in ("finished.json", "stage2/finished.json"):
        (folder / gone).unlink()
    shutil.rmtree(folder / "stage3")
    before = (folder / "stage1" / LAST).stat().st_mtime_ns
    fits = run_curriculum(settings, output_dir=folder)
    assert fits[0].checkpoint.stat().st_mtime_ns == before
    assert [read_finished(fit.folder).steps for fit in fits] == [4, 4, 4]
    # Stage 2 had taken its four steps: resumed, it logs no further one.
    assert len(read_history(fits[1].folder)["train/total"]) == 4
    assert torch.load(fits[2].checkpoint, weights_only=True)["parent"]["path"] == str(fits[1].checkpoint)


def test_curves_can_be_read(trained):
    history = read_history(trained[1][1].folder)
    assert [step for step, _ in history["train/objects/center"]] == [0, 1, 2, 3]
    assert len(history["val/objects/accuracy_global"]) == 2


def test_a_run_describes_itself(trained):
    folder = trained[1][0].folder
    assert "learning_rate: 0.001" in (folder / "config.yaml").read_text()
    assert json.loads((folder / "provenance.json").read_text())["versions"]["torch"] == torch.__version__


def test_a_trained_model_is_loaded_and_predicts(trained, rooms):
    from raytran.data.scannet.scan import load_views

    model = raytran.load(trained[1][2].checkpoint)
    scan = sorted((rooms / "scannet" / "scans").iterdir())[0]
    views, _ = load_views(scan, image_size=(64, 64), num_views=3)
    prediction = model.predict(views)
    assert len(prediction.objects) == 8
    assert prediction.objects.shape.shape == (8, 63, 63, 63)


def test_resume_continues_in_the_same_folder(settings, tmp_path):
    folder = tmp_path / "run"
    straight = fit(settings, tmp_path / "straight", "trainer.max_steps=6")
    fit(settings, folder)
    (folder / "finished.json").unlink()
    resumed = fit(settings, folder, "trainer.max_steps=6", "resume=auto")
    assert (straight.steps, resumed.steps) == (6, 6)
    assert [step for step, _ in read_history(folder)["train/total"]] == [0, 1, 2, 3, 4, 5]
    content = torch.load(resumed.checkpoint, weights_only=True)
    assert content["lr_schedulers"][0]["last_epoch"] == 6
    assert next(iter(content["optimizer_states"][0]["state"].values()))["step"] == 6


def test_frozen_statistics_stay_in_a_run(settings, trained, tmp_path):
    parent = trained[1][1].checkpoint
    found = fit(settings, tmp_path / "run", "experiment=frozen_norms_stage2", f"init_from={parent}")
    state = torch.load(found.checkpoint, weights_only=True)["state_dict"]
    statistics = {name for name in state if "running_" in name or "num_batches" in name}
    assert statistics
    same = same_weights(parent, found.checkpoint)
    assert statistics <= same < set(state)


@pytest.mark.slow
def test_attention_is_computed_as_the_run_says(settings, tmp_path, monkeypatch):
    """Fused in Triton's interpreter, which rounds otherwise, and by torch.sparse: nearly the same loss."""
    pytest.importorskip("triton", reason="Triton is not installed: there are no fused kernels")
    monkeypatch.setattr(block_pairs, "_SLOTS", 16)
    more = [
        "experiment=stage1",
        "trainer.max_steps=1",
        "+trainer.limit_val_batches=0",
        "views.num_views=2",
        "views.batch_size=1",
        "model.rays_per_cell=1",
        "model.backbone.num_blocks=1",
    ]
    fits = {
        name: fit(settings, tmp_path / name, *more, f"model.attention={name}") for name in ("fused", "sparse")
    }
    fused, sparse = (found.metrics["train/total"] for found in fits.values())
    assert fused == pytest.approx(sparse, rel=1e-5)
    assert not set(torch.load(fits["fused"].checkpoint, weights_only=True)["state_dict"]) <= same_weights(
        *(found.checkpoint for found in fits.values())
    )
    assert raytran.load(fits["fused"].checkpoint).ray_tracer.attention == "auto"


def test_fused_attention_without_a_gpu_is_one_sentence(
    settings, trained, rooms, tmp_path, command, monkeypatch
):
    monkeypatch.delenv("TRITON_INTERPRET", raising=False)
    scan = rooms / "scannet" / "scans" / "scene0000_00"
    runs = [
        command("train", *settings, "experiment=stage1", "model.attention=fused", folder=tmp_path),
        command(
            "predict",
            f"checkpoint={trained[1][-1].checkpoint}",
            f"scene={scan}",
            "output=prediction",
            "device=cpu",
            "attention=fused",
            folder=tmp_path,
        ),
    ]
    for result in runs:
        assert result.returncode == 1
        assert "attention=fused needs a GPU with Triton, but tensors are on the CPU" in result.stderr
        assert "Traceback" not in result.stderr


def test_a_run_is_not_overwritten(settings, trained):
    with pytest.raises(ConfigError, match="holds a run already"):
        fit(settings, trained[1][0].folder)


def test_a_run_is_not_continued_as_another_stage(settings, trained, tmp_path):
    target = tmp_path / "run" / LAST
    target.parent.mkdir(parents=True)
    target.write_bytes(trained[1][0].checkpoint.read_bytes())
    with pytest.raises(CheckpointError, match="is of stage1, not stage2"):
        fit(settings, tmp_path / "run", "experiment=stage2", "resume=auto")


def test_init_from_auto_takes_the_newest_parent(settings, trained, tmp_path):
    outputs = tmp_path / "outputs"
    with pytest.raises(ConfigError, match=r"`raytran train experiment=stage1 preset=tiny` first"):
        fit(settings, outputs / "tiny" / "stage2" / "a", "experiment=stage2", f"outputs={outputs}")
    parent = fit(settings, outputs / "tiny" / "stage1" / "a", f"outputs={outputs}")
    child = fit(settings, outputs / "tiny" / "stage2" / "b", "experiment=stage2", f"outputs={outputs}")
    assert torch.load(child.checkpoint, weights_only=True)["parent"]["path"] == str(parent.checkpoint)


def test_one_stage_1_does_for_another_object_head(settings, trained, tmp_path, caplog):
    other = [
        "experiment=stage2",
        f"init_from={trained[1][0].checkpoint}",
        "model.heads.objects.queries=null",
    ]
    with caplog.at_level("INFO", "raytran"):
        child = fit(settings, tmp_path / "run", *other)
    assert "heads.objects starts at random" in caplog.text
    with pytest.raises(CheckpointError, match="do not fit this model"):
        fit(settings, tmp_path / "next", "experiment=stage3", f"init_from={child.checkpoint}")


def test_a_missing_parent_is_one_sentence(settings, tmp_path):
    with pytest.raises(CheckpointError, match=r"no checkpoint at .*none\.ckpt"):
        fit(settings, tmp_path / "run", "experiment=stage2", f"init_from={tmp_path / 'none.ckpt'}")


def test_a_parent_cut_in_half_is_one_sentence_and_exit_code_1(settings, trained, tmp_path, command):
    cut = tmp_path / "cut.ckpt"
    content = trained[1][0].checkpoint.read_bytes()
    cut.write_bytes(content[: len(content) // 2])
    done = command("train", *settings, "experiment=stage2", f"init_from={cut}", folder=tmp_path)
    assert done.returncode == 1
    assert done.stderr.startswith("raytran: cannot read")
    assert "damaged or cut short" in done.stderr
    assert len(done.stderr.splitlines()) == 1


def test_evaluate_writes_numbers(trained, rooms, tmp_path, command):
    checkpoint = trained[1][2].checkpoint
    done = command(
        "evaluate", f"checkpoint={checkpoint}", f"data.root={rooms}", "output=results", folder=tmp_path
    )
    assert done.returncode == 0, done.stderr
    metrics = json.loads((tmp_path / "results" / "metrics.json").read_text())
    assert metrics["strict"]["n_scenes"] == 1
    with (tmp_path / "results" / "per_object.csv").open() as file:
        assert len(list(csv.DictReader(file))) == metrics["strict"]["n_total"]
    assert set(metrics["strict"]["per_threshold"]) == {"0.25", "0.5"}
    assert 0 <= metrics["occupancy_iou"] <= 1
    assert 0 <= metrics["foreground_iou"] <= 1
    assert sorted(path.name for path in (tmp_path / "results").iterdir()) == [
        "accuracy_curves.png",
        "atlas.json",
        "metrics.json",
        "per_object.csv",
        "per_scene.csv",
        "reliability.png",
    ]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("stop", "code"), [(signal.SIGINT, 130), pytest.param(signal.SIGTERM, 143, marks=pytest.mark.nightly)]
)
def test_a_stopped_run_goes_on(stop, code, settings, tmp_path, command):
    long = [*settings, "trainer.max_steps=400", "checkpoint_every=100000", "trainer.val_check_interval=1000"]
    process = command.start("train", *long, folder=tmp_path)
    deadline = time.monotonic() + 120
    while (
        sum(path.read_text().count("\n") for path in tmp_path.glob("outputs/tiny/stage1/*/metrics.csv")) < 4
    ):
        assert time.monotonic() < deadline
        time.sleep(0.05)
    os.kill(process.pid, stop)
    done = process.wait()
    assert done.returncode == code, done.stderr
    (run,) = tmp_path.glob("outputs/tiny/stage1/*")
    step = torch.load(run / LAST, weights_only=True)["global_step"]
    assert 0 < step < 400
    last = f"trainer.max_steps={step + 2}"
    done = command("train", *long, last, "resume=auto", folder=tmp_path)
    assert done.returncode == 0, done.stderr
    assert read_finished(run).steps == step + 2
    assert [folder.name for folder in run.parent.iterdir()] == [run.name]


@pytest.mark.slow
def test_two_processes_train_together(settings, trained, tmp_path, command):
    """They stop after two of four steps, and go on."""
    run = tmp_path / "run"
    arguments = [
        *(item for item in settings if item != "trainer=cpu"),
        "trainer=ddp_cpu",
        "experiment=stage2",
        f"init_from={trained[1][0].checkpoint}",
        f"output_dir={run}",
        "resume=auto",
    ]
    for steps in (2, 4):
        done = command("train", *arguments, f"trainer.max_steps={steps}", folder=tmp_path, starts=1)
        assert done.returncode == 0, done.stderr
        assert read_finished(run).steps == steps
        # Two scenes on each of two ranks a step.
        counted = torch.load(run / LAST, weights_only=True)["SceneDataModule"]
        assert counted == {"scenes": 4 * steps, "step": steps}
        if steps == 2:
            (run / FINISHED).unlink()
    assert [step for step, _ in read_history(run)["train/total"]] == [0, 1, 2, 3]
    assert not any(tmp_path.glob("outputs/**/last.ckpt"))
