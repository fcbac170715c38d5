# SPDX-License-Identifier: Apache-2.0
"""Object head: queries, decoded over the voxels into class, centre, size and yaw (RayTran §3.2)."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence, Sized
from typing import Any, NamedTuple, cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.quasirandom import SobolEngine

from raytran.classes import PAPER_CLASSES, Classes
from raytran.errors import ConfigError
from raytran.geometry.grid import VoxelGrid, centered_voxels, position_code, voxel_code
from raytran.geometry.rotation import rotation_from_yaw
from raytran.heads.decoder import (
    DecoderLayer,
    KeysAndValues,
    VoxelAttention,
    in_product_dtype,
    keys_and_values_together,
)
from raytran.heads.score_scaling import ScoreScaling
from raytran.norms import LayerNorm
from raytran.structs import ObjectSet, RawObjects, RawProposals

QUERY_SCALE = 0.1
"""Standard deviation of the query embeddings before training: small, so that what they read outweighs it."""

TYPICAL_SIZE = 0.7
"""Side of an object before training, metres."""


class Queries(NamedTuple):
    """What the decoder starts from.

    Attributes:
        embedding: ``(B, Q, C)``.
        reference: ``(B, Q, 3)`` reference points, metres from the centre of the volume.
        log_size: ``(B, Q, 3)`` to which the layers' predictions of the logarithm of the size are added.
        yaw_vector: ``(B, Q, 2)`` to which those of (sin, cos) of the yaw are added.
        proposals: of all voxels, where a scene's voxels propose its queries; None if they are learned.
    """

    embedding: Tensor
    reference: Tensor
    log_size: Tensor
    yaw_vector: Tensor
    proposals: RawProposals | None = None


class LearnedQueries(nn.Module):
    """Q embeddings and reference points that are the same for every scene (DETR; RayTran §3.2).

    Args:
        channels: C.
        num_queries: Q.
        extent: sizes of the voxel grid, metres, over which the reference points spread at first.
    """

    extent: Tensor

    def __init__(self, *, channels: int, num_queries: int, extent: Sequence[float]) -> None:
        super().__init__()
        # Sobol's points cover the volume more evenly than random ones, and are the same in every run.
        spread = SobolEngine(3).draw(num_queries + 1)[1:] - 0.5
        self.register_buffer("extent", torch.tensor([float(side) for side in extent]), persistent=False)
        self.reference = nn.Parameter(0.8 * spread)
        self.embedding = nn.Parameter(QUERY_SCALE * torch.randn(num_queries, channels))

    def forward(self, voxels: Tensor, grid: VoxelGrid) -> Queries:
        """Return the queries for B scenes; of ``voxels`` ``(B, X, Y, Z, C)`` only B is read."""
        scenes = voxels.shape[0]
        reference = (self.reference * self.extent).expand(scenes, -1, -1)
        log_size = torch.full_like(reference, math.log(TYPICAL_SIZE))
        # (sin, cos) of no rotation, (0, 1), made on the device: a copy to it would make the host wait.
        no_yaw = torch.arange(2, dtype=reference.dtype, device=reference.device)
        yaw_vector = no_yaw.expand(*reference.shape[:2], 2)
        return Queries(self.embedding.expand(scenes, -1, -1), reference, log_size, yaw_vector, None)


class ObjectOutputs(NamedTuple):
    """What the object head returns.

    Attributes:
        layers: predictions of every decoder layer, last layer last.
        proposals: of all voxels, where they propose the queries.
        denoising: as ``layers``, for noisy copies of true objects, where the head learns to correct such.
    """

    layers: tuple[RawObjects, ...]
    proposals: RawProposals | None = None
    denoising: tuple[RawObjects, ...] | None = None


class ObjectHead(nn.Module):
    """Predicts the objects of a scene from ``num_queries`` queries, after every decoder layer.

    Every query is an embedding and a reference point in the volume. A layer predicts the centre as an offset
    from the reference point, and hands it on as the reference of the next layer (Deformable DETR, Zhu et al.,
    ICLR 2021, but with gradients: early layers learn to aim for late ones).

    What is passed as a callable is chosen in the config by ``_target_`` with ``_partial_``; left out, it is
    the paper's (``raytran.extensions`` has others).

    Args:
        channels: C of the voxel features and queries.
        num_heads: attention heads.
        num_layers: decoder layers L.
        num_queries: Q.
        hidden: channels inside the decoder's feed-forward.
        grid_extent: sizes of the voxel grid, metres.
        queries: called with ``channels`` and ``num_queries``, returns a module from ``(voxels, grid)`` to
            ``Queries``; None for ``LearnedQueries``.
        voxel_attention: what queries read the voxels with, see ``DecoderLayer``.
        refinement: from what a layer started from and what it predicts to what the next one starts from; None
            for ``CenterRefinement``.
        classes: K classes, or their names; each layer's output has padding behind them.

    Raises:
        ConfigError: queries are named by a word.
    """

    extent: Tensor

    def __init__(
        self,
        *,
        channels: int = 256,
        num_heads: int = 8,
        num_layers: int = 6,
        num_queries: int = 64,
        hidden: int = 1024,
        grid_extent: Sequence[float] = (9.0, 9.0, 3.5),
        queries: Callable[..., nn.Module] | None = None,
        voxel_attention: Callable[..., nn.Module] | None = None,
        refinement: nn.Module | None = None,
        classes: Sized = PAPER_CLASSES,
    ) -> None:
        super().__init__()
        if isinstance(queries, str):
            raise ConfigError(
                f"model.heads.objects.queries={queries} is no module: "
                "choose model/extensions=[proposal_queries], "
                "or model.heads.objects.queries=null for learned ones"
            )
        self.grid_extent = tuple(float(length) for length in grid_extent)
        self.num_classes = len(classes)
        self.register_buffer("extent", torch.tensor(self.grid_extent), persistent=False)
        self.queries = (
            LearnedQueries(channels=channels, num_queries=num_queries, extent=self.grid_extent)
            if queries is None
            else queries(channels=channels, num_queries=num_queries)
        )
        self.position = nn.Linear(channels, channels)
        self.layers = nn.ModuleList(
            DecoderLayer(
                channels=channels, num_heads=num_heads, hidden=hidden, voxel_attention=voxel_attention
            )
            for _ in range(num_layers)
        )
        self.predictors = nn.ModuleList(
            ObjectPredictor(channels=channels, num_classes=self.num_classes) for _ in range(num_layers)
        )
        self.refinement = CenterRefinement() if refinement is None else refinement

    def forward(
        self, voxels: Tensor, grid: VoxelGrid, true_objects: Sequence[ObjectSet] | None = None
    ) -> ObjectOutputs:
        """Return the predictions of every layer.

        Args:
            voxels: ``(B, X, Y, Z, C)`` features.
            grid: the voxel grids, ``center`` ``(B, 3)``.
            true_objects: of B scenes, in training; for heads that learn from noisy copies of them. Not read
                here.
        """
        queries: Queries = self.queries(voxels, grid)
        return ObjectOutputs(self.decode(queries, voxels, grid), queries.proposals)

    def decode(
        self, queries: Queries, voxels: Tensor, grid: VoxelGrid, mask: Tensor | None = None
    ) -> tuple[RawObjects, ...]:
        """Return the predictions of every layer for some queries.

        Args:
            queries: what the first layer starts from.
            voxels: ``(B, X, Y, Z, C)`` features.
            grid: the voxel grids, ``center`` ``(B, 3)``.
            mask: ``(Q, Q)`` bool, which queries must not attend to which, see ``DecoderLayer.forward``.
        """
        grid_center = grid.center.to(self.extent.dtype)
        shape, like = (grid.resolution, grid.extent), self.extent
        voxel_position = centered_voxels(*shape, like.dtype, device=like.device).flatten(0, 2)
        channels = self.position.in_features
        code = voxel_code(*shape, self.grid_extent, channels, like.dtype, device=like.device)
        memory = voxels.flatten(1, 3) + self.position(code.flatten(0, 2))
        embedding = in_product_dtype(queries.embedding)
        memories = self._memory_of_layers(memory)
        # On a GPU what the next layer does not start from is predicted for all layers together.
        together = type(self.refinement) is CenterRefinement and not voxels.is_cpu
        outputs, places = [], []
        for layer, predictor, memory in zip(self.layers, self.predictors, memories, strict=True):
            position = self._encode_positions(queries.reference)
            embedding = layer(embedding, position, queries.reference, memory, voxel_position, mask)
            if together:
                places.append(cast("ObjectPredictor", predictor).place(embedding, queries.reference))
                queries = queries._replace(reference=places[-1].reference)
            else:
                objects = predictor(embedding, queries, grid_center)
                queries = self.refinement(queries, objects, grid_center)
                outputs.append(objects)
        if together:
            return predict_together(list(self.predictors), places, queries, grid_center)
        return tuple(outputs)

    def _memory_of_layers(self, memory: Tensor) -> Sequence[Tensor | KeysAndValues]:
        """Return what each layer reads of ``memory`` ``(B, V, C)``: itself, or keys and values made of it."""
        attentions: list[Any] = [layer.voxel_attention for layer in self.layers]
        is_plain = all(type(attention) is VoxelAttention for attention in attentions)
        # In training on a GPU for all layers together; a prediction keeps those of one layer in memory.
        if is_plain and torch.is_grad_enabled() and not memory.is_cpu:
            return keys_and_values_together(attentions, memory)
        return [memory] * len(attentions)

    def _encode_positions(self, points: Tensor) -> Tensor:
        """Return the code ``(..., C)`` of points ``(..., 3)``, metres from the centre of the volume."""
        return self.position(position_code(points, self.grid_extent, self.position.in_features))


class CenterRefinement(nn.Module):
    """The next layer starts from the predicted centre; size and yaw are predicted anew."""

    def forward(self, start: Queries, objects: RawObjects, grid_center: Tensor) -> Queries:
        """Return what the next layer starts from.

        Args:
            start: what the layer started from.
            objects: what it predicts.
            grid_center: ``(B, 3)`` metres.
        """
        return start._replace(reference=objects.center - grid_center[:, None])


class _Place(NamedTuple):
    """What a layer predicts first.

    Attributes:
        embedding: ``(B, Q, C)`` normalised.
        reference: ``(B, Q, 3)`` box centres, metres from the centre of the volume.
    """

    embedding: Tensor
    reference: Tensor


class ObjectPredictor(nn.Module):
    """Class and pose of each query, one small network each.

    Args:
        channels: C of the queries.
        num_classes: K.
    """

    class_layers = ("category",)

    def __init__(self, *, channels: int, num_classes: int) -> None:
        super().__init__()
        self.norm = LayerNorm(channels)
        self.category = nn.Linear(channels, num_classes + 1)
        self.offset = _perceptron(channels, 3)
        self.log_size = _perceptron(channels, 3)
        self.yaw = _perceptron(channels, 2)

    def place(self, embedding: Tensor, reference: Tensor) -> _Place:
        """Return where the objects of query embeddings ``(B, Q, C)`` stand, near the reference points."""
        embedding = self.norm(embedding)
        return _Place(embedding, reference + self.offset(embedding))

    def forward(self, embedding: Tensor, start: Queries, grid_center: Tensor) -> RawObjects:
        """Return the predictions for query embeddings ``(B, Q, C)``, added to the boxes of ``start``.

        Pose is float32 even under autocast, because ``start`` is: 16 bits resolve a centre at 4 m to no
        better than millimetres.
        """
        embedding = self.norm(embedding)
        return RawObjects(
            class_logits=self.category(embedding).float(),
            center=start.reference + self.offset(embedding) + grid_center[:, None],
            log_size=start.log_size + self.log_size(embedding),
            yaw_vector=start.yaw_vector + self.yaw(embedding),
            embedding=embedding,
        )


def predict_together(
    predictors: Sequence[Any], places: Sequence[_Place], start: Queries, grid_center: Tensor
) -> tuple[RawObjects, ...]:
    """Return what the predictors of all layers predict, as they do one by one.

    Args:
        predictors: an ``ObjectPredictor`` for each of L layers.
        places: what they have predicted.
        start: sizes and yaws that all layers start from.
        grid_center: ``(B, 3)`` metres.
    """
    embeddings = torch.stack([place.embedding for place in places])
    read = embeddings.flatten(1, 2)

    def predicted(name: str) -> Tensor:
        perceptrons = [getattr(one, name) for one in predictors]
        hidden = F.gelu(_apply_each([one[0] for one in perceptrons], read))
        return _apply_each([one[2] for one in perceptrons], hidden).unflatten(1, scenes)

    scenes = start.reference.shape[:2]
    logits = _apply_each([one.category for one in predictors], read).float().unflatten(1, scenes)
    center = torch.stack([place.reference for place in places]) + grid_center[:, None]
    log_size, yaw_vector = start.log_size + predicted("log_size"), start.yaw_vector + predicted("yaw")
    return tuple(map(RawObjects, logits, center, log_size, yaw_vector, embeddings))


def _apply_each(layers: Sequence[nn.Linear], x: Tensor) -> Tensor:
    """Return what L linear layers make each of its own input, ``(L, n, C)`` → ``(L, n, outputs)``."""
    weight, bias = (torch.stack([getattr(one, name) for one in layers]) for name in ("weight", "bias"))
    # The weights first, so that their gradients come out as they lie.
    return torch.baddbmm(bias[..., None], weight, x.mT).mT


def _perceptron(channels: int, outputs: int) -> nn.Sequential:
    """Return a network of one hidden layer whose output is close to zero before training."""
    last = nn.Linear(channels, outputs)
    nn.init.normal_(last.weight, std=0.01)
    nn.init.zeros_(last.bias)
    return nn.Sequential(nn.Linear(channels, channels), nn.GELU(), last)


def objects_of_queries(
    raw: RawObjects,
    scene: int,
    *,
    score_threshold: float = 0.0,
    classes: Classes = PAPER_CLASSES,
    score_scaling: ScoreScaling | None = None,
) -> tuple[ObjectSet, Tensor]:
    """Return one scene's objects, highest score first, and their embeddings.

    Args:
        raw: one decoder layer's output for B scenes.
        scene: which of them.
        score_threshold: queries with a lower score are left out.
        classes: what the network's K outputs before padding stand for.
        score_scaling: from the probability of the best class to the score; None: they are one.

    Returns:
        M objects without shapes, and ``(M, C)`` embeddings.
    """
    probability = raw.class_logits[scene].softmax(dim=-1)[:, :-1]
    score, label = probability.max(dim=-1)
    order = score.argsort(descending=True, stable=True)
    if score_scaling is not None:
        score = score_scaling(score)
    order = order[score[order] >= score_threshold]
    sin, cos = raw.yaw_vector[scene, order].unbind(dim=-1)
    objects = ObjectSet(
        label=label[order],
        center=raw.center[scene, order],
        size=raw.log_size[scene, order].exp(),
        rotation=rotation_from_yaw(torch.atan2(sin, cos)),
        symmetry=torch.ones_like(label[order]),
        score=score[order],
        classes=classes,
    )
    return objects, raw.embedding[scene, order]
