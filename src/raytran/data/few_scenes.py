# SPDX-License-Identifier: Apache-2.0
"""A few scenes, always with the same frames, in training and validation: to be learned by heart."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from torch.utils.data import Dataset

from raytran.data.dataset import scan2cad_dataset
from raytran.structs import SceneBatch


class FewScenes(Dataset[SceneBatch]):
    """The first scenes of another data set, whatever the epoch.

    Args:
        dataset: the scenes.
        num_scenes: how many of them, at most.
    """

    def __init__(self, dataset: Dataset[SceneBatch], num_scenes: int) -> None:
        self._dataset = dataset
        self._length = min(num_scenes, len(dataset))  # type: ignore[arg-type]

    def __len__(self) -> int:
        return self._length

    def __getitem__(self, item: int | tuple[int, int]) -> SceneBatch:
        """Return scene ``item``, or of (epoch, index) the scene ``index``, with B = 1."""
        index = item[1] if isinstance(item, tuple) else item
        if not 0 <= index < self._length:
            raise IndexError(f"scene {index} of {self._length}")
        return self._dataset[index]


def few_scenes(*, root: Path, num_scenes: int, **options: Any) -> FewScenes:
    """Return training scenes with evenly spread frames, as they are, whatever else is asked for.

    Args:
        root: see ``scan2cad_dataset``.
        num_scenes: how many scenes.
        options: further arguments of ``scan2cad_dataset``; split, frames and augmentation do not count.
    """
    fixed = options | {"split": "train", "view_choice": "even", "augmentation": None}
    return FewScenes(scan2cad_dataset(root=root, **fixed), num_scenes)
