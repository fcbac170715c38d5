# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import torch

from raytran.geometry.grid import VoxelGrid
from raytran.heads.objects import ObjectHead
from raytran.heads.queries import ProposalQueries

GRID = VoxelGrid((6, 5, 4), (3.0, 2.5, 2.0), torch.tensor([[10.0, 0, 1], [0.0, 20, 1]]))


def queries(num_queries: int = 3) -> ProposalQueries:
    torch.manual_seed(0)
    return ProposalQueries(channels=8, num_queries=num_queries)


def test_anchors_are_the_voxels_centres_and_untrained_boxes_stand_there() -> None:
    found = queries()(torch.randn(2, 6, 5, 4, 8), GRID).proposals
    assert found is not None
    torch.testing.assert_close(found.anchor, GRID.voxel_centers())
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
    found = module(voxels, GRID)
    assert found.proposals is not None
    chosen = module._peaks(found.proposals.class_logits)
    for scene in range(2):
        center = found.proposals.center[scene].flatten(0, 2)[chosen[scene]]
        torch.testing.assert_close(found.reference[scene] + GRID.center[scene], center)
        sizes = found.proposals.log_size[scene].flatten(0, 2)[chosen[scene]]
        torch.testing.assert_close(found.log_size[scene], sizes)


def test_proposals_move_with_the_grid() -> None:
    module, voxels = queries(), torch.randn(1, 6, 5, 4, 8)
    here, there = (
        module(voxels, VoxelGrid(GRID.resolution, GRID.extent, center)) for center in GRID.center[:, None]
    )
    torch.testing.assert_close(here.reference, there.reference)


def test_the_decoder_refines_what_is_proposed_and_sends_it_no_gradient() -> None:
    torch.manual_seed(0)
    head = ObjectHead(
        channels=8,
        num_heads=2,
        num_layers=2,
        num_queries=4,
        queries="proposal",
        hidden=8,
        grid_extent=GRID.extent,
    )
    layers, proposals = head(torch.randn(2, 6, 5, 4, 8), GRID)
    assert proposals is not None
    assert len(layers) == 2
    assert layers[-1].center.shape == (2, 4, 3)
    chosen = head.queries._peaks(proposals.class_logits)
    started = proposals.center.flatten(1, 3).gather(1, chosen[..., None].expand(-1, -1, 3))
    assert float((layers[0].center - started).detach().abs().max()) < 0.1
    layers[-1].center.sum().backward()
    assert head.queries.pose.weight.grad is None
    assert head.queries.convolution.weight.grad is not None
