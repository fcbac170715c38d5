# SPDX-License-Identifier: Apache-2.0
"""The sum of all losses that a stage of training minimises (RayTran §3.2)."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from typing import TypeVar

import torch
from torch import Tensor, nn

from raytran.errors import ConfigError, DataError
from raytran.losses.foreground import foreground_loss
from raytran.losses.matcher import HungarianMatcher, Match
from raytran.losses.objects import object_losses
from raytran.losses.occupancy import occupancy_loss
from raytran.losses.proposals import proposal_losses
from raytran.losses.shape import shape_loss
from raytran.types import ObjectSet, RawObjects, RawScene, SceneBatch

WEIGHTS = ("occupancy", "foreground", "class", "center", "size", "yaw", "heat", "shape")
TERMS = ("occupancy", "foreground", "objects", "shape")

_T = TypeVar("_T")
_U = TypeVar("_U")


class TotalLoss(nn.Module):
    """Every loss term, and their weighted sum.

    Args:
        weights: one weight per name in ``WEIGHTS``; all decoder layers count alike.
        matcher: matches slots with true objects.
        no_object_weight: weight of the padding class in the cross entropy (0.1 in DETR).

    Raises:
        ConfigError: a weight is missing or unknown.
    """

    def __init__(
        self, *, weights: Mapping[str, float], matcher: HungarianMatcher, no_object_weight: float = 0.1
    ) -> None:
        super().__init__()
        if set(weights) != set(WEIGHTS):
            raise ConfigError(f"expected loss weights {sorted(WEIGHTS)}, got {sorted(weights)}")
        self.weights = {name: float(weights[name]) for name in WEIGHTS}
        self.matcher = matcher
        self.no_object_weight = no_object_weight

    def forward(
        self,
        raw: RawScene,
        batch: SceneBatch,
        *,
        terms: Collection[str],
        decode_shapes: Callable[[Tensor], Tensor] | None = None,
        num_objects: Tensor | None = None,
    ) -> dict[str, Tensor]:
        """Return the unweighted terms and their weighted sum ``total``.

        Args:
            raw: what the network returned.
            batch: the targets.
            terms: some of ``TERMS``.
            decode_shapes: shape logits ``(M, S, S, S)`` of query embeddings ``(M, C)``; needed for ``shape``.
            num_objects: scalar by which sums over objects are divided; by default the objects in ``batch``,
                at least one.

        Returns:
            ``occupancy``, ``foreground``, ``shape``; ``objects/class``, ``objects/center``, ``objects/size``,
            ``objects/yaw`` of the last decoder layer, ``objects/class/layer0`` and so on of earlier ones,
            ``objects/heat/proposals`` and so on of the proposals, if the network makes any.

        Raises:
            ConfigError: a term is unknown, or the network was not asked for it.
            DataError: the batch lacks the targets of a term.
        """
        unknown = set(terms) - set(TERMS)
        if unknown or not terms:
            raise ConfigError(f"expected loss terms out of {TERMS}, got {sorted(terms)}")
        losses: dict[str, Tensor] = {}
        if "occupancy" in terms:
            losses["occupancy"] = occupancy_loss(*_both("occupancy", raw.occupancy, batch.occupancy))
        if "foreground" in terms:
            losses["foreground"] = foreground_loss(*_both("foreground", raw.foreground, batch.foreground))
        if "objects" in terms or "shape" in terms:
            losses |= self._objects(raw, batch, terms, decode_shapes, num_objects)
        losses["total"] = torch.stack([self._weight(name) * value for name, value in losses.items()]).sum()
        return losses

    def _objects(
        self,
        raw: RawScene,
        batch: SceneBatch,
        terms: Collection[str],
        decode_shapes: Callable[[Tensor], Tensor] | None,
        num_objects: Tensor | None,
    ) -> dict[str, Tensor]:
        layers, targets = _both("objects", raw.objects, batch.objects)
        if num_objects is None:
            num_objects = layers[-1].center.new_tensor(max(1, sum(len(objects) for objects in targets)))
        last = self.matcher(layers[-1], targets)
        losses: dict[str, Tensor] = {}
        if "shape" in terms:
            if decode_shapes is None:
                raise ConfigError("the loss term shape needs decode_shapes: give RayTran.decode_shapes")
            losses["shape"] = _matched_shape_loss(layers[-1], targets, last, decode_shapes, num_objects)
        for index, layer in enumerate(layers if "objects" in terms else ()):
            is_last = index + 1 == len(layers)
            matches = last if is_last else self.matcher(layer, targets)
            found = object_losses(
                layer, targets, matches, num_objects=num_objects, no_object_weight=self.no_object_weight
            )
            suffix = "" if is_last else f"/layer{index}"
            losses |= {f"objects/{name}{suffix}": value for name, value in found.items()}
        if "objects" in terms and raw.proposals is not None:
            found = proposal_losses(raw.proposals, targets, num_objects=num_objects)
            losses |= {f"objects/{name}/proposals": value for name, value in found.items()}
        return losses

    def _weight(self, name: str) -> float:
        """Return the weight of a term, e.g. that of ``center`` for ``objects/center/layer0``."""
        return self.weights[name.removeprefix("objects/").split("/")[0]]


def _matched_shape_loss(
    raw: RawObjects,
    targets: Sequence[ObjectSet],
    matches: Sequence[Match],
    decode_shapes: Callable[[Tensor], Tensor],
    num_objects: Tensor,
) -> Tensor:
    """Return the shape loss of the matched slots, and of them alone: a 63³ grid for each of Q is dear."""
    if any(objects.shape is None and len(objects) > 0 for objects in targets):
        raise DataError(
            "the loss term shape needs shape grids in the batch: add shapes to the data set's targets"
        )
    embedding = torch.cat([raw.embedding[i, match.slot] for i, match in enumerate(matches)])
    if not len(embedding):
        # Decode one slot and count it nothing, so that every rank of a parallel run has gradients to add.
        return 0.0 * decode_shapes(raw.embedding[:1, 0]).float().sum()
    wanted = [o.shape[match.target] for o, match in zip(targets, matches, strict=True) if o.shape is not None]
    return shape_loss(decode_shapes(embedding), torch.cat(wanted), num_objects=num_objects)


def _both(name: str, predicted: _T | None, target: _U | None) -> tuple[_T, _U]:
    if predicted is None:
        raise ConfigError(f"the loss term {name} needs the task {name}: ask the network for it")
    if target is None:
        raise DataError(
            f"the loss term {name} needs its targets in the batch: add {name} to the data set's targets"
        )
    return predicted, target
