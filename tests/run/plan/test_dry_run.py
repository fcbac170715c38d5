# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import pytest
import torch
from hydra.utils import instantiate
from torch import nn
from torch._subclasses.fake_tensor import FakeTensorMode

from raytran.run.entry import compose
from raytran.run.plan.dry_run import Load, Tally, dry_training, fake_copy
from raytran.run.plan.roofline import Ceilings, Work
from raytran.run.train.build import build_model


def test_memory_follows_storages() -> None:
    tally = Tally()
    with FakeTensorMode(), tally:
        a = torch.empty(1000)
        view = a[10:].view(-1, 10)
        assert tally.live == 4000
        b = a * 2
        assert tally.live == 8000
        del a
        assert tally.live == 8000  # the view still holds it
        del view, b
        assert tally.live == 0
    assert tally.peak == 8000


def test_what_autograd_keeps_counts() -> None:
    tally = Tally()
    with FakeTensorMode(), tally:
        x = torch.empty(1000, requires_grad=True)
        y = x.exp()  # keeps its result
        z = y.sin()  # keeps its argument
        del y
        assert tally.live == 12000
        z.sum().backward()
    assert tally.peak >= 16000


def total(tally: Tally) -> Work:
    return sum(tally.work, Work(0, 0))


def test_the_work_of_a_linear_layer_by_hand() -> None:
    """3 rows, 4 → 8 channels: a product forward; one for each side's gradient and none for the bias."""
    forward, both = Tally(), Tally()
    with FakeTensorMode():
        layer, x = nn.Linear(4, 8), torch.empty(3, 4, requires_grad=True)
        with forward:
            layer(x)
        with both:
            layer(x).backward(torch.ones(3, 8))
    assert total(forward) == Work(2 * 3 * 4 * 8, 4 * (3 * 4 + 4 * 8 + 8 + 3 * 8))
    products = (3 * 8 + 8 * 4 + 3 * 4) + (3 * 8 + 3 * 4 + 4 * 8)
    assert total(both) == Work(3 * total(forward).operations, total(forward).bytes + 4 * products)
    assert forward.seconds(Ceilings(1e3, 1.0)) == total(forward).bytes


def test_what_lies_between_products_is_free() -> None:
    tally = Tally()
    with FakeTensorMode(), tally:
        nn.functional.gelu(torch.empty(1000, requires_grad=True)).exp()
    assert total(tally) == Work(0, 0)


def test_work_adds_up_and_takes_the_higher_of_two_times() -> None:
    work = Work(6.0, 2.0) + Work(2.0, 2.0) * 2
    assert work == Work(10.0, 6.0)
    assert work.seconds(Ceilings(10.0, 3.0)) == 2.0
    assert work.seconds(Ceilings(2.0, 3.0)) == 5.0


def test_a_fake_copy_leaves_the_original_alone() -> None:
    model = build_model(compose("train", ["preset=tiny", "output_dir=x"]))
    before = {name: value.clone() for name, value in model.state_dict().items()}
    tracer = model.ray_tracer
    with FakeTensorMode():
        fake = fake_copy(model, 3.0).eval()
        assert [x.shape for x in fake.parameters()] == [x.shape for x in model.parameters()]
    assert model.training
    assert not fake.training
    assert model.ray_tracer is tracer
    for name, value in model.state_dict().items():
        assert type(value) is torch.Tensor
        assert torch.equal(value, before[name])


@pytest.mark.parametrize("precision", ["32-true", "bf16-mixed"])
def test_fused_attention_keeps_less_and_does_the_same_work(precision: str) -> None:
    cfg = compose("train", ["preset=tiny", "experiment=stage2", "output_dir=x"])
    model, stage = build_model(cfg, pretrained=False), instantiate(cfg.stage, _convert_="all")
    sparse, fused = (
        dry_training(model, Load(1, 4, (64, 96), 60.0, fused=on_gpu), stage, precision=precision)
        for on_gpu in (False, True)
    )
    assert fused.peak < sparse.peak
    assert total(fused).operations == pytest.approx(total(sparse).operations, rel=1e-6)
