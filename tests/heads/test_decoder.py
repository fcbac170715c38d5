# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import pytest
import torch

from raytran.extensions.windowed_attention import WindowedAttention
from raytran.geometry.grid import VoxelGrid
from raytran.heads.decoder import DecoderLayer, VoxelAttention, keys_and_values_together


def voxel_centers() -> torch.Tensor:
    return VoxelGrid((4, 5, 3), (4.0, 4.0, 2.0), torch.zeros(3)).voxel_centers().flatten(0, 2)


def test_attention_to_all_voxels_equals_the_formula(generator: torch.Generator) -> None:
    torch.manual_seed(0)
    attention = VoxelAttention(channels=8, num_heads=2)
    queries, memory = torch.randn(1, 3, 8, generator=generator), torch.randn(1, 5, 8, generator=generator)
    query, key, value = attention.query(queries)[0], attention.key(memory)[0], attention.value(memory)[0]
    read = [
        (query[:, part] @ key[:, part].T / 2).softmax(dim=-1) @ value[:, part]
        for part in (slice(0, 4), slice(4, 8))
    ]
    expected = attention.output(torch.cat(read, dim=-1))
    found = attention(queries, torch.zeros(1, 3, 3), memory, torch.zeros(5, 3))
    torch.testing.assert_close(found[0], expected, atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("attention", [VoxelAttention, WindowedAttention])
def test_every_parameter_gets_a_gradient(attention: type) -> None:
    torch.manual_seed(0)
    layer = DecoderLayer(channels=8, num_heads=2, hidden=16, voxel_attention=attention)
    place = voxel_centers()
    out = layer(
        torch.randn(1, 3, 8), torch.randn(1, 3, 8), torch.zeros(1, 3, 3), torch.randn(1, 60, 8), place
    )
    out.square().sum().backward()
    assert [name for name, p in layer.named_parameters() if p.grad is None or not p.grad.any()] == []


def test_keys_and_values_made_together_equal_those_of_each_attention() -> None:
    torch.manual_seed(0)
    attentions = torch.nn.ModuleList(VoxelAttention(channels=8, num_heads=2) for _ in range(3))
    queries, places = torch.randn(2, 4, 8), (torch.zeros(2, 4, 3), torch.zeros(5, 3))
    found = []
    for together in (True, False):
        attentions.zero_grad()
        memory = torch.randn(2, 5, 8, generator=torch.Generator().manual_seed(1)).requires_grad_()
        memories = keys_and_values_together(list(attentions), memory) if together else [memory] * 3
        read = [
            attention(queries, places[0], of_layer, places[1])
            for attention, of_layer in zip(attentions, memories, strict=True)
        ]
        torch.stack(read).square().sum().backward()
        found.append([*read, memory.grad, *(p.grad.clone() for p in attentions.parameters())])
    for mine, expected in zip(*found, strict=True):
        torch.testing.assert_close(mine, expected, atol=1e-5, rtol=1e-4)
