# SPDX-License-Identifier: Apache-2.0
"""Scenes for training and validation: any data set that gives a ``SceneBatch`` of one scene."""

from __future__ import annotations

import logging
import math
import os
import shutil
from collections.abc import Callable, Collection, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import lightning.pytorch as pl
import torch
from lightning.fabric.utilities.seed import pl_worker_init_function
from torch import Tensor
from torch.utils.data import DataLoader, Dataset, DistributedSampler

from raytran.data.augment import Augmentation
from raytran.data.collate import collate_scenes
from raytran.data.dataset import JoinedScenes
from raytran.data.workers import become_worker
from raytran.errors import DataError
from raytran.setting_limits import check_settings
from raytran.structs import SceneBatch, TensorStruct
from raytran.training.scene_stream import SceneStream

_log = logging.getLogger(__name__)

SHARED_MEMORY = Path("/dev/shm")
"""Where loader workers of Linux leave the tensors that they hand over."""

_PREFETCHED = 2
"""Batches that a worker loads ahead."""


class SceneDataModule(pl.LightningDataModule):
    """Makes the data if it can and must, then serves batches.

    Args:
        root: folder with ``scannet``, ``scan2cad`` and ``shapenet``.
        dataset: ``dataset(root=…, split="train"|"val", view_choice=…, num_views=…, targets=…,
            augmentation=…)``; validation asks the result for ``[index]``, training for ``[epoch, index]``.
        targets: what batches must hold, see ``SceneDataset``.
        more_roots: further folders like ``root``, whose training scenes are added to those of ``root``;
            scores are of ``root`` alone, and nothing is made there.
        make: ``make(output=root)`` writes the data and does nothing where they are complete; None if they are
            there in any case.
        num_views: frames of a training scene, drawn at random anew each time.
        val_views: frames of a validation scene, evenly spread.
        val_split: the split whose scenes validations score; ``train`` tells what has been learned by heart.
        batch_size: scenes per device.
        num_workers: loader processes.
        augmentation: random changes of training scenes; validation scenes are never changed.
        seed: of the order of the scenes.
        name: of the data set, for results and for ``init_from=auto``; None if it has none.

    Raises:
        ConfigError: a number is beyond what it can mean.
    """

    def __init__(
        self,
        *,
        root: str | Path,
        dataset: Callable[..., Dataset[SceneBatch]],
        targets: Collection[str],
        more_roots: Sequence[str | Path] = (),
        make: Callable[..., Any] | None = None,
        num_views: int = 20,
        val_views: int = 20,
        val_split: str = "val",
        batch_size: int = 1,
        num_workers: int = 2,
        augmentation: Augmentation | None = None,
        seed: int = 0,
        name: str | None = None,
    ) -> None:
        super().__init__()
        check_settings(
            {
                "num_views": num_views,
                "val_views": val_views,
                "batch_size": batch_size,
                "num_workers": num_workers,
                "seed": seed,
            }
        )
        self.root = Path(root)
        self.more_roots = tuple(map(Path, more_roots))
        self.name = name
        self._dataset = dataset
        self._targets = tuple(targets)
        self._make = make
        self._num_views = num_views
        self._val_views = val_views
        self._val_split = val_split
        self._batch_size = batch_size
        self._num_workers = num_workers
        self._augmentation = augmentation
        self._seed = seed
        self._place = {"scenes": 0, "step": 0}

    def prepare_data(self) -> None:
        """Make the data; Lightning calls this on one process and lets the others wait."""
        if self._make is not None:
            self._make(output=self.root)

    def split(self, split: str, *, training: bool = False) -> Dataset[SceneBatch]:
        """Return the scenes of ``train`` or ``val``.

        Args:
            split: which.
            training: of all roots, with random views and augmented.
        """
        datasets = [
            self._dataset(
                root=root,
                split=split,
                targets=self._targets,
                view_choice="random" if training else "even",
                num_views=self._num_views if training else self._val_views,
                augmentation=self._augmentation if training else None,
            )
            for root in (self.root, *(self.more_roots if training else ()))
        ]
        return datasets[0] if len(datasets) == 1 else JoinedScenes(datasets)

    def state_dict(self) -> dict[str, Any]:
        """Return the place in the stream of scenes after the last whole step, for the checkpoint."""
        if self.trainer is None:
            return dict(self._place)
        steps = self.trainer.global_step - self._place["step"]
        a_step = self.trainer.accumulate_grad_batches * self.trainer.world_size * self._batch_size
        return {"scenes": self._place["scenes"] + steps * a_step, "step": self.trainer.global_step}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Go on at the place of a checkpoint, also with another number of ranks or another batch size."""
        self._place = {name: int(state_dict[name]) for name in self._place}

    def train_dataloader(self) -> DataLoader[SceneBatch]:
        """Return the training scenes without end, in an order that changes every epoch."""
        dataset = self.split("train", training=True)
        if "shapes" in self._targets and not getattr(dataset, "has_shapes", lambda: True)():
            raise DataError(
                f"no object in {self.root} has a shape to learn, only boxes are known: train stages 1 and 2 "
                "alone, or prepare the data with the scans' meshes"
            )
        stream = SceneStream(
            dataset,
            **self._ranks(),
            batch_size=self._batch_size,
            seed=self._seed,
            first=self._place["scenes"],
        )
        self._check_shared_memory(dataset)
        return self._loader(dataset, stream, self._batch_size)

    def val_dataloader(self) -> DataLoader[SceneBatch]:
        """Return the validation scenes in order, one by one, so that scores are the same for any batch size.

        On several ranks a few come twice, to make them even; the module counts them once.
        """
        dataset = self.split(self._val_split)
        return self._loader(dataset, DistributedSampler(dataset, **self._ranks(), shuffle=False), 1)

    def _loader(
        self, dataset: Dataset[Any], sampler: DistributedSampler[Any], batch_size: int
    ) -> DataLoader[SceneBatch]:
        return DataLoader(
            dataset,
            batch_size=batch_size,
            sampler=sampler,
            num_workers=self._num_workers,
            prefetch_factor=_PREFETCHED if self._num_workers else None,
            persistent_workers=self._num_workers > 0,
            collate_fn=collate_scenes,
            worker_init_fn=partial(_become_worker, rank=self._ranks()["rank"]),
            pin_memory=self.trainer is not None and self.trainer.strategy.root_device.type == "cuda",
            # A loader draws a seed for its workers whenever it is asked anew. From a source of its own, so
            # that a resumed run, whose loaders are new, draws the same numbers elsewhere.
            generator=torch.Generator().manual_seed(self._seed),
        )

    def _check_shared_memory(self, dataset: Dataset[SceneBatch]) -> None:
        """Warn where the workers of this machine may load more than its shared memory holds.

        During a validation the workers of the training scenes hold what they have loaded ahead as well.
        """
        trainer = self.trainer
        if trainer is None or trainer.local_rank or not self._num_workers or not SHARED_MEMORY.is_dir():
            return
        scenes = trainer.num_devices * self._num_workers * _PREFETCHED * (self._batch_size + 1)
        needed, free = scenes * _bytes_of(dataset[0]), shutil.disk_usage(SHARED_MEMORY).free
        if needed > free:
            _log.warning(
                "loader workers may hold %d scenes, %.2g GB, in %s, which has %.2g GB free; where it is full "
                "they die of a bus error, or training waits for a scene that never comes: enlarge it (docker "
                "run --shm-size=%dg, or --ipc=host) or set fewer views.num_workers (0: none)",
                *(scenes, needed / 1e9, SHARED_MEMORY, free / 1e9, math.ceil(needed / 1e9) + 1),
            )

    def _ranks(self) -> dict[str, Any]:
        if self.trainer is None:
            return {"num_replicas": 1, "rank": 0}
        return {"num_replicas": self.trainer.world_size, "rank": self.trainer.global_rank}


def _become_worker(worker_id: int, *, rank: int) -> None:
    """Begin a loader's worker process, seeded as Lightning does it where it is asked to."""
    become_worker()
    if int(os.environ.get("PL_SEED_WORKERS", "0")):
        pl_worker_init_function(worker_id, rank)


def _bytes_of(value: Any) -> int:
    """Return the size of all tensors in a batch."""
    if isinstance(value, Tensor):
        return value.nbytes
    if isinstance(value, TensorStruct):
        return sum(_bytes_of(item) for item in vars(value).values())
    return sum(map(_bytes_of, value)) if isinstance(value, tuple) else 0
