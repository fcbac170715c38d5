# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import pytest
import torch

from raytran.errors import ConfigError
from raytran.run.entry import compose
from raytran.run.train.memory import explained_out_of_memory


def config(*overrides):
    return compose("train", ["preset=small", "output_dir=unused", *overrides])


@pytest.mark.parametrize(
    ("error", "place"),
    [
        (torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB."), "the memory of the GPU"),
        (
            RuntimeError("[enforce fail] DefaultCPUAllocator: can't allocate memory"),
            "the memory of the machine",
        ),
        (MemoryError(), "the memory of the machine"),
    ],
)
def test_the_settings_to_change_are_named(error, place):
    with pytest.raises(ConfigError) as caught, explained_out_of_memory(config()):
        raise error
    message = str(caught.value)
    assert message.startswith(
        f"{place} does not suffice for a step: change views.batch_size (now 2: fewer), or "
    )
    assert "views.num_views (now 12: fewer)" in message
    assert "views.image_size (now [240, 320]: smaller)" in message
    assert "…" not in message, "it is not too long"


def test_what_has_nothing_to_give_is_not_named():
    cfg = config("views.batch_size=1", "trainer=gpu", "trainer.precision=16-mixed")
    with pytest.raises(ConfigError) as caught, explained_out_of_memory(cfg):
        raise MemoryError
    assert "batch_size" not in str(caught.value)
    assert "precision" not in str(caught.value)


def test_a_real_refusal_of_the_machine_is_recognised():
    with pytest.raises(ConfigError, match="the memory of the machine"), explained_out_of_memory(config()):
        torch.empty(2**60)


def test_other_errors_stay_as_they_are():
    with pytest.raises(RuntimeError, match="shapes differ"), explained_out_of_memory(config()):
        raise RuntimeError("shapes differ")
