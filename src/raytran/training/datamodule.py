# SPDX-License-Identifier: Apache-2.0
"""Scenes for training and validation: any data set that gives a ``SceneBatch`` of one scene."""

from __future__ import annotations

import logging
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import Any

import lightning.pytorch as pl
from torch.utils.data import DataLoader, Dataset, DistributedSampler

from raytran.data.augment import Augmentation
from raytran.data.collate import collate_scenes
from raytran.types import SceneBatch

_log = logging.getLogger(__name__)


class SceneDataModule(pl.LightningDataModule):
    """Makes the data if it can and must, then serves batches.

    Args:
        root: folder with ``scannet``, ``scan2cad`` and ``shapenet``.
        dataset: ``dataset(root=…, split="train"|"val", view_choice=…, num_views=…, targets=…,
            augmentation=…)``.
        targets: what batches must hold, see ``SceneDataset``.
        make: ``make(output=root)`` writes the data and does nothing where they are complete; None if they are
            there in any case.
        num_views: frames of a training scene, drawn at random anew each time.
        val_views: frames of a validation scene, evenly spread.
        batch_size: scenes per device.
        num_workers: loader processes.
        augmentation: random changes of training scenes; validation scenes are never changed.
        seed: of the order of the scenes.
    """

    def __init__(
        self,
        *,
        root: str | Path,
        dataset: Callable[..., Dataset[SceneBatch]],
        targets: Collection[str],
        make: Callable[..., Any] | None = None,
        num_views: int = 20,
        val_views: int = 20,
        batch_size: int = 1,
        num_workers: int = 2,
        augmentation: Augmentation | None = None,
        seed: int = 0,
    ) -> None:
        super().__init__()
        self.root = Path(root)
        self._dataset = dataset
        self._targets = tuple(targets)
        self._make = make
        self._num_views = num_views
        self._val_views = val_views
        self._batch_size = batch_size
        self._num_workers = num_workers
        self._augmentation = augmentation
        self._seed = seed

    def prepare_data(self) -> None:
        """Make the data; Lightning calls this on one process and lets the others wait."""
        if self._make is not None:
            self._make(output=self.root)

    def split(self, split: str, *, training: bool = False) -> Dataset[SceneBatch]:
        """Return the scenes of ``train`` or ``val``; for training with random views and augmented."""
        return self._dataset(
            root=self.root,
            split=split,
            targets=self._targets,
            view_choice="random" if training else "even",
            num_views=self._num_views if training else self._val_views,
            augmentation=self._augmentation if training else None,
        )

    def train_dataloader(self) -> DataLoader[SceneBatch]:
        """Return the training scenes in an order that changes every epoch."""
        dataset = _ByEpoch(self.split("train", training=True))
        return self._loader(dataset, EpochSampler(dataset, **self._ranks(), seed=self._seed))

    def val_dataloader(self) -> DataLoader[SceneBatch]:
        """Return the validation scenes in order; on several ranks a few come twice, to make them even."""
        dataset = self.split("val")
        return self._loader(dataset, DistributedSampler(dataset, **self._ranks(), shuffle=False))

    def _loader(self, dataset: Dataset[Any], sampler: DistributedSampler[Any]) -> DataLoader[SceneBatch]:
        return DataLoader(
            dataset,
            batch_size=self._batch_size,
            sampler=sampler,
            num_workers=self._num_workers,
            persistent_workers=self._num_workers > 0,
            collate_fn=collate_scenes,
            pin_memory=self.trainer is not None and self.trainer.strategy.root_device.type == "cuda",
        )

    def _ranks(self) -> dict[str, Any]:
        if self.trainer is None:
            return {"num_replicas": 1, "rank": 0}
        return {"num_replicas": self.trainer.world_size, "rank": self.trainer.global_rank}


class EpochSampler(DistributedSampler[Any]):
    """Gives (epoch, index) pairs: worker processes that live on learn which epoch they draw frames for."""

    def __iter__(self) -> Iterator[Any]:
        """Yield the pairs of this rank."""
        return ((self.epoch, index) for index in super().__iter__())


class _ByEpoch(Dataset[SceneBatch]):
    """A data set asked by (epoch, index)."""

    def __init__(self, dataset: Any) -> None:
        self._dataset = dataset

    def __len__(self) -> int:
        return len(self._dataset)

    def __getitem__(self, item: tuple[int, int]) -> SceneBatch:
        epoch, index = item
        self._dataset.set_epoch(epoch)
        return self._dataset[index]
