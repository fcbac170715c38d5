# SPDX-License-Identifier: Apache-2.0
"""One volume for a room that fits, several for one that does not."""

from __future__ import annotations

import math

import pytest
import torch

from raytran.errors import DataError
from raytran.geometry.camera import Cameras
from raytran.geometry.room_tiles import AHEAD, BESIDE, OVERLAP, Volumes, cover, places_ahead

RESOLUTION, EXTENT = (48, 48, 16), (9.0, 9.0, 3.5)
VOXEL = torch.tensor([9 / 48, 9 / 48, 3.5 / 16], dtype=torch.float64)


def walk(positions, *, heading_deg=0.0) -> Cameras:
    """Level cameras at some places, all looking the same way; 0° is along +x."""
    positions = torch.as_tensor(positions, dtype=torch.float64)
    angle = math.radians(heading_deg)
    pose = torch.eye(4, dtype=torch.float64).repeat(len(positions), 1, 1)
    forward = torch.tensor([math.cos(angle), math.sin(angle), 0.0], dtype=torch.float64)
    down = torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64)
    pose[:, :3, :3] = torch.stack([torch.linalg.cross(down, forward), down, forward], dim=1)
    pose[:, :3, 3] = positions
    intrinsics = torch.tensor([[60.0, 0, 32], [0, 60, 24], [0, 0, 1]], dtype=torch.float64)
    return Cameras(intrinsics.expand(len(positions), 3, 3), pose, (48, 64))


def line(start, stop, count=20) -> torch.Tensor:
    share = torch.linspace(0, 1, count, dtype=torch.float64)[:, None]
    return torch.tensor(start) + share * (torch.tensor(stop) - torch.tensor(start))


def test_a_room_that_fits_has_one_volume_on_the_mean_camera():
    cameras = walk(line([0.0, 1.0, 1.5], [5.0, 2.0, 1.7]), heading_deg=90)
    volumes, members = cover(cameras, resolution=RESOLUTION, extent=EXTENT)
    torch.testing.assert_close(volumes.center[0], cameras.position.mean(dim=0), rtol=0, atol=1e-12)
    assert members.shape == (1, 20)
    assert members.all()
    joint = volumes.joint()
    assert joint.resolution == RESOLUTION
    assert joint.extent == EXTENT
    assert torch.equal(joint.center, volumes.center[0])


def test_one_volume_is_moved_as_little_as_it_takes():
    # Most cameras stand at one end of 7 m, looking across.
    positions = torch.cat(
        [line([0.0, 0.0, 1.5], [0.5, 0.0, 1.5], 40), line([0.5, 0.0, 1.5], [7.0, 0.0, 1.5])]
    )
    cameras = walk(positions, heading_deg=90)
    assert cameras.position.mean(dim=0)[0] < 2.5
    volumes, _ = cover(cameras, resolution=RESOLUTION, extent=EXTENT)
    assert volumes.center.tolist() == [pytest.approx([2.5, 0.0, 1.5])]


@pytest.mark.parametrize(("length", "count"), [(7.4, 1), (7.6, 2), (13.9, 2), (14.1, 3), (40.0, 6)])
def test_a_corridor_is_covered_by_as_few_volumes_as_overlap_enough(length, count):
    cameras = walk(line([0.0, 0.0, 1.5], [length, 0.0, 1.5], 200))  # looking along it
    volumes, members = cover(cameras, resolution=RESOLUTION, extent=EXTENT)
    assert len(volumes) == count
    points = torch.cat([cameras.position, places_ahead(cameras)])
    beside = BESIDE * (count > 1) * torch.tensor([[1.0, 0, 0], [-1.0, 0, 0]], dtype=torch.float64)
    assert all(volumes.holds(points + to_side).any(dim=1).all() for to_side in beside)
    assert torch.equal(members, volumes.holds(points).view(2, 200, count).any(dim=0).T)
    centers = volumes.center.sort(dim=0).values
    assert (9.0 - centers.diff(dim=0)[:, 0] >= OVERLAP - 1e-9).all()
    # Whole voxels apart, so that the voxels of all are those of the joint grid.
    steps = (volumes.center - volumes.center[0]) / VOXEL
    torch.testing.assert_close(steps, steps.round(), rtol=0, atol=1e-9)
    joint, corner = volumes.joint(), volumes.corner_index()
    for index in range(count):
        own = volumes.center[index] - torch.tensor(EXTENT, dtype=torch.float64) / 2
        torch.testing.assert_close(joint.lower + corner[index] * VOXEL, own, rtol=0, atol=1e-9)
    assert joint.resolution[0] == corner[:, 0].max() + 48
    assert joint.resolution[1:] == RESOLUTION[1:]


def test_volumes_that_no_camera_needs_are_left_out():
    legs = [line([0.0, 0.0, 1.5], [14.0, 0.0, 1.5], 60), line([14.0, 0.0, 1.5], [14.0, 14.0, 1.5], 60)]
    volumes, members = cover(walk(torch.cat(legs)), resolution=RESOLUTION, extent=EXTENT)
    assert len(volumes) < 2 * 2 + 1
    corners = (volumes.center[:, 0] < 7) & (volumes.center[:, 1] > 7)
    assert not corners.any()  # inside of the L stands no camera
    assert (members.sum(dim=1) >= 2).all()
    assert members.any(dim=0).all()


def test_points_belong_to_the_volume_whose_middle_is_nearest():
    center = torch.tensor([[0.0, 0, 0], [7.5, 0, 0]], dtype=torch.float64)
    volumes = Volumes(RESOLUTION, EXTENT, center)
    # Just above the floor every volume's nearest side is the floor: that must not decide.
    points = torch.tensor([[3.7, 0, -1.7], [3.8, 0, -1.7], [-20.0, 0, 0], [20.0, 0, 0], [4.4, 4.0, 0]])
    assert volumes.owner(points).tolist() == [0, 1, 0, 1, 1]
    assert volumes.holds(points).tolist() == [[True, True]] * 2 + [[False, False]] * 2 + [[True, True]]
    # One that only the farther volume holds is its.
    tall = Volumes((4, 4, 4), (2.0, 2.0, 8.0), torch.tensor([[0.0, 0, 0], [1.0, 0, 4.0]]))
    assert tall.owner(torch.tensor([[1.9, 0.0, 0.5]])).tolist() == [1]


def test_floors_too_far_apart_for_one_volume_are_two():
    floors = [line([0.0, 0.0, z], [3.0, 0.0, z]) for z in (1.5, 4.5)]
    volumes, _ = cover(
        walk(torch.cat([*floors, line([3.0, 0, 1.5], [3.0, 0, 4.5])])), resolution=RESOLUTION, extent=EXTENT
    )
    assert len(volumes) == 1  # 3 m fit into 3.5 m
    higher = torch.cat([floors[0], line([0.0, 0.0, 6.0], [3.0, 0.0, 6.0])])
    volumes, members = cover(walk(higher), resolution=RESOLUTION, extent=EXTENT)
    assert len(volumes) == 2
    assert members.sum(dim=1).tolist() == [20, 20]


def test_positions_that_cannot_be_metres_are_refused_at_once():
    with pytest.raises(
        DataError,
        match=r"cameras of hall see 5e\+12 x 0 x 0 m.*more than 256 volumes of 9 x 9 x 3.5 m: give scale=",
    ):
        cover(walk([[0.0, 0, 0], [5e12, 0, 0]]), resolution=RESOLUTION, extent=EXTENT, name="hall")


def test_places_ahead():
    cameras = walk([[1.0, 2.0, 1.5]], heading_deg=90)
    assert places_ahead(cameras)[0].tolist() == pytest.approx([1.0, 2.0 + AHEAD, 1.5])
