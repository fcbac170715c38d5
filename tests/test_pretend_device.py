# SPDX-License-Identifier: Apache-2.0
"""The pretend GPU refuses, waits and launches as CUDA does, and computes what the CPU computes."""

from __future__ import annotations

import pytest
import torch
import torch.distributed as dist
from torch import nn

from .pretend_device import DEVICE, NAME, DeviceMixError, on_pretend_device, recorded

MIXED = {
    "sum": lambda x: x + torch.ones(3),
    "choice": lambda x: torch.where(x > 0, x, torch.zeros(3)),
    "change in place": lambda x: x.mul_(torch.ones(3)),
    "mask of the CPU": lambda x: x.masked_fill(torch.ones(3, dtype=torch.bool), 0.0),
    "product": lambda x: torch.eye(3) @ x,
    "joined": lambda x: torch.cat([x, torch.ones(3)]),
    "joined with a number": lambda x: torch.stack([x[0], torch.ones(())]),
    "number of the device": lambda x: torch.ones(3) + x[0],
    "index of the device": lambda x: torch.ones(3)[x.long()],
    "values of the CPU": lambda x: x.index_put_((x.long(),), torch.ones(3)),
    "gathered": lambda x: x.gather(0, torch.zeros(3, dtype=torch.int64)),
    "attention": lambda x: nn.functional.scaled_dot_product_attention(x[None], x[None], torch.ones(1, 3)),
    "array": lambda x: x.numpy(),
}

ALLOWED = {
    "number of the CPU": lambda x: x + torch.ones(()),
    "Python's number": lambda x: 2 * x - 1,
    "choice of a number": lambda x: torch.where(x > 0, x, torch.zeros(())),
    "filled with a number": lambda x: x.fill_(torch.ones(())),
    "index of the CPU": lambda x: x[torch.tensor([0, 1])],
    "changed by one": lambda x: x.index_put_((torch.tensor([0, 1]),), torch.ones(())),
    "copied": lambda x: x.copy_(torch.ones(3)),
    "copied back": lambda x: torch.ones(3).copy_(x),
}

WAITS = {
    ".item()": [
        lambda x: x.sum().item(),
        lambda x: bool(x.any()),
        lambda x: float(x[0]),
        lambda x: range(3)[x[0].long()],
        lambda x: x[x[0].long()],
    ],
    "boolean index": [
        lambda x: x[x > 1],
        lambda x: x.index_put_((x > 1,), x[0]),
        lambda x: x.__setitem__(x > 1, 0.0),
    ],
    "index on the CPU": [lambda x: x[torch.tensor([0, 1])]],
    "nonzero": [lambda x: x.nonzero(), lambda x: torch.where(x > 1)],
    "masked_select": [lambda x: x.masked_select(x > 1)],
    "copy from pageable memory": [
        lambda x: torch.tensor([1.0, 2.0], device=DEVICE),
        lambda x: torch.tensor(1.0, device=DEVICE),
        lambda x: torch.as_tensor([1.0], device=DEVICE),
        lambda x: x.new_tensor([1.0, 2.0]),
        lambda x: x[[0, 1]],
        lambda x: torch.ones(3).to(DEVICE),
        lambda x: torch.ones(3).to(DEVICE, non_blocking=True),
        lambda x: x.copy_(torch.ones(3)),
        lambda x: nn.Linear(1, 1, bias=False).to(DEVICE),
    ],
    "copy to the host": [
        lambda x: x.cpu(),
        lambda x: x.tolist(),
        lambda x: torch.ones(3).copy_(x),
        lambda x: torch.ones(3).copy_(x, non_blocking=True),
    ],
    "repeat_interleave without output_size": [lambda x: x.repeat_interleave(x.long())],
    "unique": [lambda x: x.unique()],
    "unique_consecutive": [lambda x: x.unique_consecutive()],
    "bincount": [lambda x: x.long().bincount()],
    "torch.equal": [lambda x: torch.equal(x, x)],
    "a check for errors": [lambda x: torch.linalg.inv(x.diag())],
}

NO_WAITS = {
    "sums": lambda x: (x + 1).sum() * x,
    "views": lambda x: x[1:].view(-1, 1).expand(2, 5).T,
    "index": lambda x: x[x.long() - 1],
    "lengths known": lambda x: x.repeat_interleave(x.long(), output_size=6),
    "number made there": lambda x: torch.stack([x.new_full((), 1.0), torch.full((), 2.0, device=DEVICE)]),
    "random": lambda x: torch.rand(3, device=DEVICE) + torch.rand_like(x),
    "fill": lambda x: x.masked_fill_(x > 1, 0.0),
    "inverse": lambda x: torch.linalg.inv_ex(x.diag())[0],
    "page-locked": lambda x: torch.ones(3).pin_memory().to(DEVICE, non_blocking=True),
    "page-locked, copied": lambda x: x.copy_(torch.ones(3, pin_memory=True), non_blocking=True),
    "page-locked, to the host": lambda x: x.to("cpu", non_blocking=True),
    "page-locked, copied to the host": lambda x: torch.empty(3, pin_memory=True).copy_(x, non_blocking=True),
}


def some():
    return torch.tensor([1.0, 2.0, 3.0]).to(DEVICE)


@pytest.mark.parametrize("name", MIXED)
@on_pretend_device
def test_tensors_of_two_devices_are_refused(name):
    x = some()
    with pytest.raises(DeviceMixError, match=r"at tests/test_pretend_device\.py:"):
        MIXED[name](x)


@pytest.mark.parametrize("name", ALLOWED)
@on_pretend_device
def test_numbers_and_indices_of_the_cpu_are_not(name):
    ALLOWED[name](some())


@pytest.mark.parametrize("reason", WAITS)
@on_pretend_device
def test_every_kind_of_wait_is_seen(reason):
    for number, operation in enumerate(WAITS[reason]):
        x = some()
        with recorded() as seen:
            operation(x)
        assert seen.waits.total() == 1, f"number {number}: {seen}"
        assert str(seen.waits).startswith(f"Counter({{'{reason} at tests/test_pretend_device.py:"), (
            f"{number}: {seen}"
        )


@pytest.mark.parametrize("name", NO_WAITS)
@on_pretend_device
def test_what_needs_no_wait_has_none(name):
    x = some()
    with recorded() as seen:
        NO_WAITS[name](x)
    assert not seen.waits, seen


@on_pretend_device
def test_launches_are_counted_and_views_are_not():
    x = torch.ones(4, 4, device=DEVICE)
    with recorded() as seen:
        x[1:].T.unsqueeze(0).expand(3, 4, 3).detach()
        torch.empty_like(x)
    assert not seen.launches, seen.launches
    with recorded() as seen:
        x.T.contiguous().add_(1).view(16)
        torch.zeros(2, device=DEVICE)
    assert seen.launches == {"clone": 1, "add_": 1, "zeros": 1}
    many, across = ([torch.ones(2, 3, device=DEVICE) for _ in range(111)] for _ in range(2))
    with recorded() as seen:
        torch._foreach_mul_(many, 2.0)
        torch._foreach_copy_(many, across)
        torch._foreach_norm(many)
    assert seen.launches == {"_foreach_mul_": 2, "_foreach_copy_": 2, "_foreach_norm": 4}
    across[5] = across[5].view(3, 2).T
    with recorded() as seen:
        torch._foreach_copy_(many, across)
    assert seen.launches == {"_foreach_copy_": 111}  # one that lies otherwise, and all are copied one by one
    query = torch.rand(1, 2, 3, 4, device=DEVICE, requires_grad=True)
    with recorded() as seen:
        nn.functional.scaled_dot_product_attention(query, query, query).backward(query.detach())
    assert seen.launches["attention"] == 1
    assert seen.launches["attention_backward"] == 3


@on_pretend_device
def test_convolutions_and_norms_copy_what_lies_otherwise():
    last, weight = torch.channels_last, torch.ones(4, 4, 3, 3, device=DEVICE)
    x = torch.rand(2, 4, 5, 6, device=DEVICE)

    def launches(x, weight):
        with recorded() as seen:
            out = nn.functional.conv2d(x, weight)
        return seen.launches["convolution"], out.inner.is_contiguous(memory_format=last)

    assert launches(x, weight) == (1, False)
    assert launches(x.contiguous(memory_format=last), weight) == (2, True)
    assert launches(x, weight.contiguous(memory_format=last)) == (2, True)
    assert launches(x.contiguous(memory_format=last), weight.contiguous(memory_format=last)) == (1, True)
    with recorded() as seen:
        assert nn.functional.group_norm(x.contiguous(memory_format=last), 2).inner.is_contiguous()
    assert seen.launches["native_group_norm"] == 2


@on_pretend_device
def test_ledgers_are_apart():
    with recorded() as outer:
        with recorded() as inner:
            some().sum().item()
        assert inner.waits.total() == 2
        assert not outer.waits
        assert not outer.launches
    assert "2 waits, 2 launches" in str(inner)


def _trained(device, dtype=None):
    """Return losses and weights of a few steps of a small network."""
    torch.manual_seed(0)
    network = nn.Sequential(nn.Conv2d(2, 4, 3), nn.BatchNorm2d(4), nn.GELU(), nn.Flatten(), nn.Linear(64, 3))
    network.to(device)
    optimizer = torch.optim.AdamW(network.parameters(), lr=0.1)
    losses = []
    for _ in range(3):
        with torch.autocast(
            torch.device(device).type, dtype=dtype or torch.bfloat16, enabled=dtype is not None
        ):
            out = network(torch.rand(3, 2, 6, 6, device=device))
            assert out.dtype == (dtype or torch.float32)
            loss = out.float().square().mean()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimizer.step()
        optimizer.zero_grad()
        losses.append(loss.item())
    assert all(parameter.device.type == torch.device(device).type for parameter in network.parameters())
    return losses, [parameter.detach().cpu() for parameter in network.parameters()]


@on_pretend_device
def test_training_gives_what_it_gives_on_the_cpu():
    losses, weights = _trained(DEVICE)
    expected, expected_weights = _trained("cpu")
    assert losses == expected
    torch.testing.assert_close(weights, expected_weights)
    assert losses == pytest.approx(_trained(DEVICE, torch.bfloat16)[0], rel=0.1)


@on_pretend_device
def test_optimizers_take_many_tensors_at_once_as_on_cuda():
    with recorded() as seen:
        _trained(DEVICE)
    assert seen.launches["_foreach_norm"] == 3 * 3
    assert seen.launches["_foreach_addcdiv_"] == 3


@on_pretend_device
def test_what_is_saved_is_read_on_the_cpu(tmp_path):
    network = nn.Linear(2, 2).to(DEVICE)
    torch.save({"weights": network.state_dict(), "loss": some()}, tmp_path / "saved")
    found = torch.load(tmp_path / "saved", map_location="cpu", weights_only=True)
    assert found["loss"].tolist() == [1.0, 2.0, 3.0]
    assert type(found["weights"]["weight"]) is torch.Tensor
    other = nn.Linear(2, 2).to(DEVICE)
    other.load_state_dict(found["weights"])
    assert torch.equal(other.weight, network.weight)


@on_pretend_device
def test_ranks_exchange_what_is_on_the_device():
    dist.init_process_group("gloo", rank=0, world_size=1, store=dist.HashStore())
    try:
        x = some()
        with recorded() as seen:
            dist.all_reduce(x)
            every = [torch.zeros(3, device=DEVICE)]
            dist.all_gather(every, x)
        assert every[0].tolist() == [1.0, 2.0, 3.0]
        assert not seen.waits, seen
        with pytest.raises(DeviceMixError, match="NCCL"):
            dist.all_reduce(torch.ones(3))
        dist.all_reduce(torch.ones(3), group=dist.new_group(backend="gloo"))
    finally:
        dist.destroy_process_group()


@on_pretend_device
def _broken(value):
    assert value == 1, "this is why"


@on_pretend_device
def _ending():
    raise SystemExit(3)


def test_failures_come_back_with_their_reason():
    _broken(value=1)
    with pytest.raises(pytest.fail.Exception, match="this is why"):
        _broken(value=2)
    with pytest.raises(pytest.fail.Exception, match="SystemExit"):
        _ending()
    _broken(value=1)


def test_the_process_of_other_tests_has_no_pretend_device():
    assert torch._C._get_privateuse1_backend_name() != NAME
