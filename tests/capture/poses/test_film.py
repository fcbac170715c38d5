# SPDX-License-Identifier: Apache-2.0
"""Films: videos and folders of images, as a person sees them."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image

from raytran.capture.poses.film import ImageFilm, VideoFilm, open_film
from raytran.errors import DataError

from ..forms import write_video


@pytest.fixture
def images(tmp_path):
    """Three images of 8 × 6, the second stored on its side with a tag that says so."""
    folder = tmp_path / "walk" / "images"
    folder.mkdir(parents=True)
    for number, name in enumerate(("IMG 2.png", "IMG 10.png", "IMG 9.jpg")):
        image = Image.fromarray(np.full((6, 8, 3), 20 * number, dtype=np.uint8))
        image.putpixel((0, 0), (255, 255, 255))
        if name == "IMG 10.png":
            exif = image.getexif()
            exif[0x0112] = 6  # is shown turned by a quarter clockwise
            image.transpose(Image.Transpose.ROTATE_90).save(folder / name, exif=exif)
        else:
            image.save(folder / name, quality=100)
    return folder


@pytest.mark.parametrize("place", [".", ".."])
def test_images_come_in_the_order_of_their_numbers_and_upright(images, place):
    film = open_film((images / place).resolve())
    assert isinstance(film, ImageFilm)
    assert film.names == ("IMG_2", "IMG_9", "IMG_10")
    assert [film.read(number).shape for number in range(3)] == [(6, 8, 3)] * 3
    assert film.read(2)[0, 0].tolist() == [255, 255, 255]
    assert film.read(2)[5, 7].tolist() == [20, 20, 20]


def test_a_video_is_named_by_its_frames_and_turned_as_it_is_shown(walk, tmp_path):
    write_video(walk, tmp_path / "walk.mp4", turn=6)
    film = open_film(tmp_path / "walk.mp4")
    assert isinstance(film, VideoFilm)
    height, width = walk.image_size
    assert film.names == tuple(f"{n:06d}" for n in range(len(walk.names)))
    assert film.read(3).shape == (width, height, 3)
    film.close()


def test_what_is_no_film(tmp_path):
    with pytest.raises(DataError, match=r"there is no video .*gone\.mp4"):
        open_film(tmp_path / "gone.mp4")
    (tmp_path / "notes.txt").touch()
    with pytest.raises(DataError, match=r"notes\.txt is no video"):
        open_film(tmp_path / "notes.txt")
    with pytest.raises(DataError, match="holds no video and no images"):
        open_film(tmp_path)
