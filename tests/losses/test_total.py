# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, replace
from typing import TypeVar

import pytest
import torch

from raytran.classes import PAPER_CLASSES
from raytran.errors import ConfigError, DataError
from raytran.extensions.denoising import DenoisingLoss
from raytran.extensions.proposal_queries import ProposalLoss, ProposalQueries
from raytran.extensions.windowed_attention import WindowedAttention
from raytran.geometry.grid import VoxelGrid
from raytran.heads.objects import ObjectHead
from raytran.losses.matcher import HungarianMatcher
from raytran.losses.objects import TrueObjects
from raytran.losses.total import TotalLoss
from raytran.structs import ObjectSet, RawObjects, RawProposals, RawScene, SceneBatch, Views

RawStruct = TypeVar("RawStruct", RawObjects, RawProposals)
WEIGHTS = {
    "occupancy": 1.0,
    "foreground": 0.5,
    "class": 1.0,
    "center": 2.0,
    "size": 3.0,
    "yaw": 4.0,
    "heat": 1.0,
    "view": 1.0,
    "shape": 5.0,
}
VIEWS = Views(torch.zeros(1, 1, 3, 4, 4), torch.eye(3)[None, None], torch.eye(4)[None, None])


def total_loss() -> TotalLoss:
    return TotalLoss(weights=WEIGHTS, matcher=HungarianMatcher(weights=WEIGHTS))


def batch(*objects: ObjectSet, **targets: torch.Tensor) -> SceneBatch:
    return SceneBatch(("a",), VIEWS, (("0",),), torch.zeros(1, 3), objects=objects, **targets)


def test_binary_terms_are_weighted() -> None:
    raw = RawScene(torch.zeros(1, 3), occupancy=torch.zeros(1, 2, 2, 2), foreground=torch.zeros(1, 1, 4, 4))
    targets = batch(occupancy=torch.ones(1, 2, 2, 2).bool(), foreground=torch.zeros(1, 1, 4, 4).bool())
    losses = total_loss()(raw, targets, terms=("occupancy", "foreground"))
    assert set(losses) == {"occupancy", "foreground", "total"}
    assert float(losses["occupancy"]) == float(losses["foreground"]) == pytest.approx(0.6931472)
    assert float(losses["total"]) == pytest.approx(1.5 * 0.6931472)


def test_perfect_predictions_cost_nothing_in_every_layer(make_objects, make_perfect) -> None:
    objects = make_objects(3)
    layers = tuple(make_perfect(objects, torch.tensor(s), 5) for s in ([0, 1, 2], [4, 0, 3]))
    losses = total_loss()(RawScene(torch.zeros(1, 3), objects=layers), batch(objects), terms=("objects",))
    names = [f"objects/{name}" for name in ("class", "center", "size", "yaw")]
    assert set(losses) == {*names, *(f"{name}/layer0" for name in names), "total"}
    assert float(losses["total"].detach()) == pytest.approx(0.0, abs=1e-5)


def test_pose_terms_are_means_over_objects(make_objects, make_perfect) -> None:
    """Both objects 1 m off along one axis: smooth L1 0.95 each, whatever their number."""
    objects = make_objects(2)
    raw = make_perfect(objects, torch.tensor([1, 3]), 4)
    raw.center.data[..., 0] += 1.0
    scene = RawScene(torch.zeros(1, 3), objects=(raw,))
    assert float(total_loss()(scene, batch(objects), terms=("objects",))["objects/center"]) == pytest.approx(
        0.95
    )


@pytest.mark.parametrize("padding", [0.1, 1.0, 0.0])
def test_class_term_is_the_weighted_mean_over_all_slots(padding, make_objects) -> None:
    """As torch's own mean with class weights: by the total weight of matched and of empty queries."""
    scenes = [make_objects(count, seed) for seed, count in enumerate((2, 1))]
    g = torch.Generator().manual_seed(5)
    raw = RawObjects(*(torch.randn(2, 5, size, generator=g) for size in (10, 3, 3, 2, 4)))
    matcher = HungarianMatcher(weights=WEIGHTS)
    loss = TotalLoss(weights=WEIGHTS, matcher=matcher, no_object_weight=padding)
    label = torch.full((2, 5), len(PAPER_CLASSES))
    true = TrueObjects.of(*scenes)
    match = matcher(RawObjects.stack([raw]), true, [len(objects) for objects in scenes])
    label.view(-1)[match.query[0]] = true.label[match.target[0]]
    weight = torch.ones(len(PAPER_CLASSES) + 1)
    weight[len(PAPER_CLASSES)] = padding
    expected = torch.nn.functional.cross_entropy(
        raw.class_logits.flatten(0, 1), label.flatten(), weight=weight
    )
    found = loss(RawScene(torch.zeros(2, 3), objects=(raw,)), batch(*scenes), terms=("objects",))
    torch.testing.assert_close(found["objects/class"], expected)


def join(*parts: RawStruct) -> RawStruct:
    return type(parts[0])(*(torch.cat([getattr(p, f.name) for p in parts]) for f in fields(parts[0])))


@pytest.mark.parametrize("counts", [(3, 1), (2, 0), (1, 0), (0, 0), (6, 2)])
def test_ranks_of_one_scene_take_the_step_of_one_rank(counts, make_objects) -> None:
    """Sums over objects and queries have one divisor for all ranks: the mean over ranks is the whole."""
    scenes = [make_objects(count, seed) for seed, count in enumerate(counts)]
    g = torch.Generator().manual_seed(5)
    raws = [RawObjects(*(torch.randn(1, 4, size, generator=g) for size in (10, 3, 3, 2, 4))) for _ in counts]
    decode = torch.nn.Sequential(torch.nn.Linear(4, 125), torch.nn.Unflatten(1, (5, 5, 5)))
    loss, options = total_loss(), {"terms": ("objects", "shape"), "decode_shapes": decode}
    voxels = [
        RawProposals(*(torch.randn(1, 3, 3, 3, size, generator=g) for size in (3, 9, 3, 3, 2)))
        for _ in counts
    ]
    joined = RawScene(torch.zeros(2, 3), objects=(join(*raws),), proposals=join(*voxels))
    whole = loss(joined, batch(*scenes), **options)

    asked = []  # what each rank has to divide by

    def collect(divisors: torch.Tensor) -> torch.Tensor:
        asked.append(divisors)
        return divisors

    def rank(index: int, mean: Callable[[torch.Tensor], torch.Tensor]) -> dict[str, torch.Tensor]:
        scene = RawScene(torch.zeros(1, 3), objects=(raws[index],), proposals=voxels[index])
        return loss(scene, batch(scenes[index]), mean_over_ranks=mean, **options)

    for index in range(2):
        rank(index, collect)
    mean = torch.stack(asked).mean(dim=0)
    ranks = [rank(index, lambda _: mean) for index in range(2)]
    for name, value in whole.items():
        assert float(value) == pytest.approx(sum(float(r[name]) for r in ranks) / 2, abs=1e-5), name


def test_everything_is_float32_under_autocast(make_objects) -> None:
    """16 bits in, the sum of float32 terms out; only the network's shape decoder sees autocast."""
    objects = make_objects(2)
    g = torch.Generator().manual_seed(5)
    half = [torch.randn(1, 4, size, generator=g).bfloat16() for size in (10, 3, 3, 2, 4)]
    raw = RawObjects(*half)
    exact = RawObjects(*(value.float() for value in half))
    grid, image = torch.randn(1, 2, 2, 2, generator=g), torch.randn(1, 1, 4, 4, generator=g)
    targets = batch(objects, occupancy=grid > 0, foreground=image > 0)
    seen = []

    def decode(embedding: torch.Tensor) -> torch.Tensor:
        seen.append((torch.is_autocast_enabled("cpu"), embedding.dtype))
        return torch.zeros(len(embedding), 5, 5, 5, dtype=embedding.dtype)

    options = {"terms": ("occupancy", "foreground", "objects", "shape"), "decode_shapes": decode}
    wanted = total_loss()(RawScene(torch.zeros(1, 3), grid, image, (exact,)), targets, **options)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        scene = RawScene(torch.zeros(1, 3), grid, image, (raw,))
        found = total_loss()(scene, targets, **options)
    assert seen == [(False, torch.float32), (True, torch.bfloat16)]
    assert {value.dtype for value in found.values()} == {torch.float32}
    assert {n: float(v) for n, v in found.items()} == {n: float(v) for n, v in wanted.items()}


def test_shape_is_decoded_for_matched_slots_only(make_objects, make_perfect) -> None:
    objects, queries = make_objects(2), torch.tensor([3, 1])
    asked = []

    def decode(embedding: torch.Tensor) -> torch.Tensor:
        asked.append(embedding[:, 0].tolist())
        wanted = objects.shape[(embedding[:, 0] == 1).long()]  # query 3 is object 0, query 1 is object 1
        return 40.0 * wanted.float() - 20.0

    scene = RawScene(torch.zeros(1, 3), objects=(make_perfect(objects, queries, 4),))
    losses = total_loss()(scene, batch(objects), terms=("shape",), decode_shapes=decode)
    assert sorted(asked[0]) == [1.0, 3.0]
    assert set(losses) == {"shape", "total"}
    assert float(losses["shape"]) == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("terms", [("shape",), ("objects", "shape")])
def test_all_layers_may_tell_shapes(make_objects, make_perfect, terms) -> None:
    """Each by its own matches: against sums of torch's own cross entropies over the right queries."""
    objects = make_objects(2)
    queries = [torch.tensor(of_layer) for of_layer in ([3, 1], [0, 2], [2, 3])]
    layers = tuple(make_perfect(objects, of_layer, 4) for of_layer in queries)
    decode = torch.nn.Sequential(torch.nn.Linear(4, 125), torch.nn.Unflatten(1, (5, 5, 5)))

    def losses(**options: str) -> dict[str, torch.Tensor]:
        loss = TotalLoss(weights=WEIGHTS, matcher=HungarianMatcher(weights=WEIGHTS), **options)
        scene = RawScene(torch.zeros(1, 3), objects=layers)
        return loss(scene, batch(objects), terms=terms, decode_shapes=decode)

    usual, every = losses(), losses(shape_layers="all")
    assert set(every) - set(usual) == {"shape/layer0", "shape/layer1"}
    assert all(torch.equal(every[name], value) for name, value in usual.items() if name != "total")
    for name, layer, of_layer in zip(("shape/layer0", "shape/layer1", "shape"), layers, queries, strict=True):
        expected = torch.nn.functional.binary_cross_entropy_with_logits(
            decode(layer.embedding[0, of_layer]), objects.shape.float()
        )
        torch.testing.assert_close(every[name], expected)
    added = WEIGHTS["shape"] * (every["shape/layer0"] + every["shape/layer1"])
    torch.testing.assert_close(every["total"], usual["total"] + added)
    with pytest.raises(ConfigError, match="unknown shape_layers=first: choose one of last, all"):
        losses(shape_layers="first")


def losses_of_all(**settings: float) -> TotalLoss:
    return TotalLoss(
        weights=WEIGHTS,
        matcher=HungarianMatcher(weights=WEIGHTS),
        extensions={"proposals": ProposalLoss(), "denoising": DenoisingLoss()},
        **settings,
    )


def test_betas_count_in_every_term_of_poses(make_objects, make_perfect) -> None:
    """Decoder layers, proposals and noisy copies, each 0.4 m off along one axis."""
    objects = make_objects(1)
    shift = torch.tensor([0.4, 0.0, 0.0])
    raw = make_perfect(objects, torch.tensor([0]), 2)
    raw = replace(raw, center=raw.center + shift)
    anchor = objects.center.expand(1, 3, 3, 3, 3) + torch.stack(
        torch.meshgrid(*[torch.arange(-1.0, 2.0)] * 3, indexing="ij"), dim=-1
    )
    yaw = raw.yaw_vector[:, :1]
    proposals = RawProposals(
        anchor,
        torch.zeros(1, 3, 3, 3, 9),
        (objects.center + shift).expand(1, 3, 3, 3, 3),
        objects.size.log().expand(1, 3, 3, 3, 3),
        yaw[0].expand(27, 2).reshape(1, 3, 3, 3, 2),
    )
    copy = make_perfect(objects, torch.tensor([0]), 1)
    copy = replace(copy, center=copy.center + shift)
    scene = RawScene(torch.zeros(1, 3), objects=(raw, raw), proposals=proposals, denoising=(copy,))
    for beta, expected in ((0.1, 0.35), (0.8, 0.1), (0.0, 0.4)):
        loss = losses_of_all(center_beta=beta)
        losses = loss(scene, batch(objects), terms=("objects",))
        for place in ("", "/layer0", "/proposals", "/denoising"):
            assert float(losses[f"objects/center{place}"].detach()) == pytest.approx(expected, rel=1e-4), (
                place
            )


@pytest.mark.parametrize("terms", [("objects",), ("objects", "shape")])
def test_no_objects_still_give_gradients(make_perfect, terms) -> None:
    raw = make_perfect(ObjectSet.empty(), torch.zeros(0, dtype=torch.long), 3)
    decode = torch.nn.Linear(4, 5)
    scene = RawScene(torch.zeros(1, 3), objects=(raw,))
    losses = total_loss()(scene, batch(ObjectSet.empty()), terms=terms, decode_shapes=decode)
    assert float(losses["objects/center"]) == 0.0
    losses["total"].backward()
    for leaf in (raw.class_logits, raw.center, raw.log_size, raw.yaw_vector):
        assert leaf.grad is not None
    assert (decode.weight.grad is not None) == ("shape" in terms)


def test_errors_say_what_is_missing(make_objects, make_perfect) -> None:
    with pytest.raises(ConfigError, match="weights"):
        TotalLoss(weights={"class": 1.0}, matcher=HungarianMatcher(weights=WEIGHTS))
    raw = RawScene(torch.zeros(1, 3), occupancy=torch.zeros(1, 2, 2, 2))
    with pytest.raises(DataError, match="add occupancy to the data set's targets"):
        total_loss()(raw, batch(), terms=("occupancy",))
    with pytest.raises(ConfigError, match="ask the network for it"):
        total_loss()(raw, batch(make_objects(1)), terms=("objects",))
    with pytest.raises(ConfigError, match="terms"):
        total_loss()(raw, batch(), terms=("objects", "depth"))


@pytest.mark.parametrize("queries", ["learned", "proposal"])
def test_a_small_decoder_overfits_two_scenes(make_objects, queries) -> None:
    """From voxel features that tell the scenes apart; centres within 10 cm after 150 steps."""
    torch.manual_seed(0)
    head = ObjectHead(
        channels=24,
        num_heads=2,
        num_layers=2,
        num_queries=8,
        queries=ProposalQueries if queries == "proposal" else None,
        hidden=48,
        voxel_attention=WindowedAttention,
        grid_extent=(5.0, 5.0, 5.0),
    )
    voxels = torch.randn(2, 4, 4, 4, 24)
    grid = VoxelGrid((4, 4, 4), (5.0, 5.0, 5.0), torch.zeros(2, 3))
    targets = batch(make_objects(3, 1), make_objects(2, 2))
    loss = losses_of_all()
    optimizer = torch.optim.AdamW(head.parameters(), lr=3e-3)
    history = []
    for _ in range(150):
        objects, proposals, _ = head(voxels, grid)
        raw = RawScene(grid.center, objects=objects, proposals=proposals)
        losses = loss(raw, targets, terms=("objects",))
        optimizer.zero_grad()
        losses["total"].backward()
        torch.nn.utils.clip_grad_norm_(head.parameters(), 1.0)
        optimizer.step()
        history.append({name: float(value.detach()) for name, value in losses.items()})
    assert history[-1]["total"] < 0.1 * history[0]["total"]
    assert history[-1]["objects/class"] < 0.05
    assert history[-1]["objects/center"] < 0.1
