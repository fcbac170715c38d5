# SPDX-License-Identifier: Apache-2.0
"""A long walk of which a few frames are damaged in every way is read without them, and a table says why."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest
import torch
from PIL import Image

from raytran.capture.nerfstudio import read_nerfstudio
from raytran.capture.recording import open_recording
from raytran.data.scan import report_dropped
from raytran.errors import DataError

from .forms import OPENGL, transforms, write_transforms

COUNT = 1000


def damage(frames, folder):
    """Spoil 30 frames of a list; return the reason for each that is left out."""
    reasons = {}
    matrix = {n: np.array(frame["transform_matrix"]) for n, frame in enumerate(frames)}
    for n in range(0, 12, 4):
        frames[n]["transform_matrix"] = (matrix[n] @ np.diag([1, 1, -1, 1])).tolist()
        reasons[n] = "left-handed pose (determinant −1)"
        frames[n + 1]["transform_matrix"] = (matrix[n + 1] @ np.diag([0.5, 0.5, 0.5, 1])).tolist()
        reasons[n + 1] = "rotation scaled by 0.5"
        frames[n + 2]["transform_matrix"] = np.full((4, 4), np.nan).tolist()
        reasons[n + 2] = "pose is not finite or out of bounds"
        (folder / f"images/{n + 3}.png").unlink()
        reasons[n + 3] = "no image"
    for n in range(500, 512, 4):
        del frames[n]["transform_matrix"]
        reasons[n] = "no camera-to-world matrix of numbers"
        frames[n + 1]["fl_x"] = "wide"
        reasons[n + 1] = "impossible intrinsics"
        (folder / f"images/{n + 2}.png").write_bytes(b"no image")
        reasons[n + 2] = "image cannot be read"
        frames[n + 3]["transform_matrix"] = np.zeros((4, 4)).tolist()
        reasons[n + 3] = "pose is all zeros"
    for n in range(900, 903):
        skewed = matrix[n].copy()
        skewed[0, :3] += 0.3
        frames[n]["transform_matrix"] = skewed.tolist()
        reasons[n] = "pose is no rigid motion"
        frames[n + 3]["transform_matrix"][1][3] = 1e300
        reasons[n + 3] = "pose is not finite or out of bounds"
    return {str(n): reason for n, reason in reasons.items()}


@pytest.fixture
def long_walk(walk):
    """A list of 1,000 frames, the walk's again and again."""
    for n in range(12, COUNT):
        shutil.copy(walk.folder / "images" / f"{n % 12}.png", walk.folder / "images" / f"{n}.png")
    shots = transforms(walk)["frames"][::-1]
    frames = [json.loads(json.dumps(shots[n % 12])) | {"file_path": f"images/{n}.png"} for n in range(COUNT)]
    return walk, frames


def test_a_table_says_what_was_left_out_and_why(long_walk, caplog):
    walk, frames = long_walk
    reasons = damage(frames, walk.folder)
    scan = open_recording(read_nerfstudio(write_transforms(walk, frames=frames)))
    assert scan.dropped == reasons
    kept = [n for n in range(COUNT) if str(n) not in reasons]
    assert scan.frame_id == tuple(map(str, kept))
    np.testing.assert_allclose(
        (scan.world_from_camera @ torch.from_numpy(OPENGL)).numpy(),
        walk.poses[np.array(kept) % 12],
        atol=1e-9,
    )
    caplog.set_level("INFO")
    report_dropped(scan)
    assert caplog.messages[-1].splitlines() == [
        "walk: left out 30 of 1000 frames",
        "  6  pose is not finite or out of bounds   2, 6, 10, …",
        "  3  image cannot be read                  502, 506, 510",
        "  3  impossible intrinsics                 501, 505, 509",
        "  3  left-handed pose (determinant −1)     0, 4, 8",
        "  3  no camera-to-world matrix of numbers  500, 504, 508",
        "  3  no image                              3, 7, 11",
        "  3  pose is all zeros                     503, 507, 511",
        "  3  pose is no rigid motion               900, 901, 902",
        "  3  rotation scaled by 0.5                1, 5, 9",
    ]


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (
            np.diag([1.0, 1, -1, 1]),
            r"12 left-handed pose \(determinant −1\)\): one axis is mirrored, so negate",
        ),
        (np.diag([0.5, 0.5, 0.5, 1]), "12 rotation scaled by 0.5.*: divide the upper left 3x3 of each by it"),
        (np.diag([np.inf, 1, 1, 1]), "12 pose is not finite or out of bounds.*: tracking was lost"),
        (np.zeros((4, 4)), "12 pose is all zeros"),
    ],
)
def test_a_fault_of_all_frames_is_named_with_its_remedy(walk, spoil, message):
    frames = transforms(walk)["frames"]
    for frame in frames:
        with np.errstate(invalid="ignore"):
            frame["transform_matrix"] = (np.array(frame["transform_matrix"]) @ spoil).tolist()
    with pytest.raises(DataError, match=message) as caught:
        open_recording(read_nerfstudio(write_transforms(walk, frames=frames)))
    assert len(str(caught.value).replace(str(walk.folder), "")) < 260


def test_a_table_of_many_reasons_is_cut(walk, caplog):
    caplog.set_level("INFO")
    scan = open_recording(read_nerfstudio(write_transforms(walk)))
    scan.dropped.update({f"f{n}": f"rotation scaled by {n}" for n in range(20)})
    report_dropped(scan)
    lines = caplog.messages[-1].splitlines()
    assert (len(lines), lines[-1]) == (14, "  8  8 more reasons")
    assert not any(line.endswith(" ") for line in lines)


def test_an_image_of_another_kind_is_read(walk):
    with Image.open(walk.folder / "images" / "3.png") as image:
        image.save(walk.folder / "images" / "3.webp", lossless=True)
    (walk.folder / "images" / "3.png").unlink()
    scan = open_recording(read_nerfstudio(write_transforms(walk)))
    assert scan.read_color(3)[0, 0].tolist() == [60] * 3
