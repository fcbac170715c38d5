# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import pytest
import torch

from raytran.errors import ShapeError
from raytran.ops.pairs import PairList
from raytran.ops.ray_attention import ray_attention
from raytran.ops.reference import pair_mask
from raytran.viewer.attention import attention_weights, pack_reads


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


# Voxel 0 reads pixels 2, 3 and 7, voxel 1 none, voxel 2 pixels 0 and 9, voxel 3 pixel 5.
PAIRS = PairList(torch.tensor([0, 2, 3, 5, 7, 9]), torch.tensor([2, 0, 0, 3, 0, 2]), 10, 4)
WEIGHT = torch.tensor([0.5, 0.2495, 0.2505, 0.9990, 0.0010, 1.0])


def unpacked(reads):
    """Return {voxel: [(pixel, weight), …]} with weights in 255 steps of the strongest."""
    pairs = {}
    for voxel, (start, end) in enumerate(zip(reads.offsets[:-1], reads.offsets[1:], strict=True)):
        pixels = reads.steps[start:end].cumsum().tolist()
        pairs[voxel] = list(zip(pixels, reads.weights[start:end].tolist(), strict=True))
    return pairs


def test_pairs_come_back_and_what_rounds_to_nothing_is_left_out():
    reads = pack_reads(WEIGHT, PAIRS, (1, 5))
    assert unpacked(reads) == {0: [(2, 255), (3, 127), (7, 128)], 1: [], 2: [(0, 255)], 3: [(5, 255)]}


def test_a_bound_takes_the_weakest_and_leaves_each_voxel_its_strongest():
    reads = pack_reads(WEIGHT, PAIRS, (1, 5), max_pairs=4)
    assert unpacked(reads) == {0: [(2, 255), (7, 128)], 1: [], 2: [(0, 255)], 3: [(5, 255)]}
    least = pack_reads(WEIGHT, PAIRS, (1, 5), max_pairs=1)
    assert unpacked(least) == {0: [(2, 255)], 1: [], 2: [(0, 255)], 3: [(5, 255)]}


def test_pixels_of_a_voxel_are_cells_of_views():
    reads = pack_reads(WEIGHT, PAIRS, (1, 5))
    pixels = reads.of_voxel(0)
    assert pixels.view.tolist() == [0, 0, 1]
    assert pixels.row.tolist() == [0, 0, 0]
    assert pixels.column.tolist() == [2, 3, 2]
    assert pixels.weight.tolist() == pytest.approx([0.5, 0.249, 0.251], abs=1e-3)
    assert pixels.feature_size == (1, 5)
    assert len(reads.of_voxel(1).view) == 0
    two_rows = pack_reads(WEIGHT, PAIRS, (5, 2)).of_voxel(2)
    assert (two_rows.view.tolist(), two_rows.row.tolist(), two_rows.column.tolist()) == ([0], [0], [0])
    assert pack_reads(WEIGHT, PAIRS, (5, 2)).of_voxel(3).row.tolist() == [2]


def test_nothing_read():
    none = PairList(torch.zeros(0, dtype=torch.int64), torch.zeros(0, dtype=torch.int64), 10, 4)
    reads = pack_reads(torch.zeros(0), none, (2, 5))
    assert reads.offsets.tolist() == [0] * 5
    assert len(reads.steps) == len(reads.weights) == 0
