# SPDX-License-Identifier: Apache-2.0
"""True objects, and network output that matches them exactly."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch

from raytran.geometry.rotation import rotation_from_yaw, yaw_from_rotation
from raytran.structs import PADDING, ObjectSet, RawObjects


@pytest.fixture
def make_objects() -> Callable[[int, int], ObjectSet]:
    def make(count: int, seed: int = 0) -> ObjectSet:
        g = torch.Generator().manual_seed(seed)
        return ObjectSet(
            label=torch.randint(0, PADDING, (count,), generator=g),
            center=4 * torch.rand(count, 3, generator=g) - 2,
            size=torch.rand(count, 3, generator=g) + 0.3,
            rotation=rotation_from_yaw(6 * torch.rand(count, generator=g) - 3),
            symmetry=torch.ones(count, dtype=torch.long),
            score=torch.ones(count),
            shape=torch.rand(count, 5, 5, 5, generator=g) > 0.5,
        )

    return make


@pytest.fixture
def make_perfect() -> Callable[..., RawObjects]:
    def make(objects: ObjectSet, slots: torch.Tensor, num_queries: int) -> RawObjects:
        logits = torch.full((1, num_queries, PADDING + 1), -20.0)
        logits[0, :, PADDING] = 20.0
        logits[0, slots, PADDING] = -20.0
        logits[0, slots, objects.label] = 20.0
        center, log_size = 9 * torch.ones(1, num_queries, 3), torch.zeros(1, num_queries, 3)
        center[0, slots], log_size[0, slots] = objects.center, objects.size.log()
        yaw_vector = torch.ones(1, num_queries, 2)
        yaw = yaw_from_rotation(objects.rotation)
        yaw_vector[0, slots] = 2 * torch.stack([yaw.sin(), yaw.cos()], dim=-1)
        embedding = torch.arange(num_queries, dtype=torch.float32)[None, :, None].expand(1, -1, 4)
        leaves = (logits, center, log_size, yaw_vector, embedding.clone())
        return RawObjects(*(leaf.requires_grad_() for leaf in leaves))

    return make
