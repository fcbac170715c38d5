# SPDX-License-Identifier: Apache-2.0
"""The losses of RayTran §3.2: dense terms, and the weighted sum of all that a stage of training minimises."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Literal, TypeVar, cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from raytran.errors import ConfigError, DataError
from raytran.losses.matcher import HungarianMatcher
from raytran.losses.objects import Betas, Differences, Match, TrueObjects, object_losses, pick_queries
from raytran.structs import ObjectSet, RawObjects, RawScene, SceneBatch, Views, constant


def occupancy_loss(logits: Tensor, target: Tensor) -> Tensor:
    """Return the binary cross entropy of logits and bool target, both ``(B, X, Y, Z)``; mean over voxels."""
    return F.binary_cross_entropy_with_logits(logits.float(), target.float())


def foreground_loss(logits: Tensor, target: Tensor) -> Tensor:
    """Return the binary cross entropy of logits and bool target, both ``(B, N, H, W)``; mean over pixels."""
    return F.binary_cross_entropy_with_logits(logits.float(), target.float())


def shape_loss(logits: Tensor, target: Tensor, *, num_objects: Tensor) -> Tensor:
    """Return the binary cross entropy, mean over cells, sum over objects divided by ``num_objects``.

    Args:
        logits: ``(M, S, S, S)``.
        target: ``(M, S, S, S)`` bool; without any cell, the shape is not known and counts nothing.
        num_objects: scalar.
    """
    entropy = F.binary_cross_entropy_with_logits(logits.float(), target.float(), reduction="none")
    is_known = target.flatten(1).any(dim=1)
    return (entropy.flatten(1).mean(dim=1) * is_known).sum() / num_objects


def view_loss(logits: Tensor, target: Views) -> Tensor:
    """Return the mean squared error of colours in [0, 1].

    Args:
        logits: ``(B, V, 3, H, W)``.
        target: ``V`` photographs of each scene, taken by the cameras that were rendered.
    """
    return F.mse_loss(logits.float().sigmoid(), target.colors())


WEIGHTS = ("occupancy", "foreground", "class", "center", "size", "yaw", "heat", "shape", "view")
TERMS = ("occupancy", "foreground", "objects", "shape", "view")
SHAPE_LAYERS = ("last", "all")

_T = TypeVar("_T")
_U = TypeVar("_U")


class ExtensionLoss(nn.Module, ABC):
    """A further loss of the objects, for a part that the paper's network does not have.

    Attributes:
        reads: the field of ``RawScene`` that it is the loss of; it is called if the network returned that.
    """

    reads: str

    @abstractmethod
    def forward(
        self, raw: RawScene, targets: Sequence[ObjectSet], *, num_objects: Tensor, betas: Betas
    ) -> dict[str, Tensor]:
        """Return scalars by the name of the weight that they get.

        Args:
            raw: what the network returned for B scenes.
            targets: true objects of B scenes.
            num_objects: scalar by which sums over objects are divided.
            betas: of the poses' smooth L1.
        """


class TotalLoss(nn.Module):
    """Every loss term, and their weighted sum.

    Args:
        weights: one weight per name in ``WEIGHTS``; all decoder layers count alike.
        matcher: matches queries with true objects.
        no_object_weight: weight of the padding class in the cross entropy (0.1 in DETR).
        shape_layers: which decoder layers tell the shapes of their matched queries: the ``last``, or ``all``,
            each with its own matches and all alike, as class and pose; that decodes as many times the grids.
        center_beta: of the centre's smooth L1, see ``Betas``.
        yaw_beta: of the yaw's.
        extensions: further losses of the objects by name; None for none, as in the paper.

    Raises:
        ConfigError: a weight is missing or unknown, there is no such choice, or a beta is negative.
    """

    def __init__(
        self,
        *,
        weights: Mapping[str, float],
        matcher: HungarianMatcher,
        no_object_weight: float = 0.1,
        shape_layers: Literal["last", "all"] = "last",
        center_beta: float = Betas().center,
        yaw_beta: float = Betas().yaw,
        extensions: Mapping[str, ExtensionLoss] | None = None,
    ) -> None:
        super().__init__()
        if shape_layers not in SHAPE_LAYERS:
            raise ConfigError(f"unknown shape_layers={shape_layers}: choose one of {', '.join(SHAPE_LAYERS)}")
        if set(weights) != set(WEIGHTS):
            raise ConfigError(f"expected loss weights {sorted(WEIGHTS)}, got {sorted(weights)}")
        self.weights = {name: float(weights[name]) for name in WEIGHTS}
        self.matcher = matcher
        self.no_object_weight = no_object_weight
        self.shape_layers = shape_layers
        self.betas = Betas(center_beta, yaw_beta).checked()
        self.extensions = nn.ModuleDict(extensions or {})

    def forward(
        self,
        raw: RawScene,
        batch: SceneBatch,
        *,
        terms: Collection[str],
        decode_shapes: Callable[[Tensor], Tensor] | None = None,
        mean_over_ranks: Callable[[Tensor], Tensor] | None = None,
    ) -> dict[str, Tensor]:
        """Return the unweighted terms and their weighted sum ``total``, in float32 also under autocast.

        Terms of objects are sums over objects, or over queries, divided by their number or total weight in
        all scenes of the step. So the mean over ranks of the gradients is that of one rank with all the
        scenes.

        Args:
            raw: what the network returned.
            batch: the targets.
            terms: some of ``TERMS``.
            decode_shapes: shape logits ``(M, S, S, S)`` of query embeddings ``(M, C)``; needed for ``shape``.
            mean_over_ranks: returns the mean of a vector over the ranks that share the step, all with as many
                scenes; None where there is one rank.

        Returns:
            ``occupancy``, ``foreground``, ``shape``, ``view``; ``objects/class``, ``objects/center``,
            ``objects/size``, ``objects/yaw`` of the last decoder layer, ``objects/class/layer0`` … of earlier
            ones, ``objects/heat/proposals`` … of the extension ``proposals`` and so on of others, and
            ``shape/layer0`` … of earlier layers if all tell shapes.

        Raises:
            ConfigError: a term is unknown, or the network was not asked for it.
            DataError: the batch lacks the targets of a term.
        """
        unknown = set(terms) - set(TERMS)
        if unknown or not terms:
            raise ConfigError(f"expected loss terms out of {TERMS}, got {sorted(terms)}")
        losses: dict[str, Tensor] = {}
        device = raw.grid_center.device.type
        if decode_shapes is not None:
            decode_shapes = _under_current_autocast(decode_shapes, device)
        with torch.autocast(device, enabled=False):
            if "occupancy" in terms:
                losses["occupancy"] = occupancy_loss(*_both("occupancy", raw.occupancy, batch.occupancy))
            if "foreground" in terms:
                losses["foreground"] = foreground_loss(*_both("foreground", raw.foreground, batch.foreground))
            if "view" in terms:
                losses["view"] = view_loss(*_both("view", raw.new_views, batch.new_views))
            if "objects" in terms or "shape" in terms:
                losses |= self._objects(raw, batch, terms, decode_shapes, mean_over_ranks)
            values = torch.stack(list(losses.values()))
            weights = constant(tuple(map(self._weight, losses)), values.dtype, device=values.device)
            losses["total"] = (weights * values).sum()
        return losses

    def _objects(
        self,
        raw: RawScene,
        batch: SceneBatch,
        terms: Collection[str],
        decode_shapes: Callable[[Tensor], Tensor] | None,
        mean_over_ranks: Callable[[Tensor], Tensor] | None,
    ) -> dict[str, Tensor]:
        predicted, scenes = _both("objects", raw.objects, batch.objects)
        every_layer = "objects" in terms or self.shape_layers == "all"
        layers = RawObjects.stack(predicted if every_layer else predicted[-1:]).in_float32()
        targets, counts = TrueObjects.of(*scenes), [len(objects) for objects in scenes]
        num_objects, class_weight = self._divisors(layers, counts, mean_over_ranks)
        differences = Differences.of_all(layers, targets)
        match = self.matcher(layers, targets, counts, differences)
        losses: dict[str, Tensor] = {}
        if "shape" in terms:
            if decode_shapes is None:
                raise ConfigError("the loss term shape needs decode_shapes: give RayTran.decode_shapes")
            of_layers = slice(None) if self.shape_layers == "all" else slice(-1, None)
            found = _matched_shape_losses(
                layers.embedding[of_layers],
                scenes,
                Match(match.query[of_layers], match.target[of_layers]),
                decode_shapes,
                num_objects,
            )
            losses |= _by_layer("shape", found)
        if "objects" not in terms:
            return losses
        of_pairs = object_losses(
            layers,
            targets,
            match,
            differences,
            num_objects=num_objects,
            class_weight=class_weight,
            no_object_weight=self.no_object_weight,
            betas=self.betas,
        )
        for name, values in of_pairs.items():
            losses |= _by_layer(f"objects/{name}", values.unbind())
        for name, extension in self.extensions.items():
            if getattr(raw, cast("ExtensionLoss", extension).reads) is None:
                continue
            found_there = extension(raw, scenes, num_objects=num_objects, betas=self.betas)
            losses |= {f"objects/{term}/{name}": value for term, value in found_there.items()}
        return losses

    def _divisors(
        self,
        layers: RawObjects,
        counts: Sequence[int],
        mean_over_ranks: Callable[[Tensor], Tensor] | None,
    ) -> tuple[Tensor, Tensor]:
        """Return the number of true objects and a layer's total weight in the cross entropy, a rank."""
        scenes, queries = layers.class_logits.shape[1:3]
        matched = sum(min(queries, count) for count in counts)
        weight = matched + self.no_object_weight * (scenes * queries - matched)
        count = sum(counts)
        # Without any object, one a scene. A bound of one a rank would be wrong: on two ranks it makes two.
        without_any = float(scenes)
        # Numbers are filled in on the device: a copy to it would make the host wait.
        if mean_over_ranks is None:
            return layers.center.new_full((), count or without_any), layers.center.new_full(
                (), weight or without_any
            )
        means = mean_over_ranks(torch.stack([layers.center.new_full((), value) for value in (count, weight)]))
        num_objects, class_weight = torch.where(means > 0, means, without_any).unbind()
        return num_objects, class_weight

    def _weight(self, name: str) -> float:
        """Return the weight of a term, e.g. that of ``center`` for ``objects/center/layer0``."""
        return self.weights[name.removeprefix("objects/").split("/")[0]]


def _by_layer(name: str, values: Sequence[Tensor]) -> dict[str, Tensor]:
    """Name the values of layers: that of the last one without its number."""
    last = len(values) - 1
    return {name if i == last else f"{name}/layer{i}": value for i, value in enumerate(values)}


def _matched_shape_losses(
    embedding: Tensor,
    targets: Sequence[ObjectSet],
    match: Match,
    decode_shapes: Callable[[Tensor], Tensor],
    num_objects: Tensor,
) -> list[Tensor]:
    """Return each layer's shape loss of the matched queries, and of them alone: 63³ for each of Q is dear.

    Args:
        embedding: ``(L, B, Q, C)``; layers are decoded one at a time.
        targets: true objects of B scenes.
        match: their pairs with the queries.
        decode_shapes: as that of ``TotalLoss.forward``.
        num_objects: scalar by which the sums are divided.
    """
    if any(objects.shape is None and len(objects) > 0 for objects in targets):
        raise DataError(
            "the loss term shape needs shape grids in the batch: add shapes to the data set's targets"
        )
    if not match.query.shape[1]:
        # Decode one query and count it nothing, so that every rank of a parallel run has gradients to add.
        return [0.0 * decode_shapes(of_layer[:1, 0]).float().sum() for of_layer in embedding]
    shapes = [objects.shape for objects in targets if objects.shape is not None]
    shape = shapes[0] if len(shapes) == 1 else torch.cat(shapes)
    matched = pick_queries(embedding, match.query)
    return [
        shape_loss(decode_shapes(some), shape[target], num_objects=num_objects)
        for some, target in zip(matched, match.target, strict=True)
    ]


def _under_current_autocast(function: Callable[[Tensor], Tensor], device: str) -> Callable[[Tensor], Tensor]:
    """Return ``function`` so that it runs under the autocast of now, wherever it is called."""
    enabled, dtype = torch.is_autocast_enabled(device), torch.get_autocast_dtype(device)

    def call(x: Tensor) -> Tensor:
        with torch.autocast(device, dtype=dtype, enabled=enabled):
            return function(x)

    return call


def _both(name: str, predicted: _T | None, target: _U | None) -> tuple[_T, _U]:
    if predicted is None:
        raise ConfigError(f"the loss term {name} needs the task {name}: ask the network for it")
    if target is None:
        remedy = "hold frames out" if name == "view" else f"add {name} to the data set's targets"
        raise DataError(f"the loss term {name} needs its targets in the batch: {remedy}")
    return predicted, target
