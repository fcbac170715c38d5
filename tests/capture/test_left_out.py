# SPDX-License-Identifier: Apache-2.0
"""The scan that a recording makes: which frames are usable, and what becomes of the others."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from raytran.capture.lens import Lens
from raytran.capture.recording import Frame, Recording, open_recording
from raytran.errors import DataError

LENS = Lens((48, 64), (50.0, 51.0), (31.0, 25.0))


def recording(walk, lenses=None, **of_frame):
    """A recording of the walk; ``of_frame`` are lenses of single frames, by ``n0`` … ``n11``."""
    lenses = dict.fromkeys(range(12), LENS) | {int(name[1:]): lens for name, lens in of_frame.items()}
    frames = (Frame(str(n), walk.folder / "images" / f"{n}.png", walk.poses[n], lenses[n]) for n in range(12))
    return Recording(path=walk.folder / "list.txt", scene_id="walk", frames=tuple(frames))


def picture(walk, number, size):
    Image.new("RGB", size, (20 * number,) * 3).save(walk.folder / "images" / f"{number}.png")


def test_a_lens_that_is_none_costs_its_own_frame_alone(walk):
    picture(walk, 8, (300, 300))
    scan = open_recording(
        recording(
            walk,
            n1=replace(LENS, focal=(-50.0, 51.0)),
            n2=replace(LENS, focal=(50.0, float("nan"))),
            n3=replace(LENS, model="RADIAL", distortion=(-44.8, 1017.0)),
            n4=replace(LENS, model="OPENCV_FISHEYE", distortion=(-3.0, 0.0, 0.0, 0.0)),
            n5=replace(LENS, center=(6000.0, 25.0)),
            n6=Lens((64, 48), (50.0, 51.0), (25.0, 31.0)),
            n7=Lens((64, 64), (50.0, 51.0), (25.0, 31.0)),
            n9=replace(LENS, size=(0, 64)),
        )
    )
    assert scan.frame_id == ("0", "10", "11")
    assert scan.dropped == {
        "1": "focal lengths and centre not positive and finite",
        "2": "focal lengths and centre not positive and finite",
        "3": "distortion that moves the corners out of the image",
        "4": "distortion that folds the image",
        "5": "principal point far outside of the image",
        "6": "image turned by 90° against its intrinsics",
        "7": "image of another shape than its intrinsics are for",
        "8": "image of another shape than its intrinsics are for",
        "9": "intrinsics for images that have not 1 to 8192 pixels a side",
    }
    assert scan.intrinsics[0].tolist() == [[50, 0, 31], [0, 51, 25], [0, 0, 1]]


@pytest.mark.parametrize(
    ("lens", "message"),
    [
        (replace(LENS, focal=(0.0, 51.0)), "camera of 0 in .*list.txt has no positive, finite focal lengths"),
        (Lens((64, 48), (50.0, 51.0), (25.0, 31.0)), "0 is 64x48 and .* for 48x64, turned by 90°: give"),
        (Lens((518, 518), (420.0, 420.0), (259.0, 259.0)), "image 0 is 64x48 and .* are for 518x518: give"),
        (replace(LENS, center=(16.0, 12.0)), "the middle of 32x24 and far from that of 64x48"),
        (replace(LENS, center=(259.0, 259.0)), "far outside of 64x48"),
    ],
)
def test_if_no_lens_fits_the_reason_is_one_sentence(walk, lens, message):
    with pytest.raises(DataError, match=message) as found:
        open_recording(recording(walk, **{f"n{n}": lens for n in range(12)}))
    assert len(str(found.value)) < 300 + len(str(walk.folder))


def test_most_frames_have_the_centre_of_other_images(walk):
    """Then those that have it are left out; of a few frames it is what the camera measured."""
    small = replace(LENS, center=(16.0, 12.0))
    scan = open_recording(recording(walk, **{f"n{n}": small for n in range(9)}))
    assert scan.frame_id == ("9", "10", "11")
    assert set(scan.dropped.values()) == {"intrinsics for images of another size"}
    assert open_recording(recording(walk, n3=small)).dropped == {}


def test_crops_and_images_that_are_filled_up_are_said(walk, caplog):
    picture(walk, 3, (48, 64))
    with caplog.at_level(logging.INFO):
        scan = open_recording(
            recording(
                walk, n3=Lens((64, 48), (51.0, 50.0), (25.0, 31.0)), n5=replace(LENS, center=(50.0, 10.0))
            )
        )
    assert scan.dropped == {}
    assert caplog.messages == [
        "walk: 1 of 12 images are of another shape than 64x48 and are filled up to it",
        "walk: 1 of 12 images have their principal point far from the middle, the first at (50, 10) of "
        "64x48, and are taken for crops: if they are none, give the intrinsics of the stored images",
    ]


def test_ordinary_frames_are_used_as_they_are_stored(walk, caplog):
    with caplog.at_level(logging.INFO):
        scan = open_recording(recording(walk, n2=LENS.scaled_to((96, 128))))
    assert caplog.messages == []
    assert (scan.picture, scan.dropped) == (None, {})
    assert (scan.intrinsics.numpy() == np.array([[50, 0, 31], [0, 51, 25], [0, 0, 1]])).all()
    for n, name in enumerate(walk.names):
        assert scan.color_bytes(n) == (walk.folder / "images" / name).read_bytes()
