# SPDX-License-Identifier: Apache-2.0
"""Time of the exact box IoU against sorting a million float64: ``python benchmarks/box_iou.py``.

One thread. *Room*: true boxes upright in 8 × 6 × 1.5 m with sizes 0.3 to 2 m; each prediction is one of them
moved by 15 cm, 15 % and 12 degrees of noise. *Dense*: all boxes within 30 cm of each other, turned at random.
"""

from __future__ import annotations

import argparse
import math
import time
from functools import partial

import torch
from timing import median_seconds, print_machine
from torch import Tensor

from raytran.geometry.boxes import OrientedBoxes, box_iou
from raytran.geometry.rotation import rotation_from_yaw

LIMITS = {"room 64×30": 0.05, "dense 64×30": 0.25, "room 256×100": 0.30}
"""Largest time of each scene, the sort being 1."""


def main() -> None:
    """Measure and print the time of each scene, in milliseconds and as a share of the sort."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=21)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    print_machine()
    torch.manual_seed(0)
    scenes = {
        "room 64×30": room(64, 30),
        "dense 64×30": (dense(64), dense(30)),
        "room 256×100": room(256, 100),
        "1×1": (dense(1), dense(1)),
    }
    numbers = torch.rand(1_000_000, dtype=torch.float64)
    candidates = {name: partial(box_iou, *boxes) for name, boxes in scenes.items()}
    with torch.no_grad():
        # The process's own time, so that what else the machine does matters less.
        seconds = median_seconds(
            candidates | {"sort": numbers.sort}, arguments.rounds, clock=time.process_time
        )
    print(f"{'sorting 1e6 float64':20s} {seconds['sort'] * 1e3:7.2f} ms")
    for name, (a, b) in scenes.items():
        pairs = len(a.center) * len(b.center)
        limit = f" (limit {LIMITS[name]:.2f})" if name in LIMITS else ""
        print(f"{name:20s} {seconds[name] * 1e3:7.2f} ms, {pairs / seconds[name]:9,.0f} pairs/s", end=", ")
        print(f"{seconds[name] / seconds['sort']:.3f} of the sort{limit}")


def room(count_predicted: int, count_true: int) -> tuple[OrientedBoxes, OrientedBoxes]:
    """Return predicted and true boxes of a furnished room."""
    center = torch.rand(count_true, 3, dtype=torch.float64) * torch.tensor([8.0, 6.0, 1.5])
    size = (math.log(0.3) + torch.rand(count_true, 3, dtype=torch.float64) * math.log(2 / 0.3)).exp()
    rotation = rotation_from_yaw(2 * math.pi * torch.rand(count_true, dtype=torch.float64))
    source = torch.randint(count_true, (count_predicted,))
    noise = torch.randn(3, count_predicted, 3, dtype=torch.float64)
    predicted = OrientedBoxes(
        center[source] + 0.15 * noise[0],
        size[source] * (0.15 * noise[1]).exp(),
        turned(math.radians(12) * noise[2]) @ rotation[source],
    )
    return predicted, OrientedBoxes(center, size, rotation)


def dense(count: int) -> OrientedBoxes:
    """Return boxes that all overlap."""
    center = 0.6 * torch.rand(count, 3, dtype=torch.float64) - 0.3
    size = 0.5 + 1.5 * torch.rand(count, 3, dtype=torch.float64)
    return OrientedBoxes(center, size, turned(math.pi * torch.randn(count, 3, dtype=torch.float64)))


def turned(vector: Tensor) -> Tensor:
    """Return the rotations about ``vector`` by its length, ``(n, 3)`` radians → ``(n, 3, 3)``."""
    return torch.linalg.matrix_exp(torch.linalg.cross(vector[:, None], torch.eye(3).double()[None]).mT)


if __name__ == "__main__":
    main()
