# SPDX-License-Identifier: Apache-2.0
"""What a telephone's camera and tracking make of light and poses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from raytran.rooms.film import draw_film, moved_blur, tracked_poses


def steady(rng):
    """A camera without blur, noise and frames of their own exposure."""
    film = draw_film(rng)
    quiet = {"softness": 0.0, "shake": 0.0, "defocus": 0.0, "shot": 0.0, "read": 0.0, "sharpness": 0.0}
    return replace(film, **quiet, adapts=0.0, vignette=0.0, saturation=1.0)


@pytest.mark.parametrize("seed", range(5))
def test_more_light_is_never_darker(seed):
    film = steady(np.random.default_rng(seed))
    light = np.broadcast_to(np.linspace(0, 3, 64, dtype=np.float32), (3, 48, 64))
    picture = film.develop(light, 1.0, np.array([1.0, 0.0]), np.random.default_rng(0)).astype(int)
    assert (np.diff(picture, axis=1) >= 0).all()
    assert (picture[:, -1] > picture[:, 0]).all()


def test_corners_lose_light_and_noise_is_where_it_is_asked_for():
    film = steady(np.random.default_rng(0))
    light = np.full((3, 60, 80), 0.4, dtype=np.float32)

    def developed(film):
        motion, rng = np.array([1.0, 0.0]), np.random.default_rng(1)
        return film.develop(light, 0.4, motion, rng).astype(float)

    assert np.ptp(developed(film), axis=(0, 1)).max() == 0
    dark = developed(replace(film, vignette=0.4))
    assert (dark[0, 0] < dark[30, 40]).all()
    few, many = (developed(replace(film, shot=shot)).std(axis=(0, 1)).mean() for shot in (0.0005, 0.005))
    assert 0 < few < many


def test_motion_blurs_along_itself_alone_and_keeps_the_light():
    picture = np.zeros((3, 21, 31), dtype=np.float32)
    picture[:, 10, 15] = 1
    across = moved_blur(picture, np.array([2.0, 0.0]), 6.0)
    assert across[:, 10].sum() == pytest.approx(3)
    assert np.count_nonzero(across[0, 10]) == 7
    assert moved_blur(picture, np.array([0.0, 1.0]), 6.0)[:, :, 15].sum() == pytest.approx(3)
    assert moved_blur(picture, np.array([1.0, 0.0]), 0.2) is picture


def test_tracking_is_off_by_centimetres_and_parts_of_a_degree():
    true = np.tile(np.eye(4), (24, 1, 1))
    shift, turn = [], []
    for seed in range(200):
        found = tracked_poses(true, np.random.default_rng(seed))
        shift.append(np.linalg.norm(found[:, :3, 3], axis=1))
        turn.append(np.rad2deg(Rotation.from_matrix(found[:, :3, :3]).magnitude()))
        # A drift: neighbours are off alike.
        assert np.abs(np.linalg.det(found[:, :3, :3]) - 1).max() < 1e-9
    shift, turn = np.array(shift), np.array(turn)
    assert 0.005 < np.median(shift) < 0.02
    assert np.percentile(shift, 99) < 0.05
    assert 0.1 < np.median(turn) < 0.5
    neighbours = np.linalg.norm(np.diff(shift, axis=1)) / np.sqrt(shift[:, 1:].size)
    assert neighbours < shift.std()
