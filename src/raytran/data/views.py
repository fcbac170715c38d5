# SPDX-License-Identifier: Apache-2.0
"""How the frames of a scene are chosen: at random to train, evenly spread to predict."""

from __future__ import annotations

import logging
from collections.abc import Sequence

import torch
from torch import Tensor

from raytran.structs import SceneBatch

_log = logging.getLogger(__name__)


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


def hold_out(
    used: Sequence[int], count: int, generator: torch.Generator | None
) -> tuple[list[int], list[int]]:
    """Divide frames into those to see and those to render; none is both.

    Args:
        used: N + count frames of a scene, some of which may come more than once.
        count: how many to hold out, fewer than there are different frames.
        generator: source of the randomness; None holds out frames spread evenly.

    Returns:
        the places in ``used`` of the N frames to see, and of those held out. If one of the latter comes more
        than once, some of the former do.
    """
    frames = sorted(set(used))
    chosen = (
        choose_even(len(frames), count) if generator is None else choose_random(len(frames), count, generator)
    )
    rendered = [frames[i] for i in chosen.tolist()]
    seen = [place for place, frame in enumerate(used) if frame not in rendered]
    seen = [seen[i] for i in choose_even(len(seen), len(used) - count).tolist()]
    return seen, [used.index(frame) for frame in rendered]


class RepeatedFrames:
    """Says once if scans have fewer frames than are asked for, so that some of them come more than once.

    A frame that comes twice weighs twice, and results with "96 frames" are then of fewer.
    """

    def __init__(self) -> None:
        self._is_said = False

    def look(self, batch: SceneBatch) -> None:
        """Look at the frames of another batch; held-out ones are not among them."""
        for scene_id, frames in zip(batch.scene_id, batch.frame_id, strict=True):
            if not self._is_said and len(set(frames)) < len(frames):
                self._is_said = True
                _log.warning(
                    "scans have %d frames, fewer than the %d asked for: frames are repeated (in %s first)",
                    *(len(set(frames)), len(frames), scene_id),
                )
