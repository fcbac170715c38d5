# SPDX-License-Identifier: Apache-2.0
"""Distortion against the formulas of its models, and images whose content is known at every ray."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from raytran.capture.lens import (
    Lens,
    UnfitLens,
    center_fault,
    check_lens,
    colmap_lens,
    load_pycolmap,
    needs_resampling,
    opencv_lens,
    pinhole_of,
    resample,
)
from raytran.errors import ConfigError, DataError

PLAIN = Lens((120, 160), (130.0, 131.0), (78.0, 61.0))
BARREL = replace(PLAIN, model="FULL_OPENCV", distortion=(-0.2, 0.05, 0.004, -0.003, 0.01, 0.01, 0.002, 0.001))
PINCUSHION = replace(PLAIN, model="SIMPLE_RADIAL", distortion=(0.15,))
FISHEYE = replace(PLAIN, model="OPENCV_FISHEYE", distortion=(0.05, -0.01, 0.002, 0.0))


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


def opencv(points: np.ndarray, k1, k2, p1, p2, k3=0.0, k4=0.0, k5=0.0, k6=0.0) -> np.ndarray:
    """OpenCV's rational model as its documentation writes it."""
    x, y = points.T
    r2 = x**2 + y**2
    factor = (1 + k1 * r2 + k2 * r2**2 + k3 * r2**3) / (1 + k4 * r2 + k5 * r2**2 + k6 * r2**3)
    return np.stack(
        [
            x * factor + 2 * p1 * x * y + p2 * (r2 + 2 * x**2),
            y * factor + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y,
        ],
        axis=1,
    )


def fisheye(points: np.ndarray, *coefficients: float) -> np.ndarray:
    """The equidistant fisheye with a polynomial of its angle (Kannala & Brandt 2006; OpenCV's fisheye)."""
    radius = np.linalg.norm(points, axis=1, keepdims=True)
    angle = np.arctan(radius)
    polynomial = 1 + sum(k * angle ** (2 * i + 2) for i, k in enumerate(coefficients))
    return points * angle * polynomial / radius


def rad_tan_thin_prism(points: np.ndarray, *params: float) -> np.ndarray:
    """Project Aria's Fisheye624: the fisheye polynomial, then tangential and thin-prism shifts."""
    seen = fisheye(points, *params[:6])
    (p0, p1), (s0, s1, s2, s3) = params[6:8], params[8:]
    x, y = seen.T
    r2 = x**2 + y**2
    return np.stack(
        [
            x + p0 * (r2 + 2 * x**2) + 2 * p1 * x * y + s0 * r2 + s1 * r2**2,
            y + p1 * (r2 + 2 * y**2) + 2 * p0 * x * y + s2 * r2 + s3 * r2**2,
        ],
        axis=1,
    )


ARIA = (0.1, -0.05, 0.02, 0.01, -0.004, 0.001, 0.002, -0.001, 0.003, -0.002, 0.001, 0.0005)


@pytest.mark.parametrize(
    ("model", "params", "expected"),
    [
        ("SIMPLE_PINHOLE", [130, 78, 61], lambda p: p),
        ("PINHOLE", [130, 131, 78, 61], lambda p: p),
        ("SIMPLE_RADIAL", [130, 78, 61, -0.1], lambda p: opencv(p, -0.1, 0, 0, 0)),
        ("RADIAL", [130, 78, 61, -0.1, 0.03], lambda p: opencv(p, -0.1, 0.03, 0, 0)),
        (
            "OPENCV",
            [130, 131, 78, 61, -0.2, 0.05, 0.004, -0.003],
            lambda p: opencv(p, *BARREL.distortion[:4]),
        ),
        ("FULL_OPENCV", [130, 131, 78, 61, *BARREL.distortion], lambda p: opencv(p, *BARREL.distortion)),
        ("FISHEYE", [130, 131, 78, 61], fisheye),
        ("SIMPLE_RADIAL_FISHEYE", [130, 78, 61, 0.05], lambda p: fisheye(p, 0.05)),
        ("RADIAL_FISHEYE", [130, 78, 61, 0.05, -0.01], lambda p: fisheye(p, 0.05, -0.01)),
        (
            "OPENCV_FISHEYE",
            [130, 131, 78, 61, *FISHEYE.distortion],
            lambda p: fisheye(p, *FISHEYE.distortion),
        ),
        ("RAD_TAN_THIN_PRISM_FISHEYE", [130, 131, 78, 61, *ARIA], lambda p: rad_tan_thin_prism(p, *ARIA)),
    ],
)
def test_every_model_images_points_where_its_formula_says(model, params, expected):
    lens = colmap_lens(model, (120, 160), params, "camera 1")
    plane = np.random.default_rng(0).uniform(-0.5, 0.5, (50, 2))
    np.testing.assert_allclose(lens.distort(plane), expected(plane), atol=1e-12)
    assert lens.is_pinhole == ("PINHOLE" in model)
    assert lens.focal == ((130, 131) if len(params) > 5 or model in ("PINHOLE", "FISHEYE") else (130, 130))
    assert lens.center == (78, 61)


def test_every_model_of_pycolmap_is_read_by_name_and_number():
    pycolmap = load_pycolmap()
    for name, model in pycolmap.CameraModelId.__members__.items():
        if name in ("INVALID", "EQUIRECTANGULAR"):
            continue
        params = pycolmap.Camera.create_from_model_id(1, model, 130.0, 160, 120).params.tolist()
        lens = colmap_lens(name, (120, 160), params, "camera 1")
        assert lens == colmap_lens(int(model.value), (120, 160), params, "camera 1")
        assert lens.center == (80, 60)
        assert pinhole_of(lens).size == (120, 160)


@pytest.mark.parametrize(
    ("model", "message"),
    [
        ("LIGHT_FIELD", r"lens model LIGHT_FIELD, which pycolmap .* does not know: undistort"),
        (900, "lens model 900, which pycolmap"),
        ("INVALID", "lens model INVALID"),
        ("EQUIRECTANGULAR", "is a panorama .*: cut it into perspective images"),
    ],
)
def test_models_that_are_unknown_or_no_lens(model, message):
    with pytest.raises(DataError, match=message):
        colmap_lens(model, (120, 160), [1.0, 2.0], "camera 1")


def test_nerfstudios_fourth_coefficient_is_of_r8():
    lens = opencv_lens(
        (120, 160), PLAIN.focal, PLAIN.center, (0.1, 0.02, 0.0, 0.03), (0.001, 0.002), "frame 0"
    )
    plane = np.random.default_rng(0).uniform(-0.5, 0.5, (50, 2))
    r8 = (plane**2).sum(axis=1, keepdims=True) ** 4
    expected = opencv(plane, 0.1, 0.02, 0.001, 0.002) + 0.03 * r8 * plane
    np.testing.assert_allclose(lens.distort(plane), expected, atol=1e-12)
    assert opencv_lens((120, 160), PLAIN.focal, PLAIN.center, (0, 0, 0, 0), (0, 0), "frame 0") == PLAIN


@pytest.mark.usefixtures("without_pycolmap")
def test_only_a_lens_that_distorts_needs_pycolmap():
    assert colmap_lens("SIMPLE_PINHOLE", (120, 160), [130, 78, 61], "camera 1").is_pinhole
    assert opencv_lens((120, 160), PLAIN.focal, PLAIN.center, (0, 0, 0, 0), (0, 0), "frame 0").is_pinhole
    for distorted in (
        lambda: colmap_lens("OPENCV_FISHEYE", (120, 160), [130] * 8, "camera 1"),
        lambda: opencv_lens((120, 160), PLAIN.focal, PLAIN.center, (0.1, 0, 0, 0), (0, 0), "frame 0"),
    ):
        with pytest.raises(ConfigError, match=r"pip install 'raytran\[colmap\]'$"):
            distorted()


def test_importing_pycolmap_leaves_sigterm_as_it_was():
    script = (
        "import signal, os\n"
        "from raytran.capture.lens import load_pycolmap\n"
        "signal.signal(signal.SIGTERM, lambda *_: print('handled'))\n"
        "load_pycolmap()\n"
        "os.kill(os.getpid(), signal.SIGTERM)\n"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert (done.stdout, done.returncode) == ("handled\n", 0), done.stderr


@pytest.mark.parametrize("lens", [BARREL, PINCUSHION, FISHEYE])
def test_an_image_is_resampled_to_what_a_pinhole_sees(lens):
    pinhole = pinhole_of(lens)
    assert pinhole.is_pinhole
    assert needs_resampling(lens, pinhole)
    expected = photograph(pinhole).astype(int)
    inside = (slice(3, -3), slice(3, -3))
    straight = resample(photograph(lens), lens, pinhole).astype(int)
    assert np.abs(straight - expected)[inside].max() <= 3
    # The same image unresampled is far off, so the test can tell.
    assert np.abs(photograph(lens).astype(int) - expected)[inside].max() > 10


def test_an_image_of_half_the_size_is_resampled_alike():
    pinhole = pinhole_of(BARREL)
    half = photograph(BARREL).reshape(60, 2, 80, 2, 3).mean(axis=(1, 3)).round().astype(np.uint8)
    expected = photograph(pinhole.scaled_to((60, 80))).astype(int)
    assert np.abs(resample(half, BARREL, pinhole).astype(int) - expected)[3:-3, 3:-3].max() <= 4


def test_pincushion_is_zoomed_until_no_corner_is_empty():
    pinhole = pinhole_of(PINCUSHION)
    assert 1.02 < pinhole.focal[0] / PINCUSHION.focal[0] < 1.2
    corner = PINCUSHION.image_of(pinhole, np.array([[0.0, 0.0], [160.0, 120.0]]))
    assert corner.min() >= -1
    assert (corner <= np.array([161, 121])).all()


def test_a_pinhole_is_used_as_it_is():
    assert pinhole_of(PLAIN) == PLAIN
    assert not needs_resampling(PLAIN, pinhole_of(PLAIN))


def test_a_distortion_nobody_sees_is_not_resampled():
    lens = replace(PLAIN, model="SIMPLE_RADIAL", distortion=(1e-4,))
    assert not needs_resampling(lens, pinhole_of(lens))


@pytest.mark.parametrize(
    ("lens", "message", "reason"),
    [
        (replace(PLAIN, focal=(0.0, 1.0)), "no positive, finite focal lengths", "not positive and finite"),
        (replace(PLAIN, focal=(1.0, float("inf"))), "no positive, finite", "not positive and finite"),
        (replace(PLAIN, focal=(1e-3, 1e-3)), "focal lengths of 0.001 and 0.001 pixels", "no lens has"),
        (
            replace(PLAIN, focal=(130.0, 1e9)),
            "pixels for images of 160x120, as no lens has",
            "no lens has",
        ),
        (replace(PLAIN, center=(float("nan"), 1.0)), "no positive, finite", "not positive and finite"),
        (replace(PLAIN, center=(1e300, 1.0)), "no positive, finite", "not positive and finite"),
        (replace(PLAIN, focal=(1e-300, 1.0)), "focal lengths of 1e-300 and 1 pixels", "no lens has"),
        (replace(FISHEYE, distortion=(float("inf"), 0.0, 0.0, 0.0)), "no positive, finite", "not positive"),
        (replace(FISHEYE, distortion=(-3.0, 0.0, 0.0, 0.0)), "folds the image onto itself", "folds"),
        (replace(PLAIN, size=(100_000, 100_000)), "for images of 100000x100000.*shrink", "1 to 8192 pixels"),
        (replace(PLAIN, size=(0, 160)), "for images of 160x0", "1 to 8192 pixels"),
        (replace(PLAIN, center=(500.0, 61.0)), "principal point at .*of the stored images", "far outside"),
        (replace(PLAIN, model="SIMPLE_RADIAL", distortion=(-2.0,)), "folds the image onto itself", "folds"),
        # Found by COLMAP in too few matches: it folds nothing, and moves the corners by a hundred times.
        (replace(PLAIN, model="RADIAL", distortion=(-44.8, 1017.0)), "moves the corners out", "corners"),
        (replace(PLAIN, model="SIMPLE_RADIAL", distortion=(3.0,)), "moves the corners out", "corners"),
        # A crop, whose far corner sees the fold that the near ones do not.
        (
            replace(PLAIN, center=(0.0, 61.0), model="SIMPLE_RADIAL", distortion=(-0.3,)),
            "folds the image onto itself",
            "folds",
        ),
    ],
)
def test_what_is_no_lens(lens, message, reason):
    with pytest.raises(UnfitLens, match=f"camera 1 .*{message}") as found:
        check_lens(lens, "camera 1")
    assert reason in found.value.reason
    assert len(str(found.value)) <= 300


@pytest.mark.parametrize("center", [(0.0, 61.0), (200.0, -20.0), (120.0, 30.0)])
def test_a_crop_is_a_camera(center):
    lens = replace(PLAIN, center=center)
    assert check_lens(lens, "camera 1") is lens
    assert center_fault(lens, "camera 1") is None


@pytest.mark.parametrize(
    ("center", "message"),
    [
        ((40.0, 30.0), "the middle of 80x60 and far from that of 160x120: give the intrinsics"),
        ((160.0, 120.5), "the middle of 320x241 and"),
        ((60.0, 80.0), "the middle of 120x160, turned by 90° and"),
        ((259.0, 259.0), "the middle of 518x518 and"),
    ],
)
def test_intrinsics_of_other_images_are_told_by_their_centre(center, message):
    fault = center_fault(replace(PLAIN, center=center), "camera 1")
    assert message in str(fault)


@pytest.mark.parametrize("lens", [BARREL, FISHEYE])
def test_colmaps_own_undistorter_gives_the_same_image(lens):
    pycolmap = load_pycolmap()
    params = [*lens.focal, *lens.center, *lens.distortion]
    camera = pycolmap.Camera(model=lens.model, width=160, height=120, params=params)
    same_size = pycolmap.UndistortCameraOptions()
    same_size.min_scale = same_size.max_scale = 1.0
    image = photograph(lens)
    undistorted, pinhole = pycolmap.undistort_image(same_size, pycolmap.Bitmap.from_array(image), camera)
    target = colmap_lens("PINHOLE", (120, 160), pinhole.params.tolist(), "camera 1")
    ours = resample(image, lens, target).astype(int)
    assert np.abs(ours - undistorted.to_array())[1:-1, 1:-1].max() <= 1
