# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from itertools import islice

import pytest

from raytran.training.scene_stream import SceneStream

SCENES = range(5)


def places(count, *, num_replicas=1, rank=0, **options):
    return list(islice(SceneStream(SCENES, num_replicas=num_replicas, rank=rank, **options), count))


@pytest.mark.parametrize(("num_replicas", "batch_size"), [(1, 4), (2, 2), (4, 1)])
def test_a_step_sees_the_same_scenes_on_any_number_of_ranks(num_replicas, batch_size):
    whole = places(40, batch_size=4)
    ranks = [
        places(10 * batch_size, num_replicas=num_replicas, rank=rank, batch_size=batch_size)
        for rank in range(num_replicas)
    ]
    for step in range(10):
        part = slice(step * batch_size, (step + 1) * batch_size)
        assert [place for rank in ranks for place in rank[part]] == whole[4 * step : 4 * step + 4]


def test_a_stream_goes_on_at_any_place():
    whole = places(30, batch_size=2, seed=3)
    assert places(13, batch_size=2, seed=3, first=17) == whole[17:]


def test_a_seed_is_an_order():
    assert places(20, batch_size=1, seed=1) == places(20, batch_size=1, seed=1)
    assert places(20, batch_size=1, seed=1) != places(20, batch_size=1, seed=2)


def test_a_stream_has_no_length():
    with pytest.raises(TypeError):
        len(SceneStream(SCENES, num_replicas=1, rank=0, batch_size=1))
