# SPDX-License-Identifier: Apache-2.0
"""The fused splatting, on a GPU if there is one, else in Triton's interpreter (``tests/conftest.py``)."""

from __future__ import annotations

import pytest
import torch

from raytran.ops import reference
from raytran.ops.splat import splat_features
from raytran.ops.triton import block_pairs

pytest.importorskip("triton", reason="Triton is not installed: the fused kernels have nothing to run on")

DEVICE = "cuda" if torch.cuda.is_available() else "cpu"


@pytest.fixture(autouse=True)
def few_slots(monkeypatch):
    """The interpreter takes its time over every program, also of a slot that is not used."""
    monkeypatch.setattr(block_pairs, "_SLOTS", 16)
    monkeypatch.setattr(block_pairs, "_PIECES", [16, 1 << 30])


@pytest.mark.parametrize(
    ("pixel_shape", "voxel_shape", "channels", "dtype", "tolerance"),
    [
        ((2, 5, 9), (2, 3, 2, 5), 32, torch.float32, 1e-6),
        ((2, 5, 9), (2, 3, 2, 5), 96, torch.bfloat16, 1e-2),  # channels in groups
        ((12, 3, 5), (1, 2, 4, 3), 5, torch.float32, 1e-6),  # a row in pieces
        ((1, 1, 1), (1, 1, 1, 1), 16, torch.float32, 1e-6),
    ],
)
def test_equals_a_matrix_product(
    shaped_pairs, generator, pixel_shape, voxel_shape, channels, dtype, tolerance
):
    pairs = shaped_pairs(pixel_shape, voxel_shape, 0.2 if pixel_shape != (1, 1, 1) else 1.1)
    features = torch.randn(pairs.num_pixels, channels, generator=generator).to(DEVICE, dtype).requires_grad_()
    weight = torch.randn(pairs.num_voxels, channels, generator=generator).to(DEVICE, dtype)
    mean, seen = splat_features(features, pairs.blocks().to(DEVICE))
    (gradient,) = torch.autograd.grad(mean, features, weight)
    exact = features.detach().double().requires_grad_()
    expected, expected_seen = reference.splat_features(exact, pairs.to(DEVICE))
    (expected_gradient,) = torch.autograd.grad(expected, exact, weight.double())
    assert mean.dtype == gradient.dtype == dtype
    assert torch.equal(seen, expected_seen)
    assert (mean.double() - expected).norm() <= tolerance * expected.norm()
    assert (gradient.double() - expected_gradient).norm() <= tolerance * expected_gradient.norm()


def test_operator_is_registered_as_torch_wants_it(shaped_pairs, generator):
    from raytran.ops.triton import sum as block_sum
    from raytran.ops.triton.attention import layout_of

    blocks = shaped_pairs((1, 3, 5), (1, 2, 2, 2), 0.5).blocks().to(DEVICE)
    features = torch.randn(15, 16, generator=generator).to(DEVICE).requires_grad_()
    sides = [(blocks.voxels, blocks.by("voxels")), (blocks.pixels, blocks.by("pixels"))]
    numbers = [order.numbers for _, order in sides]
    layouts = [layout_of(*side) for side in sides]
    torch.library.opcheck(block_sum._sum, (features, blocks.masks, *numbers, *layouts, 8))
