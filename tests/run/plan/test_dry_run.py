# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import pytest
import torch
from torch._subclasses.fake_tensor import FakeTensorMode

import raytran.backbone.block
import raytran.ops.tracer
from raytran.run.entry import compose
from raytran.run.plan.dry_run import LiveMemory, fake_copy, peak_bytes, stand_ins
from raytran.run.train.build import build_model


def test_live_memory_follows_storages() -> None:
    memory = LiveMemory()
    with FakeTensorMode(), memory:
        a = torch.empty(1000)
        view = a[10:].view(-1, 10)
        assert memory.live == 4000
        b = a * 2
        assert memory.live == 8000
        del a
        assert memory.live == 8000  # the view still holds it
        del view, b
        assert memory.live == 0
    assert memory.peak == 8000


def test_what_autograd_keeps_counts() -> None:
    def run(memory: LiveMemory) -> None:
        x = torch.empty(1000, requires_grad=True)
        y = x.exp()  # keeps its result
        z = y.sin()  # keeps its argument
        del y
        assert memory.live == 12000
        z.sum().backward()

    assert peak_bytes(run) >= 16000


def test_a_fake_copy_leaves_the_original_alone() -> None:
    model = build_model(compose("train", ["preset=tiny", "output_dir=x"]))
    before = {name: value.clone() for name, value in model.state_dict().items()}
    with FakeTensorMode():
        fake = fake_copy(model).eval()
        assert [x.shape for x in fake.parameters()] == [x.shape for x in model.parameters()]
    assert model.training
    assert not fake.training
    for name, value in model.state_dict().items():
        assert type(value) is torch.Tensor
        assert torch.equal(value, before[name])


def test_stand_ins_are_taken_back_after_an_error() -> None:
    real = raytran.ops.tracer.trace_pairs, raytran.backbone.block.ray_attention

    def fail() -> None:
        with stand_ins(3.0, fused=True):
            assert raytran.ops.tracer.trace_pairs is not real[0]
            raise RuntimeError("stop")

    with pytest.raises(RuntimeError, match="stop"):
        fail()
    assert (raytran.ops.tracer.trace_pairs, raytran.backbone.block.ray_attention) == real
