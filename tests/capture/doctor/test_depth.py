# SPDX-License-Identifier: Apache-2.0
"""Surface points from depth maps and from matched points."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image

from raytran.capture.doctor.depth import depth_of_matches, points_from_depth_maps, points_from_matches
from raytran.capture.doctor.matches import Matches
from raytran.capture.frames import RawScan
from raytran.data.scannet.scan import read_scan

from ...scan_forms import write_claiming_png
from ..forms import SCAN


def with_depth(copy, depth, frames):
    folder = copy / "scannet" / "scans" / SCAN
    raw = RawScan.of(read_scan(folder))
    (folder / "depth").mkdir()
    for frame in frames:
        path = folder / "depth" / f"{raw.scan.frame_id[frame]}.png"
        Image.fromarray((depth * 1000).round().astype(np.uint16)).save(path)
    return raw


def test_depth_maps_give_rays_that_end_where_they_say(copy):
    depth = np.tile(np.linspace(1, 3, 120), (90, 1))
    depth[:20] = 0
    raw = with_depth(copy, depth, [0, 4])
    assert raw.frames_with_depth() == [0, 4]
    assert raw.read_depth(1) is None
    surface = points_from_depth_maps(raw, raw.intrinsics)
    assert set(surface.frame.tolist()) == {0, 4}
    pixel = surface.ray @ raw.intrinsics[0].T
    height, width = raw.scan.image_size
    # The map is half as large as the image; a column's middle lies half a cell behind its start.
    expected = np.interp(pixel[:, 0] / width * 120 - 0.5, np.arange(120), depth[-1])
    np.testing.assert_allclose(surface.depth, expected, atol=6e-4)
    assert (pixel[:, 1] / height * 90).min() > 20
    poses = raw.stored
    ends = surface.in_world(poses)
    seen = np.einsum("nji,nj->ni", poses[surface.frame, :3, :3], ends - poses[surface.frame, :3, 3])
    np.testing.assert_allclose(seen[:, 2], surface.depth, atol=1e-5)  # Stored poses have seven digits.


@pytest.mark.parametrize("side", [9_000, 100_000])
def test_a_depth_map_that_claims_too_many_pixels_is_none(copy, side):
    raw = with_depth(copy, np.full((90, 120), 2.0), [0, 1])
    write_claiming_png(copy / "scannet" / "scans" / SCAN / "depth" / f"{raw.scan.frame_id[1]}.png", side)
    assert raw.read_depth(0) is not None
    assert raw.read_depth(1) is None


def test_depth_of_matches_is_unknown_without_a_map(copy):
    depth = np.full((90, 120), 2.0)
    depth[:, :60] = 0
    raw = with_depth(copy, depth, [1])
    pixel = np.array([[[200.0, 50], [0, 0]], [[20, 50], [0, 0]], [[200, 50], [0, 0]]])
    matches = Matches(np.array([[1, 2], [1, 2], [2, 3]]), pixel, 1.0)
    np.testing.assert_array_equal(depth_of_matches(raw, matches), [2.0, np.nan, np.nan])


def test_a_scan_without_depth_says_so(raw, matches):
    assert raw.frames_with_depth() == []
    assert points_from_depth_maps(raw, raw.intrinsics) is None
    assert depth_of_matches(raw, matches) is None
    surface = points_from_matches(matches, np.full(len(matches), 2.0), raw.intrinsics)
    assert len(surface) == len(matches)
    np.testing.assert_allclose((surface.ray @ raw.intrinsics[0].T)[:, :2], matches.pixel[:, 0])
