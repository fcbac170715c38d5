# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest

from raytran.classes import SCAN2CAD_CLASS_BY_CATID
from raytran.rooms.kinds import KINDS, KNOWN_CATIDS, draw_size, guess_kind

EXTENTS = [(1, 1, 1), (2, 1, 0.5), (0.5, 1, 0.4), (0.2, 1, 0.2), (1, 0.2, 0.1), (1, 0.3, 0.8), (0.1, 0.1, 1)]


@pytest.mark.parametrize("catid", KNOWN_CATIDS)
@pytest.mark.parametrize("extent", EXTENTS)
def test_sizes_keep_proportions_and_are_of_furniture(catid, extent):
    rng = np.random.default_rng(0)
    sizes = np.array([draw_size(catid, extent, rng) for _ in range(20)])
    np.testing.assert_allclose(sizes / sizes[:, :1], np.broadcast_to(np.divide(extent, extent[0]), (20, 3)))
    assert len(np.unique(sizes[:, 0])) > 1 or sizes.max() >= 2.2
    assert (sizes.max(axis=1) <= 2.6 + 1e-9).all()
    assert (sizes[:, 1] <= 2.2 + 1e-9).all()
    kind = KINDS[guess_kind(catid, extent)]
    assert kind.catid == catid
    assert kind.category == SCAN2CAD_CLASS_BY_CATID.get(catid, "other")


@pytest.mark.parametrize(
    ("catid", "extent", "kind"),
    [
        ("04379243", (1.2, 0.45, 0.6), "coffee table"),
        ("04379243", (1.5, 0.75, 0.7), "desk"),
        ("04379243", (1.0, 0.75, 1.0), "dining table"),
        ("02933112", (0.8, 1.9, 0.6), "wardrobe"),
        ("02933112", (1.6, 0.5, 0.4), "tv cabinet"),
        ("02933112", (0.5, 0.5, 0.45), "night stand"),
        ("03636649", (0.3, 1.5, 0.3), "floor lamp"),
        ("03636649", (0.3, 0.5, 0.3), "table lamp"),
        ("04256520", (2.6, 0.8, 1.8), "corner sofa"),
        ("03211117", (1.1, 0.65, 0.2), "television"),
        ("03211117", (0.5, 0.45, 0.2), "monitor"),
    ],
)
def test_kinds_by_proportions(catid, extent, kind):
    assert guess_kind(catid, extent) == kind
