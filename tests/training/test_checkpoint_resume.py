# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import io
import random

import numpy as np
import pytest
import torch

from raytran.errors import CheckpointError
from raytran.training.checkpoint_resume import loop_state, random_states, set_random_states

CPU = torch.device("cpu")


def draw():
    numbers = np.random.rand(), np.random.randn()  # noqa: NPY002 - the global source is meant
    return random.random(), random.gauss(0, 1), *numbers, torch.rand(3).tolist()


@pytest.mark.parametrize("gauss_first", [False, True])
def test_random_numbers_go_on_through_a_file(gauss_first):
    if gauss_first:  # of two normal numbers that are made at once, one waits in the state
        random.gauss(0, 1)
        np.random.randn()  # noqa: NPY002
    file = io.BytesIO()
    torch.save(random_states(CPU), file)
    expected = draw()
    assert draw() != expected
    file.seek(0)
    set_random_states(torch.load(file, weights_only=True), CPU)
    assert draw() == expected


@pytest.mark.parametrize("key", ["python", "numpy", "torch"])
@pytest.mark.parametrize("value", [None, [], {}, [3, [1, 2], None], torch.zeros(2, 2)])
def test_damaged_states_are_one_sentence(key, value):
    with pytest.raises(CheckpointError, match="random states in the checkpoint are damaged"):
        set_random_states({**random_states(CPU), key: value}, CPU)


def test_counters_are_of_batches_and_of_steps():
    loops = loop_state(4, accumulate=3, validation_due=False)["fit_loop"]
    assert loops["epoch_loop.batch_progress"]["total"]["processed"] == 12
    optimizer = loops["epoch_loop.automatic_optimization.optim_progress"]["optimizer"]
    assert optimizer["step"]["total"]["completed"] == 4
    assert "epoch_loop.val_loop.batch_progress" not in loops
    assert (
        "epoch_loop.val_loop.batch_progress" in loop_state(4, accumulate=3, validation_due=True)["fit_loop"]
    )
