# SPDX-License-Identifier: Apache-2.0
"""Blurred frames are told from sharp ones by their images."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image
from scipy import ndimage

from raytran.capture.sharpness import blurred_frames, sharpness
from raytran.data.scannet.scan import read_scan


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
