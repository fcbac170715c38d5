# SPDX-License-Identifier: Apache-2.0
"""The endless order in which training scenes come; a run that was stopped finds its place in it again."""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache
from typing import Any

import torch
from torch.utils.data import Dataset, DistributedSampler


class SceneStream(DistributedSampler[Any]):
    """Gives (epoch, index) pairs without end: epoch after epoch, each in another order.

    Every batch takes the next ``num_replicas · batch_size`` places of the stream, the ranks one after the
    other. So a step sees the same scenes however they are spread over ranks, no batch is cut short by the end
    of an epoch, and the place of a run in the stream is one number.

    Args:
        dataset: the scenes, of which only the number counts.
        num_replicas: ranks.
        rank: of this process.
        batch_size: scenes of one rank in one batch.
        seed: of the orders.
        first: place in the stream at which to begin, counted in scenes of all ranks.
    """

    def __init__(
        self,
        dataset: Dataset[Any],
        *,
        num_replicas: int,
        rank: int,
        batch_size: int,
        seed: int = 0,
        first: int = 0,
    ) -> None:
        # A DistributedSampler, so that Lightning does not put its own in place of it.
        super().__init__(dataset, num_replicas=num_replicas, rank=rank, seed=seed)
        self._num_scenes = len(dataset)  # type: ignore[arg-type]
        self._batch_size = batch_size
        self._first = first

    def __iter__(self) -> Iterator[Any]:
        """Yield the pairs of this rank."""
        # A batch may reach over the end of an epoch: the orders of two are at hand.
        order = lru_cache(maxsize=2)(self._order)
        start = self._first + self.rank * self._batch_size
        while True:
            for place in range(start, start + self._batch_size):
                epoch, position = divmod(place, self._num_scenes)
                yield epoch, order(epoch)[position]
            start += self.num_replicas * self._batch_size

    def __len__(self) -> int:
        """Raise TypeError, which is how PyTorch and Lightning ask whether there is an end."""
        raise TypeError("the stream of scenes has no end")

    def _order(self, epoch: int) -> list[int]:
        generator = torch.Generator().manual_seed(self.seed + epoch)
        return torch.randperm(self._num_scenes, generator=generator).tolist()
