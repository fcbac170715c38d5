# SPDX-License-Identifier: Apache-2.0
"""Sharp frames: the best of each stretch, none that is blurred beside its neighbours, no long gaps."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from raytran.capture.poses.film import Film
from raytran.capture.poses.sharp import choose_sharp, keep_sharp
from raytran.errors import DataError


class MadeFilm(Film):
    """Frames of noise, some moved by 3 % of their width while the shutter was open, others damaged."""

    def __init__(self, count, blurred=(), damaged=()):
        self.path = "made"
        self.names = tuple(map(str, range(count)))
        rng = np.random.default_rng(0)
        self._frames = rng.integers(0, 255, (count, 60, 100, 3)).astype(np.uint8)
        for frame in blurred:
            self._frames[frame] = ndimage.uniform_filter1d(self._frames[frame].astype(float), 3, axis=1)
        self._damaged = damaged

    def read(self, number):
        if number in self._damaged:
            raise DataError("damaged")
        return self._frames[number]


def test_blurred_frames_give_way_to_sharp_ones_beside_them():
    blurred = {0, 2, 3, 4, 9}
    choice = choose_sharp(MadeFilm(12, blurred), 4)
    assert len(choice.frames) == 4
    assert not blurred & set(choice.frames)
    assert [frame // 3 for frame in choice.frames] == [0, 1, 2, 3]
    assert (choice.num_blurred, choice.num_damaged) == (0, 0)


def test_stretches_that_are_all_blurred_are_left_out():
    choice = choose_sharp(MadeFilm(24, blurred=(6, 7)), 12)
    assert choice.num_blurred == 1
    assert len(choice.frames) == 11
    assert not {6, 7} & set(choice.frames)


def test_a_short_film_is_taken_whole_and_damage_is_counted():
    assert choose_sharp(MadeFilm(5), 100).frames == (0, 1, 2, 3, 4)
    choice = choose_sharp(MadeFilm(6, damaged=(1, 4)), 100)
    assert choice.frames == (0, 2, 3, 5)
    assert choice.num_damaged == 2
    with pytest.raises(DataError, match="no frame of made can be read"):
        choose_sharp(MadeFilm(3, damaged=(0, 1, 2)), 3)


def test_a_long_blurred_part_is_followed_through_its_best_frames():
    values = np.ones(40)
    values[20:27] = [0.2, 0.1, 0.15, 0.1, 0.3, 0.1, 0.1]
    kept = keep_sharp(values)
    assert kept[:20].all()
    assert kept[27:].all()
    assert np.nonzero(kept[20:27])[0].tolist() == [0, 2, 4]
    gaps = np.diff(np.nonzero(kept)[0])
    assert gaps.max() == 3


def test_frames_are_judged_beside_their_neighbours():
    """A part of the film that shows a bare wall is as sharp as it can be."""
    assert keep_sharp(np.repeat([1.0, 0.05], 20)).all()


def test_progress_sees_every_frame_that_is_looked_at():
    seen = []

    def progress(frames, total):
        seen.append(total)
        yield from frames

    choose_sharp(MadeFilm(30), 10, progress=progress)
    assert seen == [30]
