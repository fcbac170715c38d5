# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest

from raytran.rooms.materials import (
    SIZE,
    TEXTURES,
    floor_paint,
    texture_index,
    texture_library,
    tinted,
    value_noise,
)


def sample(name, u, v, footprint):
    count = len(u)
    texture = np.full(count, texture_index(name), dtype=np.int32)
    values = (np.asarray(a, dtype=np.float32) for a in (u, v, np.full(count, footprint)))
    return texture_library().sample(texture, *values)


@pytest.mark.parametrize("name", list(TEXTURES))
def test_textures_repeat_after_their_side(name):
    rng = np.random.default_rng(0)
    u, v = rng.uniform(0.0, 1.0, size=(2, 500))
    near = sample(name, u, v, 1e-4)
    assert near.min() >= 0
    assert near.max() <= 1
    texel = TEXTURES[name] / SIZE
    middle_u, middle_v = (np.floor(a / texel) * texel + texel / 2 for a in (u, v))
    shifted = sample(name, middle_u + TEXTURES[name], middle_v - TEXTURES[name], 1e-4)
    np.testing.assert_array_equal(sample(name, middle_u, middle_v, 1e-4), shifted)


@pytest.mark.parametrize("name", ["planks", "tiles", "stripes"])
def test_coarser_levels_are_means(name):
    side, rng = TEXTURES[name], np.random.default_rng(0)
    u, v = rng.uniform(0, side, size=(2, 20000))
    fine = sample(name, u, v, 1e-4)
    coarsest = sample(name, u, v, 100.0)
    assert len(np.unique(coarsest)) == 1
    assert coarsest[0] == pytest.approx(fine.mean(), abs=0.02)
    middling = sample(name, u, v, side / SIZE * 100)
    assert 0 < middling.std() < fine.std()


def test_value_noise_is_smooth_and_periodic():
    noise = value_noise(np.random.default_rng(0), (8, 8))
    assert np.abs(np.diff(noise, axis=0)).max() < 0.04
    assert np.abs(noise[0] - noise[-1]).max() < 0.04


def test_paints():
    paint = tinted(0.0, 1.0, 0.8, 0.5, "wood")
    assert paint.light == pytest.approx((0.8, 0.0, 0.0))
    assert paint.dark == pytest.approx((0.4, 0.0, 0.0))
    wet = {floor_paint(np.random.default_rng(i), wet=True).texture for i in range(20)}
    assert wet == {texture_index("tiles")}
