# SPDX-License-Identifier: Apache-2.0
"""A run that was stopped and resumed ends as one that was not: same weights, same logged metrics."""

from __future__ import annotations

import errno
import logging
import os
import random
import shutil
import signal

import numpy as np
import pytest
import torch

from raytran.checkpoints.runs import FINISHED, LAST, PREVIOUS, one_at_a_time, read_finished
from raytran.errors import CheckpointError, ConfigError
from raytran.training.lightning_module import Reconstruction

from .runs import assert_same, fit, table

STEPS = 8


class Killed(BaseException):
    """Stands for SIGKILL: nothing of the run's own hears of it."""


@pytest.fixture(scope="module")
def base(settings):
    """Validation after steps 3 and 6; checkpoints after 2, 4, 6."""
    return [
        *settings,
        "resume=auto",
        f"trainer.max_steps={STEPS}",
        "watch.pictures=0",
        "trainer.val_check_interval=3",
        "checkpoint_every=2",
    ]


def kill_at(monkeypatch, hook, call):
    """Let the ``call``-th call of a method of the module raise, before it does anything."""
    original, calls = getattr(Reconstruction, hook), []

    def counted(*arguments, **named):
        calls.append(None)
        if len(calls) == call:
            raise Killed
        return original(*arguments, **named)

    monkeypatch.setattr(Reconstruction, hook, counted)


@pytest.fixture(scope="module", autouse=True)
def chance():
    """Random numbers in every step: the network draws none of its own yet, and may one day."""
    original = Reconstruction.training_step

    def step(self, batch, batch_idx):
        outcome = original(self, batch, batch_idx)
        chance = torch.rand(()) + random.random() + np.random.rand()  # noqa: NPY002
        return outcome | {"loss": outcome["loss"] * chance}

    with pytest.MonkeyPatch.context() as context:
        context.setattr(Reconstruction, "training_step", step)
        yield


@pytest.fixture(scope="module")
def straight(base, tmp_path_factory):
    """A run that nobody stopped."""
    folder = fit(base, tmp_path_factory.mktemp("straight") / "run").folder
    assert [row["step"] for row in table(folder) if "val/total" in row] == ["2", "5"]
    assert [row["step"] for row in table(folder) if "train/total" in row] == [str(i) for i in range(STEPS)]
    return folder


@pytest.mark.parametrize(
    ("hook", "call"),
    [
        ("training_step", 4),  # from the checkpoint of step 2, in the middle of an epoch
        ("validation_step", 1),  # in the validation after step 3
        ("on_validation_epoch_end", 2),  # at the end of the one after step 6: the checkpoint is of step 4
        ("training_step", 7),  # checkpoint of step 6, written after its validation
    ],
)
def test_a_kill_anywhere(base, straight, tmp_path, monkeypatch, hook, call):
    with monkeypatch.context() as context:
        kill_at(context, hook, call)
        with pytest.raises(Killed):
            fit(base, tmp_path / "run")
    fit(base, tmp_path / "run")
    assert_same(tmp_path / "run", straight)


def test_a_kill_with_four_loader_workers_ends_as_a_run_without_any(base, tmp_path, monkeypatch):
    changes = ["data.augmentation.yaw_deg=180", "data.augmentation.mirror=0.5"]
    fit([*base, *changes, "views.num_workers=0"], tmp_path / "straight")
    workers = [*base, *changes, "views.num_workers=4"]
    with monkeypatch.context() as context:
        kill_at(context, "training_step", 7)
        with pytest.raises(Killed):
            fit(workers, tmp_path / "run")
    fit(workers, tmp_path / "run")
    assert_same(tmp_path / "run", tmp_path / "straight")


def send_at(monkeypatch, hook, call, signum):
    """Send this process a signal within the ``call``-th call of a method of the module."""
    original, calls = getattr(Reconstruction, hook), []

    def counted(*arguments, **named):
        calls.append(None)
        if len(calls) == call:
            os.kill(os.getpid(), signum)
        return original(*arguments, **named)

    monkeypatch.setattr(Reconstruction, hook, counted)


@pytest.mark.parametrize(
    ("hook", "call", "signum", "step", "validation_due"),
    [
        ("training_step", 4, signal.SIGTERM, 4, False),
        ("training_step", 6, signal.SIGUSR1, 6, True),  # the validation after step 6 is not waited for
        ("validation_step", 1, signal.SIGTERM, 3, True),
        ("training_step", 1, signal.SIGINT, 1, False),
    ],
)
def test_a_signal_saves_the_step_in_hand(
    base, straight, tmp_path, monkeypatch, hook, call, signum, step, validation_due
):
    run = tmp_path / "run"
    before = signal.getsignal(signum)
    with monkeypatch.context() as context:
        send_at(context, hook, call, signum)
        with pytest.raises(SystemExit) as stopped:
            fit(base, run)
    assert stopped.value.code == 128 + signum
    assert signal.getsignal(signum) == before
    saved = torch.load(run / LAST, weights_only=True)
    assert (saved["global_step"], saved["resume"]["validation_due"]) == (step, validation_due)
    assert not (run / FINISHED).exists()
    fit(base, run)
    assert_same(run, straight)


def test_a_signal_in_the_last_step_is_too_late(base, straight, tmp_path, monkeypatch):
    with monkeypatch.context() as context:
        send_at(context, "training_step", STEPS, signal.SIGTERM)
        fit(base, tmp_path / "run")
    assert_same(tmp_path / "run", straight)


def test_steps_of_several_batches(base, tmp_path, monkeypatch):
    """Three batches a step: a kill within a step goes back to its first batch."""
    steps = [*base, "trainer.accumulate_grad_batches=3", "trainer.val_check_interval=6"]
    fit(steps, tmp_path / "straight")
    with monkeypatch.context() as context:
        kill_at(context, "training_step", 15)
        with pytest.raises(Killed):
            fit(steps, tmp_path / "run")
    assert torch.load(tmp_path / "run" / LAST, weights_only=True)["global_step"] == 4
    fit(steps, tmp_path / "run")
    assert_same(tmp_path / "run", tmp_path / "straight")


def test_a_damaged_checkpoint_costs_some_steps_and_nothing_else(
    base, straight, tmp_path, monkeypatch, caplog
):
    run = tmp_path / "run"
    with monkeypatch.context() as context:
        kill_at(context, "training_step", 8)
        with pytest.raises(Killed):
            fit(base, run)
    (run / LAST).write_bytes((run / LAST).read_bytes()[:-1000])
    fit(base, run)
    assert "going on from the one before it" in caplog.text
    assert_same(run, straight)


def test_a_full_disk_does_not_stop_a_run_that_has_steps_to_go(base, straight, tmp_path, monkeypatch, caplog):
    run, save = tmp_path / "run", torch.save

    def refuse(content, file, **options):
        if isinstance(content, dict) and content.get("global_step") in full:
            file.write(b"half of it")
            raise OSError(errno.ENOSPC, "No space left on device")
        save(content, file, **options)

    monkeypatch.setattr(torch, "save", refuse)
    full = {4}
    fit(base, run)
    assert caplog.text.count("(No space left on device): make room there") == 1
    assert_same(run, straight)

    # At the end it cannot be hidden.
    full, run = {6, STEPS}, tmp_path / "another"
    with pytest.raises(CheckpointError, match="No space left on device"):
        fit(base, run)
    assert not (run / FINISHED).exists()
    assert torch.load(run / LAST, weights_only=True)["global_step"] == 4
    full = set()
    fit(base, run)
    assert_same(run, straight)


def test_an_earlier_checkpoint_can_be_named(base, straight, tmp_path, caplog):
    run = tmp_path / "run"
    shutil.copytree(straight, run)
    (run / FINISHED).unlink()
    fit(base, run, f"resume={run / PREVIOUS}")
    assert_same(run, straight)
    assert "another setting" not in caplog.text


def test_a_finished_run_goes_on_with_more_steps(base, straight, tmp_path, caplog):
    run, few = tmp_path / "run", f"trainer.max_steps={STEPS // 2}"
    assert fit(base, run, few).steps == STEPS // 2
    written = (run / LAST).stat().st_mtime_ns
    with caplog.at_level(logging.INFO, logger="raytran"):
        for same_or_fewer in (few, "trainer.max_steps=2"):
            assert fit(base, run, same_or_fewer).steps == STEPS // 2
    assert caplog.text.count("has finished already (stage1, 4 steps)") == 2
    assert (run / LAST).stat().st_mtime_ns == written
    assert fit(base, run).steps == STEPS
    assert "another setting, trainer.max_steps: 4 → 8" in caplog.text
    # The learning rate still rises in all of these steps, so that it does not know how many come.
    assert_same(run, straight)
    assert read_finished(run).steps == STEPS


def test_a_finished_run_goes_on_from_the_command_line(settings, tmp_path, command):
    words = [
        *settings,
        "experiment=stage1",
        "watch.pictures=0",
        "trainer.val_check_interval=2",
        "progress_bar=none",
    ]
    run = "output_dir=run (1)"  # the words of the run's folder are quoted for Hydra

    def train(*more):
        done = command("train", *words, run, *more, folder=tmp_path)
        assert done.returncode == 0, done.stderr
        return done.stdout + done.stderr

    train("trainer.max_steps=2")
    assert "goes on" in train("trainer.max_steps=4", "resume=run (1)/checkpoints/last.ckpt")
    assert "has finished already (stage1, 4 steps)" in train("trainer.max_steps=4", "resume=auto")
    assert read_finished(tmp_path / "run (1)").steps == 4


def test_a_finished_run_that_goes_on_is_unfinished(base, straight, tmp_path, monkeypatch):
    run = tmp_path / "run"
    fit(base, run, f"trainer.max_steps={STEPS // 2}")
    with monkeypatch.context() as context:
        kill_at(context, "training_step", 3)
        with pytest.raises(Killed):
            fit(base, run, f"resume={run / LAST}")
    assert not (run / FINISHED).exists()
    fit(base, run)
    assert_same(run, straight)


def test_a_run_that_stopped_early_has_finished(base, tmp_path, caplog):
    """Its mark has fewer steps than it was given: these are not more than before."""
    run = tmp_path / "run"
    fit(base, run, f"trainer.max_steps={STEPS // 2}")
    config = (run / "config.yaml").read_text()
    (run / "config.yaml").write_text(config.replace("max_steps: 4", f"max_steps: {STEPS}"))
    with caplog.at_level(logging.INFO, logger="raytran"):
        assert fit(base, run).steps == STEPS // 2
    assert "has finished already" in caplog.text
    (run / "config.yaml").write_text("[")  # damaged: the steps taken count
    assert fit(base, run).steps == STEPS


def test_two_processes_do_not_train_in_one_folder(base, tmp_path):
    with one_at_a_time(tmp_path / "run"), pytest.raises(ConfigError, match="another process trains in"):
        fit(base, tmp_path / "run")


def test_a_checkpoint_of_weights_alone_is_not_continued(base, straight, tmp_path):
    content = torch.load(straight / LAST, weights_only=True)
    for name in ("resume", "optimizer_states"):
        del content[name]
    (tmp_path / "run" / LAST).parent.mkdir(parents=True)
    torch.save(content, tmp_path / "run" / LAST)
    with pytest.raises(CheckpointError, match="no state of training: start a new run with init_from="):
        fit(base, tmp_path / "run")
