# SPDX-License-Identifier: Apache-2.0
"""The moving average of the weights in runs, against one that is computed from what was trained."""

from __future__ import annotations

import copy
import os
import signal
from types import SimpleNamespace

import lightning.pytorch as pl
import pytest
import torch

from raytran.checkpoints.file import BEST_NAME
from raytran.checkpoints.load import load_model
from raytran.checkpoints.runs import LAST
from raytran.errors import ConfigError
from raytran.run.entry import compose
from raytran.run.train.fit import train
from raytran.training.callbacks.averaged_weights import TRAINED, AveragedWeights
from raytran.training.lightning_module import Reconstruction

DECAY = 0.6


@pytest.fixture(scope="module")
def settings(small_rooms):
    return [
        *("preset=tiny", f"data.root={small_rooms}", "trainer=cpu", "experiment=stage1", "progress_bar=none"),
        *("views.image_size=[32,32]", "views.num_views=2", "views.predict_views=2", "watch.pictures=0"),
        *("model.grid_resolution=[8,8,4]", "trainer.max_steps=5", "trainer.val_check_interval=2"),
        *("checkpoint_every=2", "schedule.log_every=1", "resume=auto"),
    ]


def fit(settings, folder, *more):
    train(compose("train", [*settings, f"output_dir={folder}", *more]))
    return torch.load(folder / LAST, weights_only=True)


@pytest.fixture
def seen(monkeypatch):
    """The weights before each step, and those that each validation scores."""
    found = {"steps": [], "validations": []}

    def watch(hook, key):
        original = getattr(Reconstruction, hook)

        def watched(self, batch, batch_idx):
            if key == "steps" or batch_idx == 0:
                found[key].append({name: value.clone() for name, value in self.state_dict().items()})
            return original(self, batch, batch_idx)

        monkeypatch.setattr(Reconstruction, hook, watched)

    watch("training_step", "steps")
    watch("validation_step", "validations")
    return found


def averages(states):
    """The average after each state but the first, which it begins with."""
    average = {name: value.double() for name, value in states[0].items() if value.is_floating_point()}
    found = []
    for step, state in enumerate(states[1:], start=1):
        kept = min(DECAY, (1 + step) / (10 + step))
        average = {name: kept * value + (1 - kept) * state[name].double() for name, value in average.items()}
        found.append(average)
    return found


def assert_close(state, expected):
    for name, value in expected.items():
        torch.testing.assert_close(state[name].double(), value, rtol=1e-5, atol=1e-7, msg=name)


def test_the_average_is_scored_kept_and_handed_on(settings, tmp_path, seen):
    with_average = fit(settings, tmp_path / "a", f"ema.decay={DECAY}")
    states, scored = list(seen["steps"]), list(seen["validations"])
    seen["steps"].clear()
    without = fit(settings, tmp_path / "b")
    # The steps are those of a run without an average, to the last bit.
    for ours, theirs in zip(states, seen["steps"], strict=True):
        assert all(torch.equal(ours[name], value) for name, value in theirs.items())
    assert TRAINED not in without
    trained = with_average[TRAINED]
    assert all(torch.equal(trained[name], without["state_dict"][name]) for name in trained)
    after = averages([*states, without["state_dict"]])
    assert len(scored) == 2
    assert_close(scored[0], after[1])
    assert_close(scored[1], after[3])
    assert_close(with_average["state_dict"], after[4])
    assert any(not torch.equal(with_average["state_dict"][name], value) for name, value in trained.items())
    best = torch.load((tmp_path / "a" / LAST).with_name(BEST_NAME), weights_only=True)
    assert_close(best["state_dict"], after[best["global_step"] - 1])
    model = load_model(tmp_path / "a" / LAST)
    state = {f"model.{name}": value for name, value in model.state_dict().items()}
    assert_close(state, {name: value for name, value in after[4].items() if name in state})


def send_at(monkeypatch, hook, call):
    original, calls = getattr(Reconstruction, hook), []

    def counted(*arguments, **named):
        calls.append(None)
        if len(calls) == call:
            os.kill(os.getpid(), signal.SIGTERM)
        return original(*arguments, **named)

    monkeypatch.setattr(Reconstruction, hook, counted)


@pytest.fixture(scope="module")
def straight(settings, tmp_path_factory):
    """The end of a run that nobody stopped."""
    return fit(settings, tmp_path_factory.mktemp("straight"), f"ema.decay={DECAY}")


@pytest.mark.parametrize(("hook", "call"), [("training_step", 3), ("validation_step", 1)])
def test_a_run_that_was_stopped_ends_as_one_that_was_not(
    settings, straight, tmp_path, monkeypatch, hook, call
):
    """Between two steps, and in a validation, when the network has the average."""
    given = [*settings, f"ema.decay={DECAY}"]
    with monkeypatch.context() as context:
        send_at(context, hook, call)
        with pytest.raises(SystemExit):
            fit(given, tmp_path / "run")
    resumed = fit(given, tmp_path / "run")
    for key in ("state_dict", TRAINED):
        assert resumed[key].keys() == straight[key].keys()
        assert all(torch.equal(resumed[key][name], value) for name, value in straight[key].items())
    assert resumed["scores"] == straight["scores"]


def test_a_finished_run_goes_on_from_what_it_trained(settings, straight, tmp_path):
    given = [*settings, f"ema.decay={DECAY}"]
    fit(given, tmp_path / "run", "trainer.max_steps=3")
    longer = fit(given, tmp_path / "run")
    for key in ("state_dict", TRAINED):
        assert all(torch.equal(longer[key][name], value) for name, value in straight[key].items())


def test_steps_that_are_skipped_leave_the_average_finite(settings, tmp_path, monkeypatch, seen):
    original, calls = Reconstruction.training_step, []

    def spoiled(self, batch, batch_idx):
        calls.append(None)
        outcome = original(self, batch, batch_idx)
        return outcome | {"loss": outcome["loss"] * float("nan")} if len(calls) == 3 else outcome

    monkeypatch.setattr(Reconstruction, "training_step", spoiled)
    found = fit(settings, tmp_path, f"ema.decay={DECAY}")
    states = seen["steps"]
    parameters = [name for name in states[0] if "running" not in name and "batches" not in name]
    assert all(torch.equal(states[2][name], states[3][name]) for name in parameters)
    last = {**found["state_dict"], **found[TRAINED]}
    assert_close(found["state_dict"], averages([*states, last])[4])


@pytest.mark.parametrize("decay", ["0", "1", "1.5", "high", "true"])
def test_a_decay_that_is_no_share(settings, tmp_path, decay):
    with pytest.raises(ConfigError, match=r"ema\.decay must be above 0 and below 1, or null"):
        fit(settings, tmp_path, f"ema.decay={decay}")


def averaged_on_rank(rank, folder):
    """Save what a rank of two has: norms of its own statistics, weights that are the same on both."""
    torch.distributed.init_process_group("gloo", f"file://{folder}/meet", rank=rank, world_size=2)
    module = pl.LightningModule()
    module.norm = torch.nn.BatchNorm1d(1)
    callback, trainer = AveragedWeights(decay=DECAY), SimpleNamespace(global_step=0)
    callback.on_train_start(trainer, module)
    for trainer.global_step in (1, 2, 3):
        module.norm.weight.data += 1
        module.norm.running_mean += 1 + rank
        callback.on_train_batch_end(trainer, module, None, None, 0)
    checkpoint = {"state_dict": module.state_dict()}
    callback.on_save_checkpoint(trainer, module, checkpoint)
    checkpoint = copy.deepcopy(checkpoint)
    callback.on_validation_start(trainer, module)
    torch.save([checkpoint, module.state_dict()], f"{folder}/{rank}.pt")
    torch.distributed.destroy_process_group()


def test_two_ranks_have_one_average(tmp_path):
    processes = torch.multiprocessing.start_processes
    processes(averaged_on_rank, (str(tmp_path),), nprocs=2, start_method="fork")
    (first, scored), (second, other) = (torch.load(tmp_path / f"{rank}.pt") for rank in (0, 1))
    # After steps 1, 2 and 3 the average keeps 2/11, 3/12 and 4/13 of itself; the norm's mean is that of both.
    weight = (1 - 4 / 13) * 4 + 4 / 13 * ((1 - 3 / 12) * 3 + 3 / 12 * ((1 - 2 / 11) * 2 + 2 / 11))
    assert first["state_dict"]["norm.weight"].item() == pytest.approx(weight)
    assert first["state_dict"]["norm.running_mean"].item() == pytest.approx(1.5 * (weight - 1))
    assert (first[TRAINED]["norm.weight"].item(), first[TRAINED]["norm.running_mean"].item()) == (4, 3)
    assert second[TRAINED]["norm.running_mean"].item() == 6
    for found in (second["state_dict"], scored, other):
        assert all(torch.equal(found[name], value) for name, value in first["state_dict"].items())
