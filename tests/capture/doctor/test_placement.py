# SPDX-License-Identifier: Apache-2.0
"""Boxes must be where rays end."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from raytran.capture.doctor.placement import ASTRAY, check_placement, weigh
from raytran.capture.doctor.sightings import Sightings
from raytran.geometry.rotation import rotation_from_yaw
from raytran.structs import ObjectSet

CENTERS = np.array([[2.0, 0.5, 0.5], [0.5, 2.0, 0.4], [-1.5, 0.3, 0.6], [0.2, -1.8, 0.5]])


def alignment(angle, x, y):
    turn = np.eye(4)
    turn[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    turn[:2, 3] = x, y
    return turn


ALIGNMENT = alignment(0.3, -1.1, 0.7)


@pytest.fixture
def objects():
    count = len(CENTERS)
    return replace(
        ObjectSet.empty(),
        label=torch.zeros(count, dtype=torch.int64),
        center=torch.tensor(CENTERS, dtype=torch.float32),
        size=torch.tensor([[0.8, 0.9, 0.6]]).expand(count, 3),
        rotation=rotation_from_yaw(torch.linspace(0, 2, count)),
        symmetry=torch.ones(count, dtype=torch.int64),
        score=torch.ones(count),
    )


@pytest.fixture
def room():
    """One camera at (0, 0, 1.5) with world axes; rays end at the objects' middles or on the floor."""
    rng = np.random.default_rng(1)
    at_objects = np.repeat(CENTERS, 50, axis=0) + rng.normal(0, 0.05, (200, 3))
    on_floor = np.c_[rng.uniform(-4, 4, (400, 2)), np.zeros(400)]
    way = np.concatenate([at_objects, on_floor]) - (0, 0, 1.5)
    poses = np.eye(4)[None].copy()
    poses[0, 2, 3] = 1.5
    return Sightings(np.zeros(600, dtype=np.int64), way, np.ones(600), "a test"), poses


def test_rays_are_counted_where_they_end(objects, room):
    sightings, poses = room
    evidence = weigh(sightings, poses, objects, np.eye(4))
    assert evidence.inside >= 200
    assert evidence.inside > 2 * evidence.through  # Some rays to the floor cross a box.
    behind = replace(sightings, depth=np.full(600, 3.0))
    assert weigh(behind, poses, objects, np.eye(4)).through >= 200
    away = weigh(sightings, poses, objects, alignment(0, 50, 0))
    assert (away.inside, away.through, away.score) == (0, 0, 0.0)


def test_boxes_in_place_are_right(objects, room):
    sightings, poses = room
    moved, finding = check_placement(sightings, poses, objects, ALIGNMENT)
    assert finding.state == "ok"
    np.testing.assert_array_equal(moved, np.eye(4))


@pytest.mark.parametrize(
    ("applied", "cause"),
    [
        (ALIGNMENT, "axisAlignment applied to one side only (the cameras)"),
        (ALIGNMENT @ ALIGNMENT, "axisAlignment applied twice (to the cameras)"),
        (np.linalg.inv(ALIGNMENT), "axisAlignment applied to one side only (the annotation)"),
        (alignment(np.pi / 2, 0, 0), "cameras and annotation are turned by -90° about +z to each other"),
    ],
)
def test_a_side_that_was_moved_is_named(objects, room, applied, cause):
    sightings, poses = room
    moved, finding = check_placement(sightings, applied @ poses, objects, ALIGNMENT)
    assert (finding.state, finding.cause) == ("fault", cause)
    np.testing.assert_allclose(moved @ applied, np.eye(4), atol=1e-9)


def test_a_reading_that_catches_fewer_rays_is_no_better(objects, room):
    sightings, poses = room
    away = np.array([6.0, 6, 0])
    spot = np.repeat(CENTERS[:1] + away, 40, axis=0) - poses[0, :3, 3]
    through = Sightings(
        np.zeros(640, dtype=np.int64),
        np.concatenate([sightings.ray, spot]),
        np.concatenate([np.where(np.arange(600) % 2, 1.0, 3.0), np.ones(40)]),
        "a test",
    )
    moved = alignment(0, *away[:2])
    given = weigh(through, poses, objects, np.eye(4))
    purer = weigh(through, poses, objects, np.linalg.inv(moved))
    assert given.inside > 2 * purer.inside
    assert purer.score > given.score + 0.12
    assert check_placement(through, poses, objects, moved)[1].state == "ok"


def test_boxes_of_another_scan_are_astray(objects, room):
    sightings, poses = room
    elsewhere = replace(objects, center=objects.center + torch.tensor([0.0, 0.0, 30.0]))
    _, finding = check_placement(replace(sightings), poses, elsewhere, np.eye(4))
    assert finding.state == "unknown"  # 600 rays might miss all boxes of a true scan.
    many = Sightings(
        *(np.tile(a, (4,) + (1,) * (a.ndim - 1)) for a in (sightings.frame, sightings.ray, sightings.depth)),
        "a test",
    )
    assert check_placement(many, poses, elsewhere, np.eye(4))[1].cause == ASTRAY
