# SPDX-License-Identifier: Apache-2.0
"""Which image a list means, when it comes from another machine; and names of which no two are one file."""

from __future__ import annotations

import os
import unicodedata

import pytest

from raytran.capture.names import UNCLEAR, frame_name, images_in, locate, unlike
from raytran.errors import DataError


@pytest.fixture
def fill(tmp_path):
    """Write empty files below a folder and return it."""

    def write(*names):
        for name in names:
            path = tmp_path / "scene" / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(b"")
        return tmp_path / "scene"

    return write


def found(root, *names):
    """Return where the images are, below the folder; None for those that are nowhere."""
    places = locate(names, root).places
    return [
        place.relative_to(root).as_posix() if not isinstance(place, str) and os.path.isfile(place) else None
        for place in places
    ]


UMLAUT = unicodedata.normalize("NFC", "küche.jpg")


@pytest.mark.parametrize(
    ("listed", "stored"),
    [
        ("images\\0001.jpg", "images/0001.jpg"),
        ("images/0001.jpg", "images/0001.JPG"),
        ("images/0001.JPG", "images/0001.jpg"),
        ("Images/0001.jpg", "images/0001.jpg"),
        (UMLAUT, unicodedata.normalize("NFD", UMLAUT)),
        (unicodedata.normalize("NFD", UMLAUT), UMLAUT),
        ("images/0001", "images/0001.webp"),
        ("images/0001", "images/0001.TIFF"),
        ("images/frame_1305.17", "images/frame_1305.17.bmp"),
        ("images/0001.jpg", "images/0001.png"),
        ("images/0001.heic", "images/0001.jpg"),
        ("./images/0001.jpg", "images/0001.jpg"),
        ("C:\\Users\\me\\walk\\images\\0001.jpg", "images/0001.jpg"),
        ("/home/me/walk/images/0001.jpg", "images/0001.jpg"),
        ("/home/me/walk/Images/0001.JPG", "images/0001.jpg"),
        ("/home/me/0001.jpg", "0001.jpg"),
        ("../images/0001.jpg", "images/0001.jpg"),
        ("0001.jpg", "images/0001.jpg"),
        ("left/0001.jpg", "images/left/0001.jpg"),
        ("images/0001.jpg", "0001.jpg"),
    ],
)
def test_other_spellings_are_folded(fill, listed, stored, caplog):
    caplog.set_level("INFO")
    root = fill(stored)
    located = locate([listed], root)
    assert located.places == (root / stored,)
    located.report(root / "list.json", root)
    lacks_ending = listed in ("images/0001", "images/frame_1305.17", "./images/0001.jpg")
    assert ("1 images were found under other spellings" in caplog.text) != lacks_ending


def test_exact_names_come_first(fill):
    root = fill("0.jpg", "0.JPG", "0.png", "images/0.jpg")
    assert found(root, "0.jpg", "0.JPG", "0.png") == ["0.jpg", "0.JPG", "0.png"]


def test_what_is_unclear_is_not_guessed(fill):
    root = fill("a/0.JPG", "a/0.Jpg", "b/1.png", "b/1.webp", "c/2.jpg")
    located = locate(["a/0.jpg", "b/1.jpg", "c/2.jpeg", "c/2.png"], root)
    assert located.places == (UNCLEAR,) * 4
    # One that is exact has its image; the other's is not there.
    assert found(root, "c/2.jpg", "c/2.png") == ["c/2.jpg", None]


def test_another_folder_is_no_other_spelling(fill):
    root = fill("right/0.jpg", "depth/1.png", "masks/2.png", "images/3.jpg")
    assert found(root, "left/0.jpg", "images/1.png", "2.png", "/home/me/other/3.jpg") == [None] * 4


def test_two_folders_that_would_be_one_are_unclear(fill):
    root = fill("0.jpg", "1.jpg")
    assert found(root, "left/0.jpg", "right/0.jpg", "left/1.jpg", "right/1.jpg") == [None] * 4
    # The list knows the folder by its own name, so it is no other one.
    assert found(root, "left/0.jpg", "1.jpg") == [None, "1.jpg"]
    both = fill("images/0.jpg", "rgb/0.jpg", "images/1.jpg", "rgb/1.jpg")
    assert found(both / "images", "0.jpg", "1.jpg") == ["0.jpg", "1.jpg"]


def test_an_image_that_is_missing_stays_missing(fill):
    root = fill("images/0.jpg", "images/1.jpg")
    assert found(root, "images/0.jpg", "images/1.jpg", "images/2.jpg") == [
        "images/0.jpg",
        "images/1.jpg",
        None,
    ]
    assert found(root, "images/10.jpg") == [None]


@pytest.mark.parametrize(
    "name", ["../secret.png", "/etc/passwd", "images/../../x.png", "a\0.png", ".", "..\\..\\x.png"]
)
def test_nothing_outside_is_found(fill, tmp_path, name):
    root = fill("images/0.jpg")
    (tmp_path / "secret.png").write_bytes(b"")
    located = locate([name], root)
    assert all(isinstance(place, str) or not place.is_file() for place in located.places)
    if "\\" not in name:
        with pytest.raises(DataError, match=r"which is outside .*: move the images there"):
            located.report(root / "list.json", root)


def test_a_folder_that_leads_to_itself_ends(fill):
    root = fill("images/0.jpg")
    (root / "images" / "again").symlink_to(root)
    assert found(root, "/elsewhere/images/0.jpg", "/elsewhere/images/1.jpg") == ["images/0.jpg", None]


def test_files_of_macos_are_no_images(fill):
    root = fill("0.jpg", "._0.jpg", ".DS_Store", "Thumbs.db", "10.WebP", "9.TIF", "__MACOSX/1.jpg")
    assert [path.name for path in images_in(root)] == ["0.jpg", "9.TIF", "10.WebP"]
    assert found(root, "/x/__MACOSX/1.jpg") == [None]


def test_frames_get_unlike_names():
    names = [
        frame_name(name) for name in ("left_1/0.jpg", "left/1_0.jpg", "Left/1_0.png", "images/7.jpg", "7.jpg")
    ]
    assert names == ["left_1_0", "left_1_0", "Left_1_0", "7", "7"]
    assert unlike(names) == ["left_1_0", "left_1_0-2", "Left_1_0-3", "7", "7-2"]
    assert unlike(["a", "a", "a-2"]) == ["a", "a-3", "a-2"]
    assert unlike(["a"], taken=["A"]) == ["a-2"]


def test_names_are_fit_for_files():
    assert frame_name("a\nb/" + 300 * "c" + ".jpg") == ("a_b_" + 300 * "c")[-120:]
    assert frame_name("frame_1305.17") == "frame_1305.17"


def test_a_name_that_is_too_long_for_a_file_is_nowhere(fill):
    root = fill("0.jpg")
    assert found(root, "9" * 5000 + ".jpg", "a/" * 3000 + "0.jpg", "0.jpg") == [None, None, "0.jpg"]
