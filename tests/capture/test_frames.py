# SPDX-License-Identifier: Apache-2.0
"""Frames as they are stored: grey images, damaged ones, and blurred ones told from sharp ones."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image
from scipy import ndimage

from raytran.capture.frames import RawScan, blurred_frames, read_grey, sharpness
from raytran.capture.nerfstudio import read_nerfstudio
from raytran.capture.recording import open_recording
from raytran.data.scannet.scan import read_scan

from .forms import SCAN, transforms, write_transforms


def test_grey_images_are_scaled_down_but_never_up(raw):
    height, width = raw.scan.image_size
    grey, factor = read_grey(raw.scan, 0, width // 2)
    assert (grey.shape, factor) == ((height // 2, width // 2), 0.5)
    assert 0 <= grey.min() < grey.max() <= 1
    assert read_grey(raw.scan, 0, 4 * width)[1] == 1.0


def test_damaged_images_are_named_and_read_as_black(copy):
    raw = RawScan.of(read_scan(copy / "scannet" / "scans" / SCAN))
    path = raw.scan.image_path[2]
    path.write_bytes(path.read_bytes()[:300])
    looked, failed = raw.unreadable_images(max_images=1000)
    assert looked == len(raw)
    assert len(failed) == 1
    assert str(path) in failed[0]
    assert not read_grey(raw.scan, 2, 100)[0].any()
    assert raw.unreadable_images(max_images=5)[0] == 5


def test_variance_of_the_laplacian():
    board = np.indices((64, 64)).sum(axis=0) % 2
    # Each inner cell differs by one from all four neighbours: ±4.
    assert sharpness(board[1:-1, 1:-1].astype(np.float32)) == pytest.approx(16, rel=0.15)
    assert sharpness(np.full((8, 8), 0.5, dtype=np.float32)) == 0


@pytest.fixture
def scan_folder(tmp_path):
    """Eight frames of noise at 48 × 64; 2 and 5 are smeared over 8 pixels, 6 is no image."""
    rng = np.random.default_rng(0)
    for name in ("color", "pose", "intrinsic"):
        (tmp_path / name).mkdir()
    for n in range(8):
        pixels = ndimage.gaussian_filter(rng.uniform(0, 255, (48, 64)), 0.7)
        if n in (2, 5):
            pixels = ndimage.uniform_filter1d(pixels, 8, axis=1)
        Image.fromarray(pixels.astype(np.uint8)).convert("RGB").save(tmp_path / "color" / f"{n}.png")
        np.savetxt(tmp_path / "pose" / f"{n}.txt", np.eye(4))
    (tmp_path / "color" / "6.png").write_bytes(b"no image")
    np.savetxt(tmp_path / "intrinsic" / "intrinsic_color.txt", np.diag([60.0, 60, 1, 1]))
    return tmp_path


def test_frames_are_compared_with_the_others_of_their_scan(scan_folder):
    with read_scan(scan_folder, any_size=True) as scan:
        assert np.flatnonzero(blurred_frames(scan, range(8))).tolist() == [2, 5, 6]
        assert blurred_frames(scan, [2, 5]).tolist() == [False, False]  # as sharp as each other
        assert blurred_frames(scan, []).tolist() == []


def test_no_frame_of_a_steady_real_scan_is_blurred(shared_dir):
    folder = next((shared_dir / "realdata" / "scene0470_00").rglob("color")).parent
    with read_scan(folder) as scan:
        assert not blurred_frames(scan, range(0, len(scan), 6)).any()


def test_blur_is_measured_in_the_picture_alone(walk):
    """A narrow frame shows as much detail as the others, beside what fills its image up."""
    rng = np.random.default_rng(0)
    frames = transforms(walk)["frames"]
    for n in range(12):
        size = (16, 3) if n == 5 else (12, 16)
        blocks = rng.integers(100, 150, size, dtype=np.uint8).repeat(4, axis=0).repeat(4, axis=1)
        Image.fromarray(blocks).save(walk.folder / "images" / f"{n}.png")
    Image.new("RGB", (12, 64), (124, 116, 104)).save(walk.folder / "images" / "7.png")
    for n in (5, 7):
        frames[11 - n] |= {"w": 12, "h": 64, "cx": 6, "cy": 31}
    scan = open_recording(read_nerfstudio(write_transforms(walk, frames=frames)))
    assert scan.picture is not None
    assert np.flatnonzero(blurred_frames(scan, range(12))).tolist() == [7]
