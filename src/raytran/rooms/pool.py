# SPDX-License-Identifier: Apache-2.0
"""The pool that the furniture of all rooms is drawn from: generated models, given CAD models, or both."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from raytran.rooms.cad import OTHER_IDS, CadModel, sample_model
from raytran.rooms.library import CadLibrary
from raytran.structs import CLASSES

MODELS_PER_CLASS = 100
"""Generated models of one class that the rooms of one split share, as scans share those of Scan2CAD."""

FEW = 5
"""Where a library has fewer models of what is wanted, generated ones make up this number."""


@dataclass(frozen=True)
class ModelPool:
    """The CAD models that all rooms of one seed and split draw from.

    Attributes:
        seed: seed of the rooms.
        library: CAD models given; None for generated ones alone.
        split: whose models of the library are drawn, ``train`` or ``val``; None for all.
        numbers: of the generated models of each class.
    """

    seed: int
    library: CadLibrary | None = None
    split: str | None = "train"
    numbers: range = range(MODELS_PER_CLASS)

    def draw(
        self, category: str, rng: np.random.Generator, *, kinds: Collection[str] = ()
    ) -> CadModel | None:
        """Draw a model of a class, if ``kinds`` is not empty of one of these kinds; None if none is found."""
        if self.library is not None:
            given = [
                model
                for model in self.library.models
                if self.split in (None, model.split)
                and model.category == category
                and (not kinds or model.kind in kinds)
            ]
            generated = category != "other" or not kinds or any(kind in OTHER_IDS for kind in kinds)
            if not (given or generated):
                return None
            number = int(rng.integers(max(len(given), FEW if generated else 0)))
            if number < len(given):
                return self.library.load(given[number])
        for number in rng.integers(self.numbers.start, self.numbers.stop, size=60):
            model = _generated(self.seed, category, int(number))
            if not kinds or model.kind in kinds:
                return model
        return None

    def has(self, kind: str) -> bool:
        """Say whether the library, in this split, has a model of a kind."""
        models = () if self.library is None else self.library.models
        return any(model.kind == kind and self.split in (None, model.split) for model in models)


@lru_cache(maxsize=2048)
def _generated(seed: int, category: str, number: int) -> CadModel:
    # Scenes are seeded by two numbers, models by three: the streams never meet.
    return sample_model(category, np.random.default_rng([seed, CLASSES.index(category), number]))
