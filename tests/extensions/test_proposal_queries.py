# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import math
from collections.abc import Callable

import pytest
import torch

from raytran.extensions.proposal_queries import SPREAD, ProposalQueries, center_heat, proposal_losses
from raytran.geometry.grid import VoxelGrid
from raytran.geometry.rotation import rotation_from_yaw
from raytran.heads.objects import ObjectHead
from raytran.losses.objects import Betas
from raytran.structs import ObjectSet, RawProposals

GRID = VoxelGrid((4, 4, 4), (2.0, 2.0, 2.0), torch.zeros(1, 3))


def objects(*centers: list[float]) -> ObjectSet:
    count = len(centers)
    return ObjectSet(
        label=torch.arange(count) % 9,
        center=torch.tensor(centers).reshape(-1, 3),
        size=torch.full((count, 3), 0.5),
        rotation=rotation_from_yaw(torch.full((count,), 0.3)),
        symmetry=torch.ones(count, dtype=torch.int64),
        score=torch.ones(count),
    )


def perfect(found: ObjectSet) -> RawProposals:
    """Proposals that say at every voxel what the nearest object is."""
    anchor = GRID.voxel_centers()
    nearest = (anchor[..., None, :] - found.center).norm(dim=-1).argmin(dim=-1)
    logits = torch.full((*anchor.shape[:-1], 9), -30.0)
    for heat, label in zip(center_heat(anchor[0], found), found.label.tolist(), strict=True):
        logits[0, ..., label].view(-1)[heat == 1] = 30.0
    yaw = torch.tensor([math.sin(0.3), math.cos(0.3)])
    return RawProposals(
        anchor, logits, found.center[nearest], found.size.log()[nearest], yaw.expand(*anchor.shape[:-1], 2)
    )


def test_heat_is_one_where_the_centre_lies_and_a_gaussian_around() -> None:
    heat = center_heat(GRID.voxel_centers()[0], objects([0.3, 0.2, -0.1])).reshape(4, 4, 4)
    assert float(heat[2, 2, 1]) == 1.0
    # Voxel (3, 2, 1) is centred at (0.75, 0.25, -0.25), half a metre a voxel.
    distance = torch.tensor([0.45, 0.05, -0.15]) / 0.5
    expected = math.exp(-float(distance.square().sum()) / (2 * SPREAD**2))
    assert float(heat[3, 2, 1]) == pytest.approx(expected, rel=1e-5)
    assert float(center_heat(GRID.voxel_centers()[0], objects([1.2, 0.0, 0.0])).max()) == 0.0


def test_perfect_proposals_cost_nothing_and_wrong_ones_their_error() -> None:
    found = objects([0.3, 0.2, -0.1], [-0.6, -0.7, 0.4])
    best = perfect(found)
    losses = proposal_losses(best, [found], num_objects=torch.tensor(2.0), betas=Betas())
    assert all(float(value) < 1e-5 for value in losses.values())
    moved = RawProposals(best.anchor, best.class_logits, best.center + 0.5, best.log_size, best.yaw_vector)
    # Smooth L1 beyond 0.1 m: error minus half of that, over three axes, mean over objects.
    shifted = proposal_losses(moved, [found], num_objects=torch.tensor(2.0), betas=Betas())
    assert float(shifted["center"]) == pytest.approx(3 * 0.45, rel=1e-5)


def test_heat_loss_punishes_missed_centres_and_false_ones() -> None:
    found = objects([0.3, 0.2, -0.1])
    best = perfect(found)

    def heat_loss(change: Callable[[torch.Tensor], None]) -> float:
        logits = best.class_logits.clone()
        change(logits)
        raw = RawProposals(best.anchor, logits, best.center, best.log_size, best.yaw_vector)
        return float(proposal_losses(raw, [found], num_objects=torch.tensor(1.0), betas=Betas())["heat"])

    assert heat_loss(lambda logits: logits[0, 2, 2, 1, 0].fill_(-5.0)) == pytest.approx(5.0, rel=0.02)
    far = heat_loss(lambda logits: logits[0, 0, 0, 3, 0].fill_(5.0))
    near = heat_loss(lambda logits: logits[0, 3, 2, 1, 0].fill_(5.0))
    assert far == pytest.approx(5.0, rel=0.02)
    assert near < 0.5 * far
    assert heat_loss(lambda logits: logits[0, 2, 2, 1, 4].fill_(5.0)) == pytest.approx(5.0, rel=0.02)


def test_a_box_is_learned_at_the_centre_and_at_the_voxels_beside_it() -> None:
    """Heat is 0.36 a voxel away and 0.13 across an edge: above and below what a voxel must have."""
    found = objects([0.25, 0.25, -0.25])  # the middle of voxel (2, 2, 1)
    raw = perfect(found)
    center = (raw.center + 0.5).requires_grad_()
    moved = RawProposals(raw.anchor, raw.class_logits, center, raw.log_size, raw.yaw_vector)
    proposal_losses(moved, [found], num_objects=torch.tensor(1.0), betas=Betas())["center"].backward()
    learns = (center.grad[0] != 0).all(dim=-1)
    distance = (raw.anchor[0] - found.center[0]).norm(dim=-1) / 0.5
    assert int(learns.sum()) == 7
    assert torch.equal(learns, distance < 1.2)
    # The gradient of smooth L1 is the voxel's weight there: its heat, all of an object's summing to one.
    heat = torch.exp(-distance.square() / (2 * SPREAD**2)) * learns
    torch.testing.assert_close(center.grad[0, ..., 0], heat / heat.sum())


def test_a_scene_without_objects_still_reaches_every_output() -> None:
    raw = perfect(objects([0.0, 0.0, 0.0]))
    leaves = [value.clone().requires_grad_() for value in (raw.class_logits, raw.center)]
    losses = proposal_losses(
        RawProposals(raw.anchor, leaves[0], leaves[1], raw.log_size, raw.yaw_vector),
        [objects()],
        num_objects=torch.tensor(1.0),
        betas=Betas(),
    )
    sum(losses.values()).backward()
    assert all(leaf.grad is not None for leaf in leaves)


QUERY_GRID = VoxelGrid((6, 5, 4), (3.0, 2.5, 2.0), torch.tensor([[10.0, 0, 1], [0.0, 20, 1]]))


def queries(num_queries: int = 3) -> ProposalQueries:
    torch.manual_seed(0)
    return ProposalQueries(channels=8, num_queries=num_queries)


def test_anchors_are_the_voxels_centres_and_untrained_boxes_stand_there() -> None:
    found = queries()(torch.randn(2, 6, 5, 4, 8), QUERY_GRID).proposals
    assert found is not None
    torch.testing.assert_close(found.anchor, QUERY_GRID.voxel_centers())
    assert float((found.center - found.anchor).detach().abs().max()) < 0.2
    assert float(found.class_logits.detach().sigmoid().mean()) < 0.1
    assert found.log_size.shape == (2, 6, 5, 4, 3)
    assert found.yaw_vector.shape == (2, 6, 5, 4, 2)


def test_queries_are_the_highest_local_maxima() -> None:
    # Falling from the first voxel to the last, so that there are no maxima but those set below.
    heat = (-9 - 0.01 * torch.arange(120.0)).view(1, 6, 5, 4, 1).repeat(1, 1, 1, 1, 9)
    peaks = {(0, 0, 0): 3.0, (3, 2, 1): 5.0, (5, 4, 3): 1.0}
    for place, value in peaks.items():
        heat[0][place][hash(place) % 9] = value
    heat[0, 3, 2, 2, 0] = 4.9  # beside a higher one: no maximum, though higher than the two others
    chosen = queries()._peaks(heat)
    wanted = [(x * 5 + y) * 4 + z for x, y, z in ((3, 2, 1), (0, 0, 0), (5, 4, 3))]
    assert chosen.tolist() == [wanted]
    # Other voxels fill up, the likelier first.
    assert queries(4)._peaks(heat).tolist() == [[*wanted, (3 * 5 + 2) * 4 + 2]]
    assert queries(999)._peaks(heat).shape == (1, 120)


def test_a_query_starts_from_what_its_voxel_says() -> None:
    module, voxels = queries(), torch.randn(2, 6, 5, 4, 8)
    found = module(voxels, QUERY_GRID)
    assert found.proposals is not None
    chosen = module._peaks(found.proposals.class_logits)
    for scene in range(2):
        center = found.proposals.center[scene].flatten(0, 2)[chosen[scene]]
        torch.testing.assert_close(found.reference[scene] + QUERY_GRID.center[scene], center)
        sizes = found.proposals.log_size[scene].flatten(0, 2)[chosen[scene]]
        torch.testing.assert_close(found.log_size[scene], sizes)


def test_proposals_move_with_the_grid() -> None:
    module, voxels = queries(), torch.randn(1, 6, 5, 4, 8)
    here, there = (
        module(voxels, VoxelGrid(QUERY_GRID.resolution, QUERY_GRID.extent, center))
        for center in QUERY_GRID.center[:, None]
    )
    torch.testing.assert_close(here.reference, there.reference)


def test_the_decoder_refines_what_is_proposed_and_sends_it_no_gradient() -> None:
    torch.manual_seed(0)
    head = ObjectHead(
        channels=8,
        num_heads=2,
        num_layers=2,
        num_queries=4,
        queries=ProposalQueries,
        hidden=8,
        grid_extent=QUERY_GRID.extent,
    )
    layers, proposals, _ = head(torch.randn(2, 6, 5, 4, 8), QUERY_GRID)
    assert proposals is not None
    assert len(layers) == 2
    assert layers[-1].center.shape == (2, 4, 3)
    chosen = head.queries._peaks(proposals.class_logits)
    started = proposals.center.flatten(1, 3).gather(1, chosen[..., None].expand(-1, -1, 3))
    assert float((layers[0].center - started).detach().abs().max()) < 0.1
    layers[-1].center.sum().backward()
    assert head.queries.pose.weight.grad is None
    assert head.queries.convolution.weight.grad is not None
