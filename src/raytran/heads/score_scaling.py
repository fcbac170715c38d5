# SPDX-License-Identifier: Apache-2.0
"""From the probabilities that a network gives to scores that mean what they say."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

from torch import Tensor

from raytran.errors import ConfigError, DataError
from raytran.limits import LOG_ODDS, SCALE, as_number

SCORE_THRESHOLD = 0.5
"""Least probability of an object that counts, unless another one is asked for."""


@dataclass(frozen=True)
class ScoreScaling:
    """Platt's scaling: of the objects of probability p, a share of σ(scale · logit p + offset) is right.

    It changes no order: which of two objects is the surer, and whatever depends on that alone, stays. With an
    offset of 0 it is a temperature of 1 / scale on the odds.

    J. Platt, Probabilistic outputs for support vector machines, 1999.

    Attributes:
        scale: above 0; less than 1 for a network that is too sure of itself.
        offset: less than 0 for one that finds too much.
    """

    scale: float
    offset: float

    @staticmethod
    def of(settings: ScoreScaling | Mapping[str, Any] | None) -> ScoreScaling | None:
        """Return the scaling of some settings, ``{scale: …, offset: …}``; None for None.

        Raises:
            ConfigError: they are something else, or a number is beyond its bounds.
        """
        if settings is None or isinstance(settings, ScoreScaling):
            return settings
        try:
            return ScoreScaling(
                scale=as_number(settings["scale"], SCALE, "score_scaling.scale"),
                offset=as_number(settings["offset"], LOG_ODDS, "score_scaling.offset"),
            )
        except (DataError, KeyError, TypeError) as error:
            raise ConfigError(
                f"the scaling of scores is no pair of a scale and an offset, but {settings} ({error})"
            ) from error

    def __call__(self, score: Tensor) -> Tensor:
        """Return the scaled scores; 0 stays 0, 1 stays 1."""
        return (self.scale * score.logit() + self.offset).sigmoid()

    @property
    def of_half(self) -> float:
        """The score of a probability of ½, whose log odds are 0."""
        return 1 / (1 + math.exp(-self.offset))

    def after(self, first: ScoreScaling | None) -> ScoreScaling:
        """Return the one scaling that does what ``first`` and then this one do."""
        if first is None:
            return self
        return ScoreScaling(self.scale * first.scale, self.scale * first.offset + self.offset)

    def settings(self) -> dict[str, float]:
        """Return what ``of`` takes."""
        return asdict(self)
