# SPDX-License-Identifier: Apache-2.0
"""Distortion against COLMAP's own, and images whose content is known at every ray."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from raytran.capture.lens import Lens, check_lens, needs_resampling, resample, shared_pinhole
from raytran.errors import DataError

PLAIN = Lens((120, 160), (130.0, 131.0), (78.0, 61.0))
BARREL = replace(PLAIN, radial=(-0.2, 0.05, 0.01), divisor=(0.01, 0.002, 0.001), tangential=(0.004, -0.003))
PINCUSHION = replace(PLAIN, radial=(0.15,))


def scenery(plane: np.ndarray) -> np.ndarray:
    """The grey of what lies in a direction, given where it meets the plane at depth one."""
    return 120 + 60 * np.sin(12 * plane[..., 0]) + 50 * np.cos(14 * plane[..., 1])


def photograph(lens: Lens) -> np.ndarray:
    """What the lens shows of the scenery: the distortion is inverted pixel by pixel, by iteration."""
    height, width = lens.size
    pixels = np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), axis=-1)
    seen = (pixels - np.array(lens.center)) / np.array(lens.focal)
    plane = seen.copy()
    for _ in range(60):
        plane -= 0.8 * (lens.distort(plane) - seen)
    return np.repeat(scenery(plane)[..., None].round().astype(np.uint8), 3, axis=2)


@pytest.mark.parametrize(
    ("model", "lens", "parameters"),
    [
        ("FULL_OPENCV", BARREL, [130, 131, 78, 61, -0.2, 0.05, 0.004, -0.003, 0.01, 0.01, 0.002, 0.001]),
        (
            "OPENCV",
            replace(BARREL, radial=(-0.2, 0.05), divisor=()),
            [130, 131, 78, 61, -0.2, 0.05, 0.004, -0.003],
        ),
        ("RADIAL", replace(PLAIN, focal=(130.0, 130.0), radial=(-0.1, 0.03)), [130, 78, 61, -0.1, 0.03]),
    ],
)
def test_distortion_is_colmaps(model, lens, parameters):
    pycolmap = pytest.importorskip("pycolmap", reason="pycolmap, the oracle, is not installed")
    oracle = pycolmap.Camera(model=model, width=160, height=120, params=parameters)
    plane = np.random.default_rng(0).uniform(-0.5, 0.5, (50, 2))
    points = np.c_[plane, np.ones(50)]
    ours = lens.distort(plane) * np.array(lens.focal) + np.array(lens.center)
    np.testing.assert_allclose(ours, oracle.img_from_cam(points), atol=1e-9)


@pytest.mark.parametrize("lens", [BARREL, PINCUSHION])
def test_an_image_is_resampled_to_what_a_pinhole_sees(lens):
    pinhole = shared_pinhole([lens], Path("a"))
    assert pinhole.is_pinhole
    assert needs_resampling(lens, pinhole)
    expected = photograph(pinhole).astype(int)
    inside = (slice(3, -3), slice(3, -3))
    straight = resample(photograph(lens), lens, pinhole).astype(int)
    assert np.abs(straight - expected)[inside].max() <= 3
    # The same image unresampled is far off, so the test can tell.
    assert np.abs(photograph(lens).astype(int) - expected)[inside].max() > 10


def test_an_image_of_half_the_size_is_resampled_alike():
    pinhole = shared_pinhole([BARREL], Path("a"))
    half = photograph(BARREL).reshape(60, 2, 80, 2, 3).mean(axis=(1, 3)).round().astype(np.uint8)
    expected = photograph(pinhole.scaled_to((60, 80))).astype(int)
    assert np.abs(resample(half, BARREL, pinhole).astype(int) - expected)[3:-3, 3:-3].max() <= 4


def test_pincushion_is_zoomed_until_no_corner_is_empty():
    pinhole = shared_pinhole([PINCUSHION], Path("a"))
    assert 1.02 < pinhole.focal[0] / PINCUSHION.focal[0] < 1.2
    corner = PINCUSHION.image_of(pinhole, np.array([[0.0, 0.0], [160.0, 120.0]]))
    assert corner.min() >= -1
    assert (corner <= np.array([161, 121])).all()


def test_autofocus_is_one_camera_and_used_as_it_is_only_where_it_agrees():
    lenses = [replace(PLAIN, focal=(130.0 + n, 131.0 + n)) for n in (-1, 0, 0, 0, 1)]
    pinhole = shared_pinhole(lenses, Path("a"))
    # A zoom of 1 % keeps the widest frame's border filled.
    assert pinhole.focal == pytest.approx((130.0, 131.0), rel=0.021)
    assert needs_resampling(lenses[0], pinhole)
    assert not needs_resampling(pinhole.scaled_to((60, 80)), pinhole)


def test_lenses_of_two_cameras_are_refused():
    tele = replace(PLAIN, focal=(260.0, 262.0))
    with pytest.raises(
        DataError, match=r"a\.json has images of different cameras.* 130 pixels.* 260: give the"
    ):
        shared_pinhole([PLAIN, PLAIN, tele], Path("a.json"))
    upright = Lens((160, 120), (130.0, 131.0), (61.0, 78.0))
    with pytest.raises(DataError, match=r"160x120 .* 120x160 .*held one way"):
        shared_pinhole([PLAIN, PLAIN, upright], Path("a.json"))


@pytest.mark.parametrize(
    ("lens", "message"),
    [
        (replace(PLAIN, focal=(0.0, 1.0)), "no positive, finite focal lengths"),
        (replace(PLAIN, center=(float("nan"), 1.0)), "no positive, finite"),
        (replace(PLAIN, size=(100_000, 100_000)), "for images of 100000x100000.*shrink"),
        (replace(PLAIN, center=(300.0, 61.0)), "principal point at .*of the stored images"),
        (replace(PLAIN, radial=(-2.0,)), "folds the image onto itself"),
    ],
)
def test_what_is_no_lens(lens, message):
    with pytest.raises(DataError, match=f"camera 1 .*{message}"):
        check_lens(lens, "camera 1")
