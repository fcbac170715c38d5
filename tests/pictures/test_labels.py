# SPDX-License-Identifier: Apache-2.0
"""Names do not cover each other, nor leave the picture, as long as there is room."""

from __future__ import annotations

import numpy as np

from raytran.pictures.labels import place_labels


def overlaps(middles: np.ndarray, sizes: np.ndarray) -> int:
    reach = (sizes[:, None] + sizes) / 2
    covered = (np.abs(middles[:, None] - middles) < reach).all(axis=2)
    return int(covered.sum() - len(middles)) // 2


def test_a_crowd_of_names_finds_room_in_the_picture():
    rng = np.random.default_rng(0)
    anchors = rng.uniform((-20, -20), (420, 320), (38, 2))
    sizes = np.stack([rng.uniform(60, 90, 38), np.full(38, 14.0)], axis=1)
    assert overlaps(anchors, sizes) > 10
    middles = place_labels(anchors, sizes, (0, 0, 400, 300))
    assert overlaps(middles, sizes) == 0
    assert (middles - sizes / 2 >= 0).all()
    assert (middles + sizes / 2 <= (400, 300)).all()
    # Names stay near what they name.
    assert np.median(np.linalg.norm(middles - anchors.clip(0, (400, 300)), axis=1)) < 60


def test_with_room_for_all_each_is_where_it_is_wanted():
    anchors = np.array([[50.0, 50.0], [50.0, 90.0]])
    middles = place_labels(anchors, [(40, 12), (40, 12)], (0, 0, 100, 100))
    np.testing.assert_allclose(middles, anchors)


def test_a_mark_is_not_covered_if_there_is_a_place_beside():
    (free,) = place_labels([(50.0, 50.0)], [(40, 12)], (0, 0, 100, 100), marks=[(55.0, 50.0)])
    assert abs(free[1] - 50) > 6 or abs(free[0] - 55) > 20


def test_without_room_names_are_in_the_picture_all_the_same():
    middles = place_labels([(5.0, 5.0)] * 9, [(30, 12)] * 9, (0, 0, 32, 14))
    assert middles.shape == (9, 2)
    assert (middles - (15, 6) >= 0).all()
    assert place_labels([], [], (0, 0, 10, 10)).shape == (0, 2)
