# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import fields
from typing import Any

import pytest
import torch

from raytran.classes import PAPER_CLASSES
from raytran.errors import ConfigError
from raytran.extensions.denoising import (
    CENTER_NOISE,
    SIZE_NOISE,
    WRONG_CLASS,
    YAW_NOISE,
    DenoisingObjectHead,
    NoisyCopies,
    attention_mask,
    denoising_losses,
)
from raytran.extensions.proposal_queries import ProposalQueries
from raytran.extensions.windowed_attention import WindowedAttention
from raytran.geometry.grid import VoxelGrid
from raytran.geometry.rotation import rotation_from_yaw
from raytran.heads.objects import LearnedQueries, ObjectHead, Queries
from raytran.losses.objects import Betas
from raytran.structs import ObjectSet, RawObjects

EXTENT = (4.0, 4.0, 2.0)
GRID = VoxelGrid((4, 4, 2), EXTENT, torch.tensor([[0.0, 0, 0], [5.0, 0, 0]]))
YAW = torch.tensor([0.0, 1.0, -2.0])


def truth() -> tuple[ObjectSet, ObjectSet]:
    """Three objects in the first scene, none in the second."""
    some = ObjectSet(
        label=torch.tensor([3, 6, 0]),
        center=torch.tensor([[1.0, 0, 0], [0, 1, 0], [-1, -1, 0.2]]),
        size=torch.tensor([[1.0, 0.5, 2.0], [0.5, 0.5, 0.5], [2.0, 1.0, 0.4]]),
        rotation=rotation_from_yaw(YAW),
        symmetry=torch.ones(3, dtype=torch.int64),
        score=torch.ones(3),
    )
    return some, ObjectSet.empty()


def copies_beside(kind: str, num_copies: int = 300) -> tuple[NoisyCopies, Queries]:
    torch.manual_seed(0)
    queries = (
        LearnedQueries(channels=8, num_queries=5, extent=EXTENT)
        if kind == "learned"
        else ProposalQueries(channels=8, num_queries=5)
    )
    network = NoisyCopies(channels=8, num_copies=num_copies, num_classes=len(PAPER_CLASSES))
    return network, network(truth(), queries(torch.randn(2, 4, 4, 2, 8), GRID), GRID)


@pytest.mark.parametrize("kind", ["learned", "proposal"])
def test_copies_lie_in_the_boxes_of_their_objects(kind: str) -> None:
    objects, _ = truth()
    _, copies = copies_beside(kind)
    which = torch.arange(300) % 3
    in_object = (
        objects.rotation[which].transpose(1, 2) @ (copies.reference[0] - objects.center[which])[..., None]
    )
    share = in_object.squeeze(-1).abs() / objects.size[which]
    assert share.max() <= CENTER_NOISE + 1e-5
    assert share.amax(dim=0).min() > 0.9 * CENTER_NOISE  # all of the box is reached
    assert torch.equal(copies.reference[1], torch.zeros(300, 3))  # nothing is known there: in the middle


def test_copies_beside_learned_queries_start_as_those_do() -> None:
    _, copies = copies_beside("learned")
    torch.testing.assert_close(copies.log_size.exp(), torch.full((2, 300, 3), 0.7))
    assert torch.equal(copies.yaw_vector, torch.tensor([0.0, 1.0]).expand(2, 300, 2))


def test_copies_beside_proposals_start_near_the_truth() -> None:
    objects, _ = truth()
    _, copies = copies_beside("proposal")
    which = torch.arange(300) % 3
    size_error = (copies.log_size[0] - objects.size[which].log()).abs()
    yaw_error = torch.atan2(*copies.yaw_vector[0].unbind(-1)) - YAW[which]
    yaw_error = torch.atan2(yaw_error.sin(), yaw_error.cos()).abs()
    for error, noise in ((size_error, SIZE_NOISE), (yaw_error, YAW_NOISE)):
        assert 0.9 * noise < error.max() <= noise + 1e-5


def test_some_copies_are_told_a_wrong_class() -> None:
    network, copies = copies_beside("learned", num_copies=3000)
    true = network.embedding[truth()[0].label[torch.arange(3000) % 3]]
    wrong = (copies.embedding[0] != true).any(dim=-1).float().mean()
    assert float(wrong) == pytest.approx(
        WRONG_CLASS * 8 / 9, abs=0.03
    )  # a ninth is told the right one by chance


def test_who_attends_to_whom() -> None:
    mask = attention_mask(2, 3, torch.device("cpu"))
    allowed = torch.tensor(
        [[1, 1, 0, 0, 0], [1, 1, 0, 0, 0], [1, 1, 1, 0, 0], [1, 1, 0, 1, 0], [1, 1, 0, 0, 1]]
    )
    assert torch.equal(~mask, allowed.bool())


def small_head(num_copies: int = 4, queries: str = "learned") -> ObjectHead:
    torch.manual_seed(0)
    settings: dict[str, Any] = {
        "channels": 24,
        "num_heads": 2,
        "num_layers": 2,
        "num_queries": 6,
        "hidden": 24,
        "voxel_attention": WindowedAttention,
        "queries": ProposalQueries if queries == "proposal" else None,
        "grid_extent": EXTENT,
    }
    return DenoisingObjectHead(num_copies=num_copies, **settings) if num_copies else ObjectHead(**settings)


@pytest.mark.parametrize("queries", ["learned", "proposal"])
def test_copies_change_nothing_of_the_queries(queries: str) -> None:
    head, voxels = small_head(queries=queries), torch.randn(2, 4, 4, 2, 24)
    with torch.no_grad():
        alone = head(voxels, GRID).layers
        beside = head(voxels, GRID, truth())
    assert [layer.center.shape for layer in beside.denoising] == [(2, 4, 3)] * 2
    for one, other in zip(alone, beside.layers, strict=True):
        torch.testing.assert_close(one.class_logits, other.class_logits)
        torch.testing.assert_close(one.center, other.center)


def test_a_head_with_copies_starts_from_the_same_weights() -> None:
    without, with_copies = small_head(0).state_dict(), small_head().state_dict()
    assert set(with_copies) - set(without) == {"denoising_queries.embedding"}
    assert all(torch.equal(value, with_copies[name]) for name, value in without.items())


def test_copies_are_made_in_training_alone() -> None:
    voxels = torch.randn(2, 4, 4, 2, 24)
    assert small_head()(voxels, GRID, truth()).denoising is not None
    assert small_head().eval()(voxels, GRID, truth()).denoising is None
    assert small_head(0)(voxels, GRID, truth()).denoising is None
    with pytest.raises(ConfigError, match="1 or more, got 0"):
        DenoisingObjectHead(num_copies=0)


def repeated(objects: ObjectSet, make_perfect, count: int) -> RawObjects:
    """Perfect predictions for ``count`` copies of the objects, one after the other."""
    index = torch.arange(count) % len(objects)
    return make_perfect(objects.select(index), torch.arange(count), count)


def scenes(*parts: RawObjects) -> RawObjects:
    return RawObjects(*(torch.cat([getattr(p, f.name) for p in parts]) for f in fields(parts[0])))


def test_copies_that_became_their_objects_cost_nothing(make_objects, make_perfect) -> None:
    objects = make_objects(3)
    perfect = repeated(objects, make_perfect, 7)
    losses = denoising_losses([perfect, perfect], [objects], betas=Betas())
    assert set(losses) == {"class", "center", "size", "yaw"}
    assert all(float(value.detach()) == pytest.approx(0.0, abs=1e-5) for value in losses.values())


def test_terms_are_means_over_slots_and_sums_over_layers(make_objects, make_perfect) -> None:
    """All copies are 1 m off along one axis: smooth L1 0.95 in each of two layers."""
    objects = make_objects(2)
    off = repeated(objects, make_perfect, 6)
    off.center.data[..., 0] += 1.0
    losses = denoising_losses([off, off], [objects], betas=Betas())
    assert float(losses["center"].detach()) == pytest.approx(2 * 0.95)
    assert float(losses["size"].detach()) == pytest.approx(0.0, abs=1e-6)


def test_the_class_is_a_cross_entropy_over_slots(make_objects, make_perfect) -> None:
    objects = make_objects(2)
    raw = repeated(objects, make_perfect, 4)
    raw.class_logits.data.zero_()
    losses = denoising_losses([raw], [objects], betas=Betas())
    assert float(losses["class"].detach()) == pytest.approx(torch.tensor(10.0).log().item())


def test_scenes_without_objects_cost_nothing_but_count(make_objects, make_perfect) -> None:
    objects, none = make_objects(2), make_objects(0)
    off = repeated(objects, make_perfect, 4)
    off.center.data[..., 0] += 1.0
    raw = scenes(off, off)
    losses = denoising_losses([raw], [objects, none], betas=Betas())
    assert float(losses["center"].detach()) == pytest.approx(0.95 / 2)
    sum(losses.values()).backward()
    assert float(off.center.grad.abs().sum()) == pytest.approx(1 / 2, rel=1e-4)  # 4 slots, an eighth each


def test_even_nothing_has_a_gradient_for_every_rank(make_objects, make_perfect) -> None:
    raw = repeated(make_objects(1), make_perfect, 3)
    losses = denoising_losses([raw], [make_objects(0)], betas=Betas())
    total = sum(losses.values())
    assert float(total.detach()) == 0.0
    total.backward()
    for leaf in (raw.class_logits, raw.center, raw.log_size, raw.yaw_vector):
        assert not leaf.grad.any()
