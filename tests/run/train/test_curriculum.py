# SPDX-License-Identifier: Apache-2.0
"""A curriculum and the commands it starts; tests/end_to_end trains whole ones."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time

import pytest

from raytran.checkpoints.runs import LAST
from raytran.errors import ConfigError
from raytran.run.entry import compose
from raytran.run.train import curriculum
from raytran.run.train.curriculum import RECORD, _run, run_curriculum
from raytran.run.train.fit import FitResult

# Says that it is there; ends with another code at a signal.
STAGE = """
import pathlib, signal, sys, time
for signum in (signal.SIGTERM, signal.SIGUSR1):
    signal.signal(signum, lambda number, _: sys.exit(40 + number))
pathlib.Path(sys.argv[1]).touch()
time.sleep(60)
"""


@pytest.mark.parametrize("signum", [signal.SIGTERM, signal.SIGUSR1])
def test_a_signal_is_passed_on_and_then_obeyed(tmp_path, signum):
    started = tmp_path / "started"

    def send():
        while not started.exists():
            time.sleep(0.01)
        os.kill(os.getpid(), signum)

    sender = threading.Thread(target=send)
    before = signal.getsignal(signum)
    sender.start()
    began = time.monotonic()
    with pytest.raises(SystemExit) as stopped:
        _run([sys.executable, "-c", STAGE, str(started)])
    sender.join()
    assert stopped.value.code == 128 + signum
    assert time.monotonic() - began < 50
    assert signal.getsignal(signum) == before


@pytest.mark.parametrize("code", [0, 3])
def test_the_code_of_a_command_is_known(code):
    assert _run([sys.executable, "-c", f"raise SystemExit({code})"]) == code


@pytest.mark.parametrize("text", ['{"overr', "[1]", ""])
def test_a_damaged_record_is_one_sentence(tmp_path, text):
    (tmp_path / RECORD).write_text(text)
    with pytest.raises(ConfigError, match=r"curriculum\.json is damaged: delete it"):
        run_curriculum(["preset=tiny"], output_dir=tmp_path)


@pytest.mark.parametrize(
    ("stages", "message"),
    [
        (("stage1", "stage9"), "there is no experiment=stage9"),
        (("gt_masks_stage1",), "is called variant=gt_masks experiment=stage1 now"),
    ],
)
def test_an_experiment_that_does_not_exist_leaves_no_record(tmp_path, stages, message):
    with pytest.raises(ConfigError, match=message):
        run_curriculum(["preset=tiny"], output_dir=tmp_path, stages=stages)
    assert not any(tmp_path.iterdir())


def test_a_variant_holds_for_every_stage(tmp_path, monkeypatch):
    trained = []

    def fit(settings, folder):
        trained.append(compose("train", settings))
        return FitResult(folder, folder / LAST, 1, 0.0, {})

    monkeypatch.setattr(curriculum, "_fit", fit)
    run_curriculum(["preset=tiny", "variant=gt_masks"], output_dir=tmp_path)
    assert [cfg.experiment for cfg in trained] == [f"gt_masks_stage{number}" for number in (1, 2, 3)]
    assert {cfg.model.backbone.encoder.input_channels for cfg in trained} == {4}
    assert [cfg.init_from for cfg in trained[1:]] == [
        str(tmp_path / stage / LAST) for stage in ("stage1", "stage2")
    ]
