# SPDX-License-Identifier: Apache-2.0
"""Choice of frames."""

from __future__ import annotations

import torch

from raytran.data.views import choose_even, choose_random, hold_out


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
