# SPDX-License-Identifier: Apache-2.0
"""Reading, resizing, and what happens with damaged images."""

from __future__ import annotations

import logging

import numpy as np
import pytest
import torch
from PIL import Image

from raytran.data.images import (
    FILL,
    box_within,
    decode_image,
    fill_up,
    is_turned,
    read_frames,
    resize,
    stored_size,
    stored_sizes,
)
from raytran.errors import DataError

from ..scan_forms import write_claiming_png


@pytest.fixture
def paths(tmp_path):
    """Six plain grey images, 10·n bright."""
    folder = tmp_path / "scan" / "color"
    folder.mkdir(parents=True)
    for n in range(6):
        Image.new("RGB", (16, 8), (10 * n,) * 3).save(folder / f"{n}.jpg")
    return [folder / f"{n}.jpg" for n in range(6)]


def read_image(path, image_size, stored=None):
    return decode_image(path, name=str(path), image_size=image_size, stored=stored)


def read_images(paths, chosen, **sizes):
    return read_frames(
        lambda position: read_image(paths[position], **sizes), len(paths), chosen, where=paths[0].parent
    )


def cut(path) -> None:
    path.write_bytes(path.read_bytes()[:-40])


def test_colours_and_axes(tmp_path) -> None:
    pixels = np.zeros((4, 6, 3), dtype=np.uint8)
    pixels[1, 5] = (200, 100, 50)
    Image.fromarray(pixels).save(tmp_path / "a.png")
    image = read_image(tmp_path / "a.png", (4, 6))
    assert image.dtype == torch.uint8
    assert image.shape == (3, 4, 6)
    assert image[:, 1, 5].tolist() == [200, 100, 50]
    assert image.sum() == 350


def test_resize_averages_and_need_not_keep_the_aspect(tmp_path) -> None:
    pixels = np.zeros((8, 8, 3), dtype=np.uint8)
    pixels[:, 4:] = 200
    Image.fromarray(pixels).save(tmp_path / "a.png")
    image = read_image(tmp_path / "a.png", (4, 16))
    assert image.shape == (3, 4, 16)
    assert (image[:, :, :6] == 0).all()
    assert (image[:, :, 10:] == 200).all()


@pytest.mark.parametrize("size", [(968, 1296), (720, 1280)])
def test_large_jpeg_keeps_its_geometry(tmp_path, size) -> None:
    """Decoding at half size must not shift the picture: a bright right half stays the right half."""
    pixels = np.zeros((*size, 3), dtype=np.uint8)
    pixels[:, size[1] // 2 :] = 255
    Image.fromarray(pixels).save(tmp_path / "a.jpg", quality=95)
    row = read_image(tmp_path / "a.jpg", (480, 640))[0, 240].float()
    edge = 640 - row.sum() / 255
    assert abs(edge - 320) < 0.75


def test_grey_and_alpha_become_rgb(tmp_path) -> None:
    Image.new("L", (4, 4), 70).save(tmp_path / "grey.jpg")
    Image.new("RGBA", (4, 4), (1, 2, 3, 4)).save(tmp_path / "alpha.png")
    assert read_image(tmp_path / "grey.jpg", (4, 4))[:, 0, 0].tolist() == [70, 70, 70]
    assert read_image(tmp_path / "alpha.png", (4, 4))[:, 0, 0].tolist() == [1, 2, 3]


def test_an_image_in_memory_is_read_as_its_file(paths) -> None:
    content = paths[3].read_bytes()
    assert torch.equal(decode_image(content, name="a"), read_image(paths[3], (8, 16)))
    assert torch.equal(decode_image(content, name="a", image_size=(4, 4)), read_image(paths[3], (4, 4)))
    with pytest.raises(DataError, match="cannot read the image frame 7"):
        decode_image(content[:-40], name="frame 7")
    with pytest.raises(DataError, match="frame 7 is 16x8, not 48x32"):
        decode_image(content, name="frame 7", stored=(32, 48))


def test_pixels_are_resized_as_images_are(tmp_path) -> None:
    pixels = np.random.default_rng(0).integers(256, size=(12, 18, 3), dtype=np.uint8)
    Image.fromarray(pixels).save(tmp_path / "a.png")
    expected = read_image(tmp_path / "a.png", (5, 7)).permute(1, 2, 0)
    np.testing.assert_array_equal(resize(pixels, (5, 7)), expected)


def test_an_image_that_claims_gigapixels_is_refused(paths) -> None:
    """The size in a JPEG's start-of-frame segment is changed to 65535×65535."""
    content = paths[0].read_bytes()
    at = content.index(b"\xff\xc0") + 5
    with pytest.raises(DataError, match="cannot read the image bomb"):
        decode_image(content[:at] + b"\xff" * 4 + content[at + 4 :], name="bomb")


def test_truncated_image_and_wrong_size_name_the_file(paths) -> None:
    cut(paths[2])
    with pytest.raises(DataError, match=r"2\.jpg"):
        read_image(paths[2], (8, 16))
    with pytest.raises(DataError, match=r"1\.jpg is 16x8, not 48x32"):
        read_image(paths[1], (8, 16), stored=(32, 48))


def test_unreadable_image_is_replaced_by_its_neighbour_and_counted(paths, caplog) -> None:
    cut(paths[2])
    with caplog.at_level(logging.WARNING):
        images, used = read_images(paths, [0, 2, 4], image_size=(8, 16), stored=(8, 16))
    assert used == [0, 1, 4]
    assert images[:, 0, 4, 8].tolist() == [0, 10, 40]
    assert images.is_contiguous()
    assert "skipped 1 unreadable" in caplog.text
    assert "2.jpg" in caplog.text


def test_replacement_may_be_unreadable_too(paths) -> None:
    for n in (1, 2, 3):
        cut(paths[n])
    _, used = read_images(paths, [0, 2, 4], image_size=(8, 16), stored=(8, 16))
    assert used == [0, 4, 5]


def test_readable_image_comes_twice_when_none_is_left(paths) -> None:
    cut(paths[5])
    images, used = read_images(paths, [0, 1, 2, 3, 4, 5], image_size=(8, 16), stored=(8, 16))
    assert used == [0, 1, 2, 3, 4, 4]
    assert images[:, 0, 4, 8].tolist() == [0, 10, 20, 30, 40, 40]


def test_too_few_readable_images(paths) -> None:
    for n in range(1, 6):
        cut(paths[n])
    with pytest.raises(DataError, match=r"only 1 of 6 usable frames .* 2 are needed"):
        read_images(paths, [0, 2, 4], image_size=(8, 16), stored=(8, 16))


def test_none_readable(paths) -> None:
    for path in paths:
        path.write_bytes(b"no image")
    with pytest.raises(DataError, match="only 0 of 6"):
        read_images(paths, [0, 2], image_size=(8, 16), stored=(8, 16))
    with pytest.raises(DataError, match="no image in"):
        stored_size(paths)


def test_stored_size_is_height_and_width(paths) -> None:
    paths[0].write_bytes(b"no image")
    assert stored_size(paths) == (8, 16)


@pytest.mark.parametrize("side", [9_000, 100_000])
def test_an_image_that_claims_too_many_pixels_is_not_decoded(tmp_path, side) -> None:
    """A few bytes, whose header promises a picture that would fill the memory."""
    write_claiming_png(tmp_path / "a.png", side)
    with pytest.raises(DataError, match=r"claims 9000x9000 pixels, and at most 8192|exceeds limit"):
        read_image(tmp_path / "a.png", (8, 16))
    with pytest.raises(DataError, match=r"pixels, and at most 8192|can be read"):
        stored_size([tmp_path / "a.png"])


@pytest.mark.parametrize(
    ("size", "canvas", "box"),
    [
        ((480, 640), (480, 640), (0, 0, 640, 480)),
        ((960, 1280), (480, 640), (0, 0, 640, 480)),
        ((478, 640), (480, 640), (0, 0, 640, 480)),
        ((640, 480), (480, 640), (140, 0, 500, 480)),
        ((300, 300), (480, 640), (80, 0, 560, 480)),
        ((100, 640), (480, 640), (0, 190, 640, 290)),
        ((1, 8000), (480, 640), (0, 239, 640, 240)),
    ],
)
def test_images_of_another_shape_are_put_into_the_middle(size, canvas, box) -> None:
    assert box_within(size, canvas) == box


def test_what_is_turned_is_no_square() -> None:
    assert is_turned((640, 480), (480, 640))
    assert not is_turned((480, 640), (480, 640))
    assert not is_turned((300, 300), (480, 640))
    assert not is_turned((300, 300), (500, 500))


@pytest.mark.parametrize("image_size", [None, (48, 64), (31, 50), (96, 128), (7, 9)])
def test_a_picture_keeps_its_place_to_a_fraction_of_a_pixel(image_size) -> None:
    """A ramp over 30×20 pixels in columns 17 to 49 of 64: its values tell the place of what is shown."""
    ramp = np.repeat((np.arange(20) * 12.0 + 6)[None, :, None], 30, axis=0).repeat(3, axis=2).astype(np.uint8)
    height, width = image_size or (48, 64)
    filled = fill_up(ramp, (17, 0, 49, 48), (48, 64), image_size)
    assert filled.shape == (height, width, 3)
    is_fill = (filled == np.array(FILL)).all(axis=2)
    left, right = 17 * width / 64, 49 * width / 64
    shown = np.flatnonzero(~is_fill[height // 2])
    assert (shown[0], shown[-1] + 1) == (np.ceil(left), np.floor(right))
    column = np.arange(width) + 0.5
    expected = np.interp((column - left) / (right - left) * 20 - 0.5, np.arange(20), ramp[0, :, 0])
    inner = shown[1:-1]
    np.testing.assert_allclose(filled[height // 2, inner, 0], expected[inner], atol=4 if width > 20 else 9)


def test_a_picture_narrower_than_a_pixel_shows_nothing() -> None:
    filled = fill_up(np.zeros((400, 1, 3), np.uint8), (319, 0, 320, 480), (480, 640), (12, 16))
    assert (filled == np.array(FILL)).all()


def test_the_stored_size_is_that_of_most_images(paths) -> None:
    """Whichever comes first."""
    for path, size in zip(paths, [(9, 9), (16, 8), (8, 16), (16, 8), (16, 8), (8, 16)], strict=True):
        Image.new("RGB", size).save(path)
    write_claiming_png(paths[2], 100_000)
    paths[5].write_bytes(b"no image")
    assert stored_size(paths) == (8, 16)
    assert stored_sizes(paths) == [(9, 9), (8, 16), None, (8, 16), (8, 16), None]
