# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import torch

from raytran.extensions.windowed_attention import WindowedAttention
from raytran.geometry.grid import VoxelGrid


def voxel_centers() -> torch.Tensor:
    return VoxelGrid((4, 5, 3), (4.0, 4.0, 2.0), torch.zeros(3)).voxel_centers().flatten(0, 2)


def test_windowed_attention_equals_its_formula(generator: torch.Generator) -> None:
    """The scores q·k/√D - |x - c|²/2σ² written out with an explicit matrix."""
    torch.manual_seed(0)
    attention = WindowedAttention(channels=8, num_heads=2)
    torch.nn.init.normal_(attention.window.weight, std=0.2)
    place = voxel_centers()
    queries, memory = (
        torch.randn(2, 3, 8, generator=generator),
        torch.randn(2, len(place), 8, generator=generator),
    )
    reference = torch.randn(2, 3, 3, generator=generator)
    expected = torch.zeros(2, 3, 8)
    for scene in range(2):
        for q in range(3):
            query = attention.query(queries[scene, q]).view(2, 4)
            window = attention.window(queries[scene, q]).view(2, 4)
            read = []
            for head in range(2):
                key = attention.key(memory[scene]).view(-1, 2, 4)[:, head]
                value = attention.value(memory[scene]).view(-1, 2, 4)[:, head]
                center, width = reference[scene, q] + window[head, :3], window[head, 3].exp()
                distance = (place - center).square().sum(-1)
                weight = (key @ query[head] / 2 - distance / (2 * width**2)).softmax(0)
                read += [weight @ value, 10 * (weight @ place - reference[scene, q])]  # decimetres
            expected[scene, q] = attention.output(torch.cat(read))
    torch.testing.assert_close(attention(queries, reference, memory, place), expected, atol=1e-5, rtol=1e-4)


def test_windows_of_the_heads_begin_between_30_cm_and_1_m() -> None:
    width = WindowedAttention(channels=8, num_heads=4).window.bias.view(4, 4)[:, 3].exp()
    torch.testing.assert_close(width[[0, -1]], torch.tensor([0.3, 1.0]))
    assert bool((width.diff() > 0).all())
