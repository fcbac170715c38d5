# SPDX-License-Identifier: Apache-2.0
"""How the frames of a scene are chosen: at random to train, evenly spread to predict."""

from __future__ import annotations

import torch
from torch import Tensor


def choose_random(n: int, count: int, generator: torch.Generator) -> Tensor:
    """Draw ``count`` of ``n`` frames, in the order of the video.

    No frame comes twice unless there are fewer than ``count``; then all come equally often, or once more.

    Args:
        n: frames to choose from, at least 1.
        count: frames wanted.
        generator: source of the randomness.

    Returns:
        ``(count,)`` int64, ascending.
    """
    order = torch.randperm(n, generator=generator)
    return order.repeat(-(-count // n))[:count].sort().values


def choose_even(n: int, count: int) -> Tensor:
    """Return the middles of ``count`` equal parts of a video of ``n`` frames.

    With fewer than ``count`` frames all of them come, repeated evenly.

    Args:
        n: frames to choose from, at least 1.
        count: frames wanted.

    Returns:
        ``(count,)`` int64, ascending.
    """
    return (2 * torch.arange(count) + 1) * n // (2 * count)
