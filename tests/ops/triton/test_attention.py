# SPDX-License-Identifier: Apache-2.0
"""The fused kernels, on a GPU if there is one, else in Triton's interpreter (``tests/conftest.py``)."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor
from torch._dynamo.testing import CompileCounterWithBackend

from raytran.ops import reference
from raytran.ops.pairs import PairList
from raytran.ops.ray_attention import ray_attention, ray_attention_with_sum
from raytran.ops.triton import block_pairs

pytest.importorskip("triton", reason="Triton is not installed: the fused kernels have nothing to run on")

DEVICE = "cuda" if torch.cuda.is_available() else "cpu"
DIRECTIONS = ("pixels_to_voxels", "voxels_to_pixels")
both_directions = pytest.mark.parametrize("direction", DIRECTIONS)


@pytest.fixture(autouse=True)
def few_slots(monkeypatch):
    """The interpreter takes its time over every program, also of a slot that is not used."""
    monkeypatch.setattr(block_pairs, "_SLOTS", 16)


def _inputs(
    pairs: PairList, direction: str, heads: int, dim: int, generator, dtype=torch.float32
) -> list[Tensor]:
    sizes = [pairs.num_pixels, pairs.num_voxels]
    sources, targets = sizes if direction == "pixels_to_voxels" else sizes[::-1]
    return [
        torch.randn(n, heads, dim, generator=generator).to(DEVICE, dtype).requires_grad_()
        for n in (targets, sources, sources)
    ]


def _value_and_gradients(attention, inputs, pairs, direction, weight) -> list[Tensor]:
    out = attention(*inputs, pairs, direction)
    return [out, *torch.autograd.grad(out, inputs, weight.to(out.dtype))]


def _check(pairs: PairList, direction: str, heads: int, dim: int, generator, dtype, tolerance: float) -> None:
    """Compare with the dense twin in float64: the norm of the error over the norm of what is right."""
    inputs = _inputs(pairs, direction, heads, dim, generator, dtype)
    weight = torch.randn(inputs[0].shape, generator=generator).to(DEVICE, dtype)
    blocks = pairs.blocks().to(DEVICE)
    exact = [tensor.detach().double().requires_grad_() for tensor in inputs]
    expected = _value_and_gradients(reference.ray_attention, exact, pairs.to(DEVICE), direction, weight)
    actual = _value_and_gradients(ray_attention, inputs, blocks, direction, weight)
    pixels = torch.ones(pairs.num_pixels, dtype=torch.bool).index_fill(0, pairs.pixel_index, False)
    voxels = torch.ones(pairs.num_voxels, dtype=torch.bool).index_fill(0, pairs.voxel_index, False)
    targets, sources = (voxels, pixels)[:: 1 if direction == "pixels_to_voxels" else -1]
    for mine, theirs, alone in zip(actual, expected, [targets, targets, sources, sources], strict=True):
        assert mine.dtype == dtype
        size = theirs.norm()
        # With one source the softmax has no gradient, and what is left is rounding of the gradient given.
        size = size if size > 1e-9 else weight.double().norm()
        assert (mine.double() - theirs).norm() <= tolerance * size
        assert not mine[alone.to(DEVICE)].any()


TOLERANCE = {torch.float32: 1e-6, torch.bfloat16: 1e-2, torch.float16: 2e-3}


@both_directions
@pytest.mark.parametrize("dtype", list(TOLERANCE))
def test_equals_dense_attention(shaped_pairs, generator, direction, dtype):
    # Neither 5×9 pixels nor 3×2×5 voxels divide into their tiles; two scenes.
    pairs = shaped_pairs((2, 5, 9), (2, 3, 2, 5), 0.1)
    _check(pairs, direction, 2, 32, generator, dtype, TOLERANCE[dtype])


@both_directions
@pytest.mark.parametrize(
    ("pixel_shape", "voxel_shape", "density", "dim"),
    [
        ((1, 3, 5), (1, 1, 1, 1), 0.7, 16),  # one view, one voxel
        ((1, 1, 1), (1, 5, 4, 4), 0.7, 16),  # one pixel
        ((1, 3, 5), (1, 4, 4, 4), 0.0, 16),  # no pair at all
        ((1, 4, 8), (1, 4, 4, 4), 0.5, 48),  # not a power of two
        ((1, 4, 8), (1, 4, 4, 4), 0.5, 5),  # not a multiple of 16
    ],
)
def test_small_and_odd_sizes(shaped_pairs, generator, direction, pixel_shape, voxel_shape, density, dim):
    _check(shaped_pairs(pixel_shape, voxel_shape, density), direction, 1, dim, generator, torch.float32, 1e-6)


@both_directions
def test_many_views_of_one_block_go_in_pieces(shaped_pairs, generator, monkeypatch, direction):
    monkeypatch.setattr(block_pairs, "_PIECES", [16, 1 << 30])
    pairs = shaped_pairs((12, 3, 5), (1, 2, 4, 3), 0.3)
    assert (pairs.blocks().by("voxels").merges[:, 0] >= 0).any()
    _check(pairs, direction, 1, 16, generator, torch.float32, 1e-6)


@both_directions
def test_pairs_of_unknown_layout(random_pairs, generator, direction):
    _check(random_pairs(40, 70, 0.3), direction, 1, 16, generator, torch.float32, 1e-6)


@both_directions
def test_same_bits_twice(shaped_pairs, generator, monkeypatch, direction):
    monkeypatch.setattr(block_pairs, "_PIECES", [16, 1 << 30])
    pairs = shaped_pairs((12, 2, 3), (1, 2, 4, 4), 0.3)
    inputs = _inputs(pairs, direction, 1, 16, generator)
    weight = torch.randn(inputs[0].shape, generator=generator).to(DEVICE)
    blocks = pairs.blocks().to(DEVICE)
    runs = [_value_and_gradients(ray_attention, inputs, blocks, direction, weight) for _ in range(2)]
    for first, second in zip(*runs, strict=True):
        assert torch.equal(first, second)


def test_large_scores_neither_overflow_nor_vanish(shaped_pairs, generator):
    pairs = shaped_pairs((2, 4, 8), (1, 4, 4, 4), 0.5)
    query, key, value = (tensor.detach() for tensor in _inputs(pairs, "pixels_to_voxels", 1, 16, generator))
    for shift in (300.0, -300.0):
        actual = ray_attention(query * 100, key * 100 + shift, value, pairs.blocks().to(DEVICE))
        exact = [(query * 100).double(), (key * 100 + shift).double(), value.double()]
        expected = reference.ray_attention(*exact, pairs.to(DEVICE))
        torch.testing.assert_close(actual.double(), expected, atol=1e-3, rtol=0)


def test_inputs_that_are_not_contiguous(shaped_pairs, generator):
    pairs = shaped_pairs((1, 4, 8), (1, 4, 4, 4), 0.5)
    inputs = [t.detach() for t in _inputs(pairs, "pixels_to_voxels", 2, 16, generator)]
    strided = [t.transpose(0, 1).contiguous().transpose(0, 1).requires_grad_() for t in inputs]
    weight = torch.randn(2, 64, 16, generator=generator).to(DEVICE).transpose(0, 1)
    blocks = pairs.blocks().to(DEVICE)
    whole = [t.requires_grad_() for t in inputs]
    for mine, theirs in zip(
        _value_and_gradients(ray_attention, strided, blocks, "pixels_to_voxels", weight),
        _value_and_gradients(ray_attention, whole, blocks, "pixels_to_voxels", weight.contiguous()),
        strict=True,
    ):
        assert torch.equal(mine, theirs)


def test_operator_is_registered_as_torch_wants_it(shaped_pairs, generator):
    from raytran.ops.triton import attention as block_attention

    pairs = shaped_pairs((1, 3, 5), (1, 2, 2, 2), 0.5)
    inputs = _inputs(pairs, "pixels_to_voxels", 1, 16, generator)
    blocks = pairs.blocks().to(DEVICE)
    sides = [(blocks.voxels, blocks.by("voxels")), (blocks.pixels, blocks.by("pixels"))]
    numbers = [order.numbers for _, order in sides]
    layouts = [block_attention.layout_of(*side) for side in sides]
    torch.library.opcheck(block_attention._attend, (*inputs, blocks.masks, *numbers, *layouts))


@both_directions
def test_compile_and_export_pass_through(shaped_pairs, generator, direction):
    pairs = shaped_pairs((1, 3, 5), (1, 2, 2, 2), 0.5)
    blocks = pairs.blocks().to(DEVICE)
    blocks.by("pixels"), blocks.by("voxels")
    inputs = _inputs(pairs, direction, 1, 16, generator)

    def attention(query: Tensor, key: Tensor, value: Tensor) -> Tensor:
        return ray_attention(query, key, value, blocks, direction).relu()

    expected = attention(*inputs)
    gradients = torch.autograd.grad(expected.sum(), inputs)
    compiled = torch.compile(attention, fullgraph=True, backend="aot_eager")(*inputs)
    assert torch.equal(compiled, expected)
    for mine, theirs in zip(torch.autograd.grad(compiled.sum(), inputs), gradients, strict=True):
        assert torch.equal(mine, theirs)

    class Module(torch.nn.Module):
        def forward(self, *qkv: Tensor) -> Tensor:
            return attention(*qkv)

    exported = torch.export.export(Module(), tuple(tensor.detach() for tensor in inputs))
    assert "raytran.block_attention" in str(exported.graph)
    assert torch.equal(exported.module()(*inputs), expected)


@pytest.mark.parametrize("listed", [True, False], ids=["pair list", "blocks"])
def test_another_number_of_views_needs_no_new_code(shaped_pairs, generator, listed):
    counter = CompileCounterWithBackend("aot_eager")
    compiled = torch.compile(ray_attention, backend=counter, fullgraph=True)
    for views in (2, 3, 5):
        pairs = shaped_pairs((views, 2, 4), (1, 4, 4, 4), 0.3).to(DEVICE)
        blocks = pairs.blocks()
        for made in (pairs, blocks):
            made.by("pixels"), made.by("voxels")
        pairs = pairs if listed else blocks
        inputs = _inputs(pairs, "pixels_to_voxels", 1, 16, generator)
        assert torch.equal(compiled(*inputs, pairs), ray_attention(*inputs, pairs))
    assert counter.frame_count <= 2  # one for the first number, one for all others


@both_directions
def test_sums_equal_those_over_the_pair_list(shaped_pairs, generator, monkeypatch, direction):
    monkeypatch.setattr(block_pairs, "_PIECES", [16, 1 << 30])
    pairs = shaped_pairs((12, 2, 3), (1, 2, 4, 2), 0.3)
    inputs = _inputs(pairs, direction, 1, 16, generator)
    _, actual = ray_attention_with_sum(*inputs, pairs.blocks().to(DEVICE), direction)
    _, expected = ray_attention_with_sum(*(tensor.cpu() for tensor in inputs), pairs, direction)
    torch.testing.assert_close(actual.cpu(), expected)
    assert not actual.requires_grad


def test_autocast_changes_nothing(shaped_pairs, generator):
    pairs = shaped_pairs((1, 3, 5), (1, 2, 2, 2), 0.5)
    inputs = _inputs(pairs, "pixels_to_voxels", 1, 16, generator)
    blocks = pairs.blocks().to(DEVICE)
    expected = ray_attention(*inputs, blocks)
    with torch.autocast(DEVICE, dtype=torch.bfloat16):
        assert torch.equal(ray_attention(*inputs, blocks), expected)


def test_tuples_of_the_kernels_hold_tensors_alone(random_pairs, generator):
    """A number in one that is 1 is a constant, which Triton before 3.8 loses on its way to a function."""
    from raytran.ops.triton.attention import Launch, layout_of

    blocks = random_pairs(9, 14, 0.4).blocks()
    query, key, _ = _inputs(random_pairs(9, 14, 0.4), "pixels_to_voxels", 1, 16, generator)
    by_voxel, by_pixel = blocks.by("voxels"), blocks.by("pixels")
    layouts = layout_of(blocks.voxels, by_voxel), layout_of(blocks.pixels, by_pixel)
    launch = Launch(query, key, by_voxel.numbers, *layouts)
    tensors, *sizes = launch.arguments(blocks.masks)
    assert all(isinstance(tensor, Tensor) for tensor in tensors)
    assert sizes[1:4] == [14, 9, 1]


@pytest.mark.parametrize(
    ("dtype", "channels"), [(torch.float32, 128), (torch.bfloat16, 256), (torch.float64, 8)]
)
def test_heads_that_do_not_fit_a_gpu_are_left_to_torch_sparse(random_pairs, generator, dtype, channels):
    from raytran.ops.pairs import PairList, pairs_for

    pairs = random_pairs(9, 14, 0.4)
    assert isinstance(pairs_for(pairs.blocks(), torch.device(DEVICE), dtype, channels), PairList)
    inputs = _inputs(pairs, "pixels_to_voxels", 1, channels, generator, dtype)
    assert torch.equal(
        ray_attention(*inputs, pairs.blocks().to(DEVICE)), ray_attention(*inputs, pairs.to(DEVICE))
    )


def test_pairs_that_ask_for_torch_sparse_get_it(random_pairs):
    from raytran.ops.pairs import PairList, pairs_for

    pairs = random_pairs(9, 14, 0.4)
    for device in ("cpu", "cuda"):
        without = replace(pairs, fused=False)
        assert isinstance(pairs_for(without, torch.device(device), torch.float32, 8), PairList)
    assert not isinstance(pairs_for(pairs, torch.device("cuda"), torch.float32, 8), PairList)
