# SPDX-License-Identifier: Apache-2.0
"""Images and depth maps as they are stored."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image

from raytran.capture.doctor.matches import Matches
from raytran.capture.doctor.recording import Recording
from raytran.capture.doctor.sightings import depth_at, sightings_from_depth, sightings_from_matches
from raytran.data.scannet.scan import read_scan

from ...scan_forms import write_claiming_png
from .conftest import SCAN


def with_depth(copy, depth, frames):
    folder = copy / "scannet" / "scans" / SCAN
    recording = Recording.of(read_scan(folder))
    (folder / "depth").mkdir()
    for frame in frames:
        path = folder / "depth" / f"{recording.scan.frame_id[frame]}.png"
        Image.fromarray((depth * 1000).round().astype(np.uint16)).save(path)
    return recording


def test_grey_images_are_scaled_down_but_never_up(recording):
    height, width = recording.scan.image_size
    grey, factor = recording.read_grey(0, width // 2)
    assert (grey.shape, factor) == ((height // 2, width // 2), 0.5)
    assert 0 <= grey.min() < grey.max() <= 1
    assert recording.read_grey(0, 4 * width)[1] == 1.0


def test_damaged_images_are_named_and_read_as_black(copy):
    recording = Recording.of(read_scan(copy / "scannet" / "scans" / SCAN))
    path = recording.scan.image_path[2]
    path.write_bytes(path.read_bytes()[:300])
    looked, failed = recording.unreadable_images(most=1000)
    assert looked == len(recording)
    assert len(failed) == 1
    assert str(path) in failed[0]
    assert not recording.read_grey(2, 100)[0].any()
    assert recording.unreadable_images(most=5)[0] == 5


def test_depth_maps_give_rays_that_end_where_they_say(copy):
    depth = np.tile(np.linspace(1, 3, 120), (90, 1))
    depth[:20] = 0
    recording = with_depth(copy, depth, [0, 4])
    assert recording.with_depth() == [0, 4]
    assert recording.read_depth(1) is None
    sightings = sightings_from_depth(recording, recording.intrinsics)
    assert set(sightings.frame.tolist()) == {0, 4}
    pixel = sightings.ray @ recording.intrinsics.T
    height, width = recording.scan.image_size
    # The map is half as large as the image; a column's middle lies half a cell behind its start.
    expected = np.interp(pixel[:, 0] / width * 120 - 0.5, np.arange(120), depth[-1])
    np.testing.assert_allclose(sightings.depth, expected, atol=6e-4)
    assert (pixel[:, 1] / height * 90).min() > 20
    poses = recording.stored
    ends = sightings.points(poses)
    seen = np.einsum("nji,nj->ni", poses[sightings.frame, :3, :3], ends - poses[sightings.frame, :3, 3])
    np.testing.assert_allclose(seen[:, 2], sightings.depth, atol=1e-5)  # Stored poses have seven digits.


@pytest.mark.parametrize("side", [9_000, 100_000])
def test_a_depth_map_that_claims_too_many_pixels_is_none(copy, side):
    recording = with_depth(copy, np.full((90, 120), 2.0), [0, 1])
    write_claiming_png(
        copy / "scannet" / "scans" / SCAN / "depth" / f"{recording.scan.frame_id[1]}.png", side
    )
    assert recording.read_depth(0) is not None
    assert recording.read_depth(1) is None


def test_depth_of_matches_is_unknown_without_a_map(copy):
    depth = np.full((90, 120), 2.0)
    depth[:, :60] = 0
    recording = with_depth(copy, depth, [1])
    pixel = np.array([[[200.0, 50], [0, 0]], [[20, 50], [0, 0]], [[200, 50], [0, 0]]])
    matches = Matches(np.array([[1, 2], [1, 2], [2, 3]]), pixel, 1.0)
    np.testing.assert_array_equal(depth_at(recording, matches), [2.0, np.nan, np.nan])


def test_a_scan_without_depth_says_so(recording, matches):
    assert recording.with_depth() == []
    assert sightings_from_depth(recording, recording.intrinsics) is None
    assert depth_at(recording, matches) is None
    sightings = sightings_from_matches(matches, np.full(len(matches), 2.0), recording.intrinsics)
    assert len(sightings) == len(matches)
    np.testing.assert_allclose((sightings.ray @ recording.intrinsics.T)[:, :2], matches.pixel[:, 0])
