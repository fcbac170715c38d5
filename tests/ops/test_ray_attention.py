# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import pytest
import torch
from torch import Tensor
from torch._dynamo.testing import CompileCounterWithBackend

from raytran.errors import ShapeError
from raytran.ops import pairs as fused
from raytran.ops import reference
from raytran.ops import sparse as pair_attention
from raytran.ops.pairs import PairList
from raytran.ops.ray_attention import ray_attention, ray_attention_with_sum

DIRECTIONS = ("pixels_to_voxels", "voxels_to_pixels")
both_directions = pytest.mark.parametrize("direction", DIRECTIONS)


def _inputs(pairs: PairList, direction: str, heads: int, dim: int, generator, **kwargs) -> list[Tensor]:
    sizes = [pairs.num_pixels, pairs.num_voxels]
    sources, targets = sizes if direction == "pixels_to_voxels" else sizes[::-1]
    return [
        torch.randn(n, heads, dim, generator=generator, **kwargs).requires_grad_()
        for n in (targets, sources, sources)
    ]


@both_directions
@pytest.mark.parametrize(
    ("pixels", "voxels", "density", "heads", "dim"),
    [
        (40, 60, 0.1, 8, 32),
        (40, 60, 0.0, 2, 4),  # no pair at all
        (40, 60, 0.6, 1, 7),
        (17, 1, 0.7, 3, 5),  # one voxel
        (1, 17, 0.7, 2, 1),  # one pixel
        (1, 1, 1.1, 1, 33),
    ],
)
def test_equals_dense_attention_in_value_and_gradients(
    random_pairs, generator, direction, pixels, voxels, density, heads, dim
):
    pairs = random_pairs(pixels, voxels, density)
    inputs = _inputs(pairs, direction, heads, dim, generator)
    actual = ray_attention(*inputs, pairs, direction)
    expected = reference.ray_attention(*inputs, pairs, direction)
    torch.testing.assert_close(actual, expected, atol=1e-5, rtol=0)
    weight = torch.randn(actual.shape, generator=generator)
    for mine, theirs in zip(
        torch.autograd.grad(actual, inputs, weight),
        torch.autograd.grad(expected, inputs, weight),
        strict=True,
    ):
        torch.testing.assert_close(mine, theirs, atol=1e-5, rtol=0)


@both_directions
def test_equals_torch_attention_with_a_mask(random_pairs, generator, direction):
    pairs = random_pairs(30, 20, 1.1)
    # All inner pixels with all inner voxels: there, plain attention over a slice.
    inputs = _inputs(pairs, direction, 4, 6, generator)
    query, key, value = (tensor[1:-1].transpose(0, 1) for tensor in inputs)
    expected = torch.nn.functional.scaled_dot_product_attention(query, key, value).transpose(0, 1)
    actual = ray_attention(*inputs, pairs, direction)
    torch.testing.assert_close(actual[1:-1], expected, atol=1e-5, rtol=0)
    assert not actual[[0, -1]].any()  # targets with no pair


@both_directions
def test_gradcheck(random_pairs, generator, direction):
    pairs = random_pairs(6, 7, 0.5)
    inputs = _inputs(pairs, direction, 2, 3, generator, dtype=torch.float64)
    assert torch.autograd.gradcheck(lambda *qkv: ray_attention(*qkv, pairs, direction), inputs)


@both_directions
def test_batch_of_two_scenes_equals_the_scenes_alone(random_pairs, generator, direction):
    alone = [random_pairs(9, 14, 0.4), random_pairs(9, 14, 0.2)]
    both = PairList(
        torch.cat([alone[0].pixel_index, alone[1].pixel_index + 9]),
        torch.cat([alone[0].voxel_index, alone[1].voxel_index + 14]),
        num_pixels=18,
        num_voxels=28,
    )
    inputs = _inputs(both, direction, 2, 8, generator)
    halves = zip(*(tensor.chunk(2) for tensor in inputs), strict=True)
    expected = [ray_attention(*half, pairs, direction) for half, pairs in zip(halves, alone, strict=True)]
    torch.testing.assert_close(ray_attention(*inputs, both, direction), torch.cat(expected))


@both_directions
def test_large_scores_neither_overflow_nor_vanish(random_pairs, generator, direction):
    pairs = random_pairs(12, 10, 0.5)
    query, key, value = _inputs(pairs, direction, 2, 4, generator)
    for shift in (300.0, -300.0):
        actual = ray_attention(query * 100, key * 100 + shift, value, pairs, direction)
        expected = reference.ray_attention(
            (query * 100).double(), (key * 100 + shift).double(), value.double(), pairs, direction
        )
        torch.testing.assert_close(actual, expected.float(), atol=1e-3, rtol=0)


@both_directions
@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_half_precision_input_is_computed_in_float32(random_pairs, generator, direction, dtype):
    pairs = random_pairs(20, 30, 0.3)
    halves = [
        tensor.detach().to(dtype).requires_grad_() for tensor in _inputs(pairs, direction, 2, 8, generator)
    ]
    singles = [tensor.detach().float().requires_grad_() for tensor in halves]
    with torch.autocast("cpu", dtype=dtype):
        mine = ray_attention(*halves, pairs, direction)
        mine.float().square().sum().backward()
    exact = ray_attention(*singles, pairs, direction)
    exact.square().sum().backward()
    assert mine.dtype == dtype
    assert torch.equal(mine, exact.to(dtype))
    for half, single in zip(halves, singles, strict=True):
        assert half.grad.dtype == dtype
        torch.testing.assert_close(half.grad.float(), single.grad, atol=0.05, rtol=0.02)


@both_directions
def test_autocast_leaves_float32_input_exact(random_pairs, generator, direction):
    pairs = random_pairs(20, 30, 0.3)
    inputs = _inputs(pairs, direction, 2, 8, generator)
    weight = torch.randn(inputs[0].shape, generator=generator)
    expected = ray_attention(*inputs, pairs, direction)
    gradients = torch.autograd.grad(expected, inputs, weight)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        actual = ray_attention(*inputs, pairs, direction)
        assert torch.equal(actual, expected)
        for mine, theirs in zip(torch.autograd.grad(actual, inputs, weight), gradients, strict=True):
            assert torch.equal(mine, theirs)


def test_keeps_nothing_of_the_size_of_the_pairs_but_their_exponentials(random_pairs, generator):
    pairs = random_pairs(40, 50, 0.5)
    inputs = _inputs(pairs, "pixels_to_voxels", 4, 3, generator)
    kept: list[Tensor] = []
    with torch.autograd.graph.saved_tensors_hooks(
        lambda tensor: kept.append(tensor) or tensor, lambda tensor: tensor
    ):
        out = ray_attention(*inputs, pairs)
    known = {t.data_ptr() for order in (pairs.by("pixels"), pairs.by("voxels")) for t in order}
    known |= {tensor.data_ptr() for tensor in (*inputs, out)}
    extra = [tensor.numel() for tensor in kept if tensor.data_ptr() not in known]
    assert sorted(extra) == [4 * 50, 4 * len(pairs)]  # the sums of the softmax, and its exponentials


@both_directions
def test_sums_put_results_over_parts_of_the_sources_together(random_pairs, generator, direction):
    pairs = random_pairs(12, 10, 0.6)
    some = torch.arange(len(pairs)) % 3 == 0
    parts = [PairList(pairs.pixel_index[mine], pairs.voxel_index[mine], 12, 10) for mine in (some, ~some)]
    inputs = _inputs(pairs, direction, 2, 4, generator)
    (one, weight_of_one), (other, weight_of_other) = (
        ray_attention_with_sum(*inputs, part, direction) for part in parts
    )
    together = torch.logaddexp(weight_of_one, weight_of_other)
    expected, weight = ray_attention_with_sum(*inputs, pairs, direction)
    torch.testing.assert_close(together, weight)
    assert (weight == -torch.inf).any()
    shares = [(part - together).exp().nan_to_num()[..., None] for part in (weight_of_one, weight_of_other)]
    torch.testing.assert_close(one * shares[0] + other * shares[1], expected)
    assert not weight.requires_grad


@both_directions
def test_scores_far_apart_keep_their_precision(random_pairs, generator, direction):
    # One target's scores are hundreds below another's: no shift of all could serve both.
    pairs = random_pairs(12, 10, 0.6)
    query, key, value = (tensor.detach() for tensor in _inputs(pairs, direction, 1, 4, generator))
    query = query * torch.logspace(0, 3, len(query))[:, None, None]
    exact = reference.ray_attention(query.double(), key.double(), value.double(), pairs, direction)
    torch.testing.assert_close(
        ray_attention(query, key, value, pairs, direction), exact.float(), atol=1e-3, rtol=0
    )
    assert torch.isfinite(exact).all()


def test_operator_is_registered_as_torch_wants_it(random_pairs, generator):
    pairs = random_pairs(5, 7, 0.5)
    inputs = _inputs(pairs, "pixels_to_voxels", 2, 4, generator)
    orders = [list(pairs.by(side)) for side in ("voxels", "pixels")]
    torch.library.opcheck(pair_attention._attend, (*inputs, *orders))


@both_directions
def test_compile_and_export_pass_through(random_pairs, generator, direction):
    pairs = random_pairs(9, 14, 0.4)
    inputs = _inputs(pairs, direction, 2, 8, generator)

    class Module(torch.nn.Module):
        def forward(self, query: Tensor, key: Tensor, value: Tensor, pixel: Tensor, voxel: Tensor) -> Tensor:
            return ray_attention(query, key, value, PairList(pixel, voxel, 9, 14), direction).relu()

    index = pairs.pixel_index, pairs.voxel_index
    expected = Module()(*inputs, *index)
    gradients = torch.autograd.grad(expected.sum(), inputs)
    compiled = torch.compile(Module(), fullgraph=True, backend="aot_eager")(*inputs, *index)
    assert torch.equal(compiled, expected)
    for mine, theirs in zip(torch.autograd.grad(compiled.sum(), inputs), gradients, strict=True):
        assert torch.equal(mine, theirs)
    exported = torch.export.export(Module(), (*(tensor.detach() for tensor in inputs), *index))
    assert "raytran.pair_attention" in str(exported.graph)
    assert torch.equal(exported.module()(*inputs, *index), expected)


def test_another_number_of_pairs_needs_no_new_code(random_pairs, generator):
    counter = CompileCounterWithBackend("aot_eager")
    compiled = torch.compile(ray_attention, backend=counter, fullgraph=True)
    for density in (0.3, 0.4, 0.5, 0.6):
        pairs = random_pairs(9, 14, density)
        pairs.by("pixels"), pairs.by("voxels")
        inputs = _inputs(pairs, "pixels_to_voxels", 2, 8, generator)
        assert torch.equal(compiled(*inputs, pairs), ray_attention(*inputs, pairs))
    assert counter.frame_count <= 2  # one for the first size, one for all others


def test_blocks_on_a_cpu_run_by_torch_sparse(random_pairs, generator, monkeypatch, caplog):
    monkeypatch.delenv("TRITON_INTERPRET", raising=False)
    fused._log_once.cache_clear()
    pairs = random_pairs(9, 14, 0.4)
    inputs = _inputs(pairs, "pixels_to_voxels", 2, 8, generator)
    with caplog.at_level("DEBUG", logger="raytran"):
        for _ in range(2):
            assert torch.equal(ray_attention(*inputs, pairs.blocks()), ray_attention(*inputs, pairs))
    assert [record.message.split(": ")[1] for record in caplog.records] == ["tensors are on the CPU"]


def test_wrong_input(random_pairs, generator):
    pairs = random_pairs(5, 7, 0.5)
    query, key, value = _inputs(pairs, "pixels_to_voxels", 2, 4, generator)
    with pytest.raises(ShapeError, match=r"expected query of shape \(5"):
        ray_attention(query, key, value, pairs, "voxels_to_pixels")
    with pytest.raises(ShapeError, match="expected value"):
        ray_attention(query, key, value[:, :1], pairs)
    with pytest.raises(ValueError, match="direction"):
        ray_attention(query, key, value, pairs, "pixels_to_pixels")
