# SPDX-License-Identifier: Apache-2.0
"""Times of steps are remembered, added up or replaced."""

from __future__ import annotations

import pytest

from raytran.run.demo import demo
from raytran.run.demo.demo import StepTimes


@pytest.fixture
def clock(monkeypatch):
    """A clock that the test moves by hand."""
    now = [100.0]
    monkeypatch.setattr(demo.time, "monotonic", lambda: now[0])
    return now


def run(times: StepTimes, clock, seconds: float, **options) -> None:
    with times.measure("rooms", **options):
        clock[0] += seconds


def test_times_survive_and_add_up_or_are_replaced(tmp_path, clock):
    run(StepTimes(tmp_path / "times.json"), clock, 3.0)
    again = StepTimes(tmp_path / "times.json")
    run(again, clock, 4.0, continues=True)
    assert again.seconds == {"rooms": 7.0}
    run(again, clock, 2.0)
    assert StepTimes(tmp_path / "times.json").seconds == {"rooms": 2.0}


def fail_after(times: StepTimes, clock, seconds: float) -> None:
    with times.measure("rooms"):
        clock[0] += seconds
        raise KeyboardInterrupt


def test_an_interrupted_step_counts(tmp_path, clock):
    with pytest.raises(KeyboardInterrupt):
        fail_after(StepTimes(tmp_path / "times.json"), clock, 5.0)
    assert StepTimes(tmp_path / "times.json").seconds == {"rooms": 5.0}


def test_a_damaged_file_is_forgotten(tmp_path):
    (tmp_path / "times.json").write_text("{")
    assert StepTimes(tmp_path / "times.json").seconds == {}
