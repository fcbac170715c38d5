# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import pytest
import torch

from raytran.errors import ShapeError
from raytran.ops import reference
from raytran.ops.pairs import PairList
from raytran.ops.splat import splat_features


def test_mean_by_hand():
    pairs = PairList(torch.tensor([0, 1, 1]), torch.tensor([2, 0, 2]), num_pixels=3, num_voxels=4)
    mean, seen = splat_features(torch.tensor([[1.0, 10.0], [3.0, 20.0], [7.0, 70.0]]), pairs)
    assert mean.tolist() == [[3.0, 20.0], [0.0, 0.0], [2.0, 15.0], [0.0, 0.0]]
    assert seen.tolist() == [True, False, True, False]


@pytest.mark.parametrize("density", [0.0, 0.2, 1.0])
def test_equals_a_matrix_product(random_pairs, generator, density):
    pairs = random_pairs(20, 31, density)
    features = torch.randn(20, 5, generator=generator, dtype=torch.float64, requires_grad=True)
    mean, seen = splat_features(features, pairs)
    expected, expected_seen = reference.splat_features(features, pairs)
    torch.testing.assert_close(mean, expected)
    assert torch.equal(seen, expected_seen)
    assert torch.autograd.gradcheck(lambda x: splat_features(x, pairs)[0], features)


def test_half_precision_under_autocast(random_pairs, generator):
    pairs = random_pairs(20, 31, 0.3)
    features = torch.randn(20, 5, generator=generator).bfloat16().requires_grad_()
    with torch.autocast("cpu", dtype=torch.bfloat16):
        mean, _ = splat_features(features, pairs)
    assert mean.dtype == torch.bfloat16
    assert torch.equal(mean, reference.splat_features(features.float(), pairs)[0].bfloat16())
    mean.float().sum().backward()
    assert features.grad.dtype == torch.bfloat16


def test_wrong_input(random_pairs):
    with pytest.raises(ShapeError, match="expected features"):
        splat_features(torch.zeros(3, 5), random_pairs(4, 5, 0.5))
