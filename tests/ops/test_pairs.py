# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import pickle

import pytest
import torch

from raytran.errors import ShapeError
from raytran.ops.pairs import PairList


def _pairs() -> PairList:
    # Pixel 1 and voxel 2 have no pair.
    return PairList(torch.tensor([0, 0, 2, 2, 2]), torch.tensor([1, 4, 0, 1, 3]), num_pixels=4, num_voxels=5)


def test_order_by_pixels_and_by_voxels_by_hand():
    offsets, cols, permutation = _pairs().by("pixels")
    assert offsets.tolist() == [0, 2, 2, 5, 5]
    assert cols.tolist() == [1, 4, 0, 1, 3]
    assert permutation.tolist() == [1, 4, 0, 2, 3]
    offsets, cols, permutation = _pairs().by("voxels")
    assert offsets.tolist() == [0, 1, 3, 3, 4, 5]
    assert cols.tolist() == [2, 0, 2, 2, 0]
    assert permutation.tolist() == [2, 0, 3, 4, 1]


def test_orders_are_made_once_and_are_no_part_of_the_struct():
    pairs = _pairs()
    assert pairs.by("voxels") is pairs.by("voxels")
    moved = pairs.to("meta")
    assert moved.pixel_index.device.type == moved.voxel_index.device.type == "meta"
    assert (moved.num_pixels, moved.num_voxels) == (4, 5)
    assert pickle.loads(pickle.dumps(pairs)).by("voxels").col_index.tolist() == [2, 0, 2, 2, 0]


def test_empty():
    none = torch.zeros(0, dtype=torch.int64)
    pairs = PairList(none, none, num_pixels=2, num_voxels=3)
    assert len(pairs) == 0
    assert pairs.by("pixels").row_offsets.tolist() == [0, 0, 0]
    assert pairs.by("voxels").row_offsets.tolist() == [0, 0, 0, 0]


def test_wrong_input():
    with pytest.raises(ShapeError, match="as many pixels as voxels"):
        PairList(torch.zeros(2, dtype=torch.int64), torch.zeros(3, dtype=torch.int64), 4, 5)
    with pytest.raises(ValueError, match="'pixels' or 'voxels'"):
        _pairs().by("rays")
