# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import pytest
import torch

from raytran.errors import ShapeError
from raytran.ops.pairs import PairList
from raytran.ops.ray_attention import ray_attention
from raytran.ops.reference import pair_mask
from raytran.viewer.attention_weights import attention_weights


def test_weights_are_those_of_a_dense_softmax(random_pairs, generator):
    pairs = random_pairs(9, 13, 0.4)
    query, key = (4 * torch.randn(n, 3, 5, generator=generator) for n in (13, 9))
    score = torch.einsum("vhd,phd->hvp", query, key) * 5**-0.5
    mask = pair_mask(pairs).T
    expected = score.masked_fill(~mask, -torch.inf).softmax(dim=2).mean(dim=0)[mask]
    torch.testing.assert_close(attention_weights(query, key, pairs), expected)


def test_weights_are_those_that_attention_adds_up_with(random_pairs, generator):
    pairs = random_pairs(7, 6, 0.6)
    query, key = torch.randn(6, 1, 4, generator=generator), torch.randn(7, 1, 4, generator=generator)
    ones = torch.eye(7)[
        :, None, :4
    ].contiguous()  # the first four pixels each answer with a dimension of theirs
    read = torch.zeros(6, 7)
    read[pair_mask(pairs).T] = attention_weights(query, key, pairs)
    torch.testing.assert_close(ray_attention(query, key, ones, pairs)[:, 0], read[:, :4])


def test_half_precision_and_no_pair_at_all(generator):
    none = PairList(torch.zeros(0, dtype=torch.int64), torch.zeros(0, dtype=torch.int64), 4, 5)
    weights = attention_weights(torch.randn(5, 2, 3).half(), torch.randn(4, 2, 3).half(), none)
    assert weights.shape == (0,)
    assert weights.dtype == torch.float32


def test_wrong_sizes(random_pairs):
    pairs = random_pairs(5, 6, 0.5)
    with pytest.raises(ShapeError, match="query"):
        attention_weights(torch.zeros(5, 1, 2), torch.zeros(5, 1, 2), pairs)
    with pytest.raises(ShapeError, match="key"):
        attention_weights(torch.zeros(6, 1, 2), torch.zeros(6, 1, 2), pairs)
