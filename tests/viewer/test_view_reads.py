# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import torch

from raytran.ops.pairs import PairList
from raytran.viewer.view_reads import VoxelReads, pack_reads

# Voxel 0 reads pixels 2, 3 and 7, voxel 1 none, voxel 2 pixels 0 and 9, voxel 3 pixel 5.
PAIRS = PairList(torch.tensor([0, 2, 3, 5, 7, 9]), torch.tensor([2, 0, 0, 3, 0, 2]), 10, 4)
WEIGHT = torch.tensor([0.5, 0.2495, 0.2505, 0.9990, 0.0010, 1.0])
READS = VoxelReads(PAIRS, WEIGHT, (2, 5))


def unpacked(packed):
    """Return {voxel: [(pixel, weight), …]} as the page reads it."""
    found = {}
    for voxel, (start, end) in enumerate(zip(packed.offsets[:-1], packed.offsets[1:], strict=True)):
        pixels = packed.steps[start:end].cumsum(0).tolist()
        found[voxel] = list(zip(pixels, packed.weights[start:end].tolist(), strict=True))
    return found


def test_pairs_come_back_and_what_rounds_to_nothing_is_left_out():
    packed = pack_reads(READS)
    assert unpacked(packed) == {0: [(2, 255), (3, 127), (7, 128)], 1: [], 2: [(0, 255)], 3: [(5, 255)]}
    assert packed.cut == 1


def test_a_bound_takes_the_weakest_and_leaves_each_voxel_its_strongest():
    packed = pack_reads(READS, max_pairs=4)
    assert unpacked(packed) == {0: [(2, 255), (7, 128)], 1: [], 2: [(0, 255)], 3: [(5, 255)]}
    assert packed.cut == 128
    least = pack_reads(READS, max_pairs=1)
    assert unpacked(least) == {0: [(2, 255)], 1: [], 2: [(0, 255)], 3: [(5, 255)]}
    assert least.cut == 255


def test_nothing_read():
    none = PairList(torch.zeros(0, dtype=torch.int64), torch.zeros(0, dtype=torch.int64), 10, 4)
    packed = pack_reads(VoxelReads(none, torch.zeros(0), (2, 5)))
    assert packed.offsets.tolist() == [0] * 5
    assert len(packed.steps) == len(packed.weights) == 0
