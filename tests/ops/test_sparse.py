# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import pytest
import torch

from raytran.ops.reference import pair_mask
from raytran.ops.sparse import row_of_pair, sampled_product, segment_max, segment_sum, sparse_product


@pytest.mark.parametrize("side", ["pixels", "voxels"])
def test_against_dense_matrices(random_pairs, generator, side):
    pairs = random_pairs(9, 13, 0.3)
    order = pairs.by(side)
    mask = pair_mask(pairs) if side == "pixels" else pair_mask(pairs).T
    rows = torch.randn(mask.shape[0], 5, generator=generator)
    cols = torch.randn(mask.shape[1], 5, generator=generator)
    values = torch.randn(len(pairs), generator=generator)
    matrix = torch.zeros(mask.shape)
    matrix[mask] = values  # a bool index runs row by row, as an order does

    assert torch.equal(row_of_pair(order).long(), mask.nonzero()[:, 0])
    torch.testing.assert_close(sampled_product(rows, cols, order), (rows @ cols.T)[mask])
    torch.testing.assert_close(sparse_product(values, cols, order), matrix @ cols)
    torch.testing.assert_close(segment_sum(values, order), matrix.sum(dim=1))
    torch.testing.assert_close(segment_max(values, order), matrix.masked_fill(~mask, -torch.inf).amax(dim=1))


@pytest.mark.parametrize("channels", [1, 5, 12, 32, 100])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("density", [0.0, 0.3])
def test_weighted_sums_of_any_width(random_pairs, generator, channels, dtype, density):
    """Whatever loop torch has for the width and the type, it leaves nothing out and repeats itself."""
    pairs = random_pairs(40, 30, density)
    values = torch.randn(len(pairs), generator=generator, dtype=dtype)
    cols = torch.randn(30, channels, generator=generator, dtype=dtype)
    matrix = torch.zeros(40, 30, dtype=dtype)
    matrix[pair_mask(pairs)] = values
    found = sparse_product(values, cols, pairs.by("pixels"))
    torch.testing.assert_close(found, matrix @ cols)
    assert torch.equal(found, sparse_product(values, cols, pairs.by("pixels")))
