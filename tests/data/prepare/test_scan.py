# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from io import BytesIO

import numpy as np
import torch
from PIL import Image

from raytran.data.prepare.scan import (
    choose_frames,
    encoded_frame,
    frame_names,
    homogeneous,
    matrix_text,
    nearest_first,
    write_frames,
)
from raytran.data.scannet.scan import read_scan
from raytran.data.scannet.text import read_matrix


def test_names_are_numbers_unless_two_agree():
    assert frame_names(["frame-000010", "000020", "7", "lounge"]) == ["10", "20", "7", "lounge"]
    assert frame_names(["0010", "10"]) == ["0010", "10"]
    assert frame_names([]) == []


def test_choice():
    assert choose_frames(5, None) == choose_frames(5, 5) == choose_frames(5, 9) == [0, 1, 2, 3, 4]
    assert choose_frames(10, 2) == [2, 7]
    assert choose_frames(0, 3) == []
    assert list(nearest_first(1, 4)) == [1, 0, 2, 3]


def test_numbers_read_back_the_same(tmp_path, generator):
    matrix = torch.randn(4, 4, dtype=torch.float64, generator=generator) * 1e-3
    (tmp_path / "m.txt").write_text(matrix_text(matrix))
    assert (read_matrix(tmp_path / "m.txt") == matrix.numpy()).all()
    assert homogeneous(matrix[:3, :3])[3].tolist() == [0, 0, 0, 1]


def test_resizing_is_that_of_the_loader(write_scan):
    folder = write_scan()
    pixels = np.random.default_rng(0).integers(0, 256, (32, 48, 3), dtype=np.uint8)
    Image.fromarray(pixels).save(folder / "color" / "0.png")
    (folder / "color" / "0.jpg").unlink()
    scan = read_scan(folder)
    kept, ending = encoded_frame(scan, 0, (32, 48))
    assert (kept, ending) == ((folder / "color" / "0.png").read_bytes(), ".png")
    small, ending = encoded_frame(scan, 0, (16, 24))
    assert ending == ".jpg"
    (folder / "small.jpg").write_bytes(small)
    with Image.open(folder / "small.jpg") as image:
        difference = np.asarray(image).astype(int) - scan.read_color(0, (16, 24))
    # What is left is JPEG's loss on noise, its worst case; another filter differs by more.
    assert np.abs(difference).mean() < 25


def test_damaged_frames_are_replaced_by_the_nearest_that_is_not_chosen(write_scan, tmp_path):
    folder = write_scan(frames=range(9))
    for frame in (4, 3):
        (folder / "color" / f"{frame}.jpg").write_bytes(b"damaged")
    out = tmp_path / "out"
    out.mkdir()
    used, damaged = write_frames(read_scan(folder), out, image_size=(32, 48), max_frames=3)
    # Chosen are 1, 4, 7; of the neighbours of 4 the first, 3, is damaged too.
    assert used == [1, 5, 7]
    assert list(damaged) == ["3", "4"]
    assert "4.jpg" in damaged["4"]
    assert sorted(path.name for path in (out / "color").iterdir()) == ["1.jpg", "5.jpg", "7.jpg"]
    assert sorted(path.name for path in (out / "pose").iterdir()) == ["1.txt", "5.txt", "7.txt"]


def test_frames_of_another_size_come_in_the_prepared_one(write_scan):
    folder = write_scan()
    Image.new("RGB", (24, 16), (90, 90, 90)).save(folder / "color" / "10.jpg")
    content, ending = encoded_frame(read_scan(folder), 1, (32, 48))
    with Image.open(BytesIO(content)) as image:
        assert (image.size, image.getpixel((40, 20)), ending) == ((48, 32), (90, 90, 90), ".jpg")
