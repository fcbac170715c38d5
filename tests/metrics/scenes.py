# SPDX-License-Identifier: Apache-2.0
"""Objects placed by hand or at random, for tests of metrics."""

from __future__ import annotations

import numpy as np
import torch

from raytran.classes import PAPER_CLASSES
from raytran.geometry.rotation import rotation_from_yaw
from raytran.structs import ObjectSet

CHAIR = PAPER_CLASSES.index("chair")


def objects(label, center, *, size=1.0, yaw=0.0, score=1.0) -> ObjectSet:
    count = len(label)

    def column(value, *shape):
        return torch.as_tensor(value, dtype=torch.float64).expand(count, *shape).clone()

    return ObjectSet(
        label=torch.as_tensor(label, dtype=torch.int64),
        center=torch.as_tensor(center, dtype=torch.float64),
        size=column(size, 3),
        rotation=rotation_from_yaw(column(yaw)),
        symmetry=torch.ones(count, dtype=torch.int64),
        score=column(score),
    )


def random_scene(rng: np.random.Generator) -> tuple[ObjectSet, ObjectSet]:
    """Objects and noisy, partly mislabelled copies of them, some twice."""
    count = int(rng.integers(1, 12))
    label, center = rng.integers(2, 7, count), rng.uniform(0, 1.5, (count, 3))
    size, yaw = rng.uniform(0.4, 1.5, (count, 3)), rng.uniform(0, 6, count)
    source = rng.integers(0, count, int(rng.integers(0, 20)))
    predictions = objects(
        np.where(rng.random(len(source)) < 0.8, label[source], CHAIR),
        center[source] + rng.normal(size=(len(source), 3)) * 0.1,
        size=size[source] * rng.uniform(0.75, 1.25, (len(source), 3)),
        yaw=yaw[source] + rng.normal(size=len(source)) * 0.3,
        score=rng.choice([0.1, 0.4, 0.7], len(source)),
    )
    return predictions, objects(label, center, size=size, yaw=yaw)
