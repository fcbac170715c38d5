# SPDX-License-Identifier: Apache-2.0
"""An open scan: the same to use, whether it is a folder or a recording."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image

from raytran.data.scannet.scan import open_scan, read_scan, read_sens
from raytran.errors import DataError


@pytest.mark.parametrize("kind", ["folder", "recording"])
def test_frames_as_stored_decoded_and_resized(write_scan, write_sens, kind) -> None:
    path = write_scan(frames=(0, 1, 2)) if kind == "folder" else write_sens(frames=3)
    with open_scan(path) as scan:
        assert len(scan) == 3
        assert scan.path == path
        for index in range(3):
            stored, pixels = scan.color_bytes(index), scan.read_color(index)
            assert stored is not None
            assert stored.startswith(b"\xff\xd8")
            assert (pixels.shape, pixels.dtype) == ((32, 48, 3), np.uint8)
            assert pixels.flags.c_contiguous
            assert (pixels == index).all()
            assert scan.read_color(index, (8, 16)).shape == (8, 16, 3)


def test_a_recording_is_closed_when_its_use_fails(write_sens) -> None:
    with pytest.raises(ZeroDivisionError), read_sens(write_sens()) as scan:
        _ = 1 / 0
    with pytest.raises(ValueError, match="closed file"):
        scan.color_bytes(0)


def test_damaged_images_are_named_when_they_are_read(write_scan) -> None:
    folder = write_scan(frames=(0, 10, 20))
    scan = read_scan(folder)
    (folder / "color" / "0.jpg").write_bytes(b"no image")
    Image.new("RGB", (8, 8)).save(folder / "color" / "10.jpg")
    (folder / "color" / "20.jpg").unlink()
    for index, reason in (
        (0, "cannot read the image"),
        (1, r"10\.jpg is 8x8, not 48x32"),
        (2, "cannot read"),
    ):
        with pytest.raises(DataError, match=reason):
            scan.read_color(index)
    with pytest.raises(DataError, match=r"cannot read the image .*20\.jpg \(No such file"):
        scan.color_bytes(2)
