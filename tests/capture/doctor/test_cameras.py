# SPDX-License-Identifier: Apache-2.0
"""Every way in which cameras are commonly wrong is told from the images alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from raytran.capture.doctor.cameras import NO_READING, _axis_rotations, check_cameras
from raytran.capture.doctor.finding import Correction
from raytran.capture.doctor.matches import Matches

from ..forms import OPENGL


def scaled(x, y):
    return lambda k: np.diag([x, y, 1.0]) @ k


def focal(factor):
    return lambda k: k * np.array([[factor, 1, 1], [1, factor, 1], [1, 1, 1]])


SPOILED_POSES = {
    "OpenGL camera axes": lambda p: p @ OPENGL,
    "PyTorch3D camera axes": lambda p: p @ np.diag([-1.0, -1.0, 1.0, 1.0]),
    "inverted poses": np.linalg.inv,
    "inverted poses and OpenGL camera axes": lambda p: np.linalg.inv(p @ OPENGL),
    "transposed poses": lambda p: p.transpose(0, 2, 1),
    "robot camera axes (x forward, z up)": lambda p: (
        p @ np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
    ),
}
SPOILED_INTRINSICS = {
    "intrinsics for another image size": [scaled(2.025, 2.0167), scaled(0.5, 0.5), scaled(0.85, 0.85)],
    "wrong focal length": [focal(1.3), focal(0.75)],
}


def causes(reading):
    return [finding.cause for finding in reading.findings if finding.state == "fault"]


def test_true_cameras_are_not_flagged(raw, matches):
    reading = check_cameras(raw, matches)
    assert causes(reading) == []
    assert not reading.correction.changes_cameras
    assert [finding.state for finding in reading.findings] == ["ok", "ok"]


@pytest.mark.parametrize("cause", SPOILED_POSES)
def test_spoiled_poses_are_named_and_mended(raw, matches, cause):
    spoiled = replace(raw, stored=SPOILED_POSES[cause](raw.stored))
    reading = check_cameras(spoiled, matches)
    assert causes(reading) == [cause]
    mended, true = reading.correction.apply(spoiled.stored), raw.stored
    # Up to a turn of the whole world, to which images are blind.
    relative = np.linalg.inv(mended[:-1]) @ mended[1:]
    np.testing.assert_allclose(relative, np.linalg.inv(true[:-1]) @ true[1:], atol=1e-8)


@pytest.mark.parametrize(
    ("cause", "spoil"), [(cause, spoil) for cause, spoils in SPOILED_INTRINSICS.items() for spoil in spoils]
)
def test_spoiled_intrinsics_are_named_and_mended(raw, matches, cause, spoil):
    reading = check_cameras(replace(raw, intrinsics=spoil(raw.intrinsics)), matches)
    assert causes(reading) == [cause]
    mended = reading.correction.intrinsics
    focal = [0, 1], [0, 1]
    np.testing.assert_allclose(mended[:, *focal], raw.intrinsics[:, *focal], rtol=0.05)
    assert "multiply" in reading.findings[1].fix or "give fx" in reading.findings[1].fix


def test_poses_and_intrinsics_may_be_wrong_together(raw, matches):
    spoiled = replace(raw, stored=raw.stored @ OPENGL, intrinsics=scaled(2.025, 2.0167)(raw.intrinsics))
    assert causes(check_cameras(spoiled, matches)) == [
        "OpenGL camera axes",
        "intrinsics for another image size",
    ]


def test_any_turn_of_the_axes_is_found(raw, walk):
    poses, intrinsics, matches, _ = walk
    intrinsics = np.broadcast_to(intrinsics, (len(poses), 3, 3))
    turns = _axis_rotations()
    assert len(turns) == 24
    assert len({turn.tobytes() for turn in turns}) == 24
    for turn in turns[::3]:
        spoiled = poses.copy()
        spoiled[:, :3, :3] = poses[:, :3, :3] @ turn.T
        reading = check_cameras(replace(raw, stored=spoiled, intrinsics=intrinsics), matches)
        np.testing.assert_array_equal(reading.correction.apply(spoiled), poses)
        assert reading.agrees.all()


def test_poses_of_other_frames_are_no_reading(raw, matches):
    rng = np.random.default_rng(0)
    mixed = raw.stored[rng.permutation(len(raw))]
    reading = check_cameras(replace(raw, stored=mixed), matches)
    assert causes(reading) == [NO_READING]
    assert reading.findings[1].state == "unknown"


def test_few_matches_tell_nothing(raw, matches):
    few = Matches(matches.frame[:20], matches.pixel[:20], matches.tolerance_px)
    reading = check_cameras(replace(raw, stored=np.linalg.inv(raw.stored)), few)
    assert [finding.state for finding in reading.findings] == ["unknown", "unknown"]
    assert reading.correction.apply(raw.stored).tolist() == Correction().apply(raw.stored).tolist()
    assert not reading.agrees.any()
