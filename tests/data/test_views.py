# SPDX-License-Identifier: Apache-2.0
"""Choice of frames: random, even, held out, and by what they see together."""

from __future__ import annotations

import itertools
import math

import pytest
import torch

from raytran.data import views
from raytran.data.views import (
    choose_by_coverage,
    choose_even,
    choose_random,
    hold_out,
    near_duplicates,
    visible_cells,
)
from raytran.geometry.camera import Cameras
from raytran.geometry.grid import VoxelGrid


def test_random_frames_are_different_and_in_order(generator) -> None:
    chosen = choose_random(50, 20, generator)
    assert chosen.tolist() == sorted(set(chosen.tolist()))
    assert len(chosen) == 20
    assert 0 <= chosen.min() <= chosen.max() < 50


def test_random_frames_follow_the_generator() -> None:
    def draw(seed: int) -> list[int]:
        return choose_random(50, 20, torch.Generator().manual_seed(seed)).tolist()

    assert draw(1) == draw(1)
    assert draw(1) != draw(2)


def test_every_frame_is_equally_likely(generator) -> None:
    counts = sum(torch.bincount(choose_random(10, 3, generator), minlength=10) for _ in range(2000))
    # 600 expected each; standard deviation 20.
    assert ((counts - 600).abs() < 100).all()


def test_too_few_frames_come_again_but_none_is_left_out(generator) -> None:
    counts = torch.bincount(choose_random(3, 8, generator), minlength=3)
    assert sorted(counts.tolist()) == [2, 3, 3]


def test_even_frames_are_the_middles_of_equal_parts() -> None:
    assert choose_even(10, 2).tolist() == [2, 7]
    assert choose_even(60, 20).tolist() == list(range(1, 60, 3))
    assert choose_even(5, 5).tolist() == [0, 1, 2, 3, 4]
    assert choose_even(2, 4).tolist() == [0, 0, 1, 1]
    assert choose_even(1, 3).tolist() == [0, 0, 0]


def test_held_out_frames_are_none_of_those_seen(generator) -> None:
    used = list(range(3, 43, 4))
    for source in (None, generator):
        seen, rendered = hold_out(used, 3, source)
        assert sorted([*seen, *rendered]) == list(range(10))
        assert len(rendered) == 3
    assert hold_out(used, 3, None)[1] == [1, 5, 8]
    assert hold_out(used, 2, generator) != hold_out(used, 2, generator)


def test_a_held_out_frame_that_came_twice_is_not_seen_either(generator) -> None:
    used = [0, 0, 1, 1, 2, 2, 5]
    for source in (None, generator):
        seen, rendered = hold_out(used, 2, source)
        assert (len(seen), len(rendered)) == (5, 2)
        assert not {used[place] for place in seen} & {used[place] for place in rendered}


GRID = VoxelGrid((8, 8, 4), (8.0, 8.0, 3.2), torch.tensor([0.0, 0.0, 1.6], dtype=torch.float64))


def cameras(place: list[tuple[float, float, float]], heading_deg: list[float]) -> Cameras:
    """Level cameras; 0° looks along +x, 90° along +y."""
    pose = torch.eye(4, dtype=torch.float64).repeat(len(place), 1, 1)
    for matrix, position, heading in zip(pose, place, heading_deg, strict=True):
        forward = torch.tensor([math.cos(math.radians(heading)), math.sin(math.radians(heading)), 0.0])
        down = torch.tensor([0.0, 0.0, -1.0])
        matrix[:3, :3] = torch.stack([torch.linalg.cross(down, forward), down, forward], dim=1)
        matrix[:3, 3] = torch.tensor(position)
    intrinsics = torch.tensor([[60.0, 0, 32], [0, 60, 24], [0, 0, 1]], dtype=torch.float64)
    return Cameras(intrinsics.expand(len(place), 3, 3), pose, (48, 64))


def gain(walk: Cameras, frames: tuple[int, ...]) -> float:
    """What the choice maximises: the n-th frame that sees a cell counts 1/n for it."""
    seen = visible_cells(walk, views._cells(GRID)).double()
    harmonic = torch.tensor([0.0, *itertools.accumulate(1 / n for n in range(1, len(frames) + 1))]).double()
    return float(harmonic[seen[list(frames)].sum(dim=0).long()].sum())


def test_who_stays_long_in_one_corner_still_gets_all_sides():
    # 90 frames that look about in one corner, then one glance to each other side.
    lingering = [(-2.0 + 0.002 * n, -2.0, 1.5) for n in range(90)]
    heading = [20.0 + 0.5 * n for n in range(90)]
    glances = [((2.0, 2.0, 1.5), 225.0), ((-2.0, 2.0, 1.5), 315.0), ((2.0, -2.0, 1.5), 135.0)]
    walk = cameras([*lingering, *(place for place, _ in glances)], [*heading, *(way for _, way in glances)])
    chosen = choose_by_coverage(walk, GRID, 6).frames
    assert {90, 91, 92} <= set(chosen)
    assert len(set(choose_even(93, 6).tolist()) & {90, 91, 92}) < 2
    assert list(chosen) == sorted(set(chosen))


def test_greedy_choice_is_near_the_best_of_all(generator):
    place = (torch.rand(9, 3, generator=generator) * 4 - 2).tolist()
    walk = cameras([(x, y, 1.5) for x, y, _ in place], (360 * torch.rand(9, generator=generator)).tolist())
    best = max(gain(walk, frames) for frames in itertools.combinations(range(9), 3))
    worst = min(gain(walk, frames) for frames in itertools.combinations(range(9), 3))
    found = gain(walk, choose_by_coverage(walk, GRID, 3).frames)
    assert worst < 0.85 * best
    assert found >= (1 - 1 / math.e) * best
    assert found > 0.95 * best


def test_near_duplicates_of_a_chosen_frame_are_left_out():
    # Each of four frames thrice: as it is, 2 cm beside, and 3° turned; a fifth one is turned by 8°.
    place, heading = [], []
    for n in range(4):
        place += [(n - 2.0, 0.0, 1.5), (n - 1.98, 0.0, 1.5), (n - 2.0, 0.0, 1.5)]
        heading += [90.0 * n, 90.0 * n, 90.0 * n + 3.0]
    walk = cameras([*place, (-2.0, 0.0, 1.5)], [*heading, -8.0])
    choice = choose_by_coverage(walk, GRID, 20)
    assert [frame // 3 for frame in choice.frames] == [0, 1, 2, 3, 4]
    assert len(choice.near_duplicates) == 8
    assert not set(choice.frames) & set(choice.near_duplicates)


def test_near_duplicates_are_near_in_place_and_direction():
    walk = cameras(
        [(0, 0, 1.5), (0.04, 0, 1.5), (0.06, 0, 1.5), (0, 0, 1.5), (0, 0, 1.5)], [0.0, 0.0, 0.0, 4.0, 6.0]
    )
    assert near_duplicates(walk)[0].tolist() == [True, True, False, True, False]
    assert near_duplicates(walk).diagonal().all()


def test_a_cell_is_seen_inside_the_image_in_front_and_near():
    walk = cameras([(0.0, 0.0, 1.5)], [0.0])
    # Half the field of view is 32/60 to the sides and 24/60 up and down.
    points = [
        (2, 0, 1.5),
        (2, 1.06, 1.5),
        (2, 1.08, 1.5),
        (2, 0, 2.29),
        (2, 0, 2.31),
        (-2, 0, 1.5),
        (2.6, 0, 1.5),
    ]
    seen = visible_cells(walk, torch.tensor(points, dtype=torch.float64))
    assert seen.tolist() == [[True, True, False, True, False, False, False]]


def test_frames_that_see_nothing_of_the_volume_come_last_and_evenly_if_none_does():
    walk = cameras([(0.0, 0.0, 1.5), (100.0, 0, 1.5), (1.0, 1.0, 1.5)], [0.0, 0.0, 90.0])
    assert choose_by_coverage(walk, GRID, 2).frames == (0, 2)
    assert choose_by_coverage(walk, GRID, 3).frames == (0, 1, 2)
    away = cameras([(100.0 + n, 0, 1.5) for n in range(10)], [0.0] * 10)
    assert choose_by_coverage(away, GRID, 2).frames == (2, 7)
    assert choose_by_coverage(away, GRID, 20).frames == tuple(range(10))
    assert choose_by_coverage(cameras([], []), GRID, 20).frames == ()


@pytest.mark.parametrize("count", [0, 1, 5])
def test_as_many_as_asked_for_and_the_same_each_time(count, generator):
    place = (torch.rand(60, 2, generator=generator) * 4 - 2).tolist()
    walk = cameras([(x, y, 1.5) for x, y in place], (360 * torch.rand(60, generator=generator)).tolist())
    chosen = choose_by_coverage(walk, GRID, count).frames
    assert len(chosen) == count
    assert choose_by_coverage(walk, GRID, count).frames == chosen
