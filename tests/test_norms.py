# SPDX-License-Identifier: Apache-2.0
"""Norms in the precision of their input compute what torch's do."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from raytran.norms import GroupNorm, LayerNorm

NORMS = {
    "layer": (LayerNorm(6), nn.LayerNorm(6), (4, 5, 6)),
    "group": (GroupNorm(2, 6), nn.GroupNorm(2, 6), (4, 6, 5)),
}


@pytest.mark.parametrize("name", NORMS)
def test_equals_torchs(name):
    mine, theirs, shape = NORMS[name]
    for norm in (mine, theirs):
        nn.init.normal_(norm.weight, generator=torch.Generator().manual_seed(0))
        nn.init.normal_(norm.bias, generator=torch.Generator().manual_seed(1))
    x = torch.randn(shape, generator=torch.Generator().manual_seed(2))
    assert torch.equal(mine(x), theirs(x))
    half = x.bfloat16()
    with torch.autocast("cpu", dtype=torch.bfloat16):
        found = mine(half)
        assert mine(x).dtype == torch.float32
    assert found.dtype == torch.bfloat16
    torch.testing.assert_close(found.float(), theirs(half.float()), atol=0.03, rtol=0.02)
