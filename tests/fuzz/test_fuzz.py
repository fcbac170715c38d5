# SPDX-License-Identifier: Apache-2.0
"""The short form of ``make fuzz``: other inputs of it than the night's, the same at every run."""

from __future__ import annotations

import sys

import pytest

from .inputs import all_inputs
from .run import Result, fuzz

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="memory is read from /proc")


def assert_nothing_found(result: Result) -> None:
    lines = [f"{verdict.name} {verdict.number}: {verdict.finding}" for verdict in result.findings]
    assert not lines, "\n".join(lines)


def test_what_is_not_damaged_is_read(tmp_path):
    kinds = all_inputs(tmp_path / "plain")
    assert len({kind.name for kind in kinds}) == len(kinds)
    for kind in kinds:
        kind.write(tmp_path / kind.name)
        kind.read(tmp_path / kind.name)


@pytest.mark.slow
def test_hundreds_of_damaged_inputs_end_in_sense_or_in_a_sentence():
    result = fuzz(300, seed=2, seconds=20)
    assert_nothing_found(result)
    assert 0.1 < result.accepted / result.inputs < 0.9


@pytest.mark.nightly
def test_ten_thousand_damaged_inputs_end_in_sense_or_in_a_sentence():
    assert_nothing_found(fuzz(10_000, seed=3))
