# SPDX-License-Identifier: Apache-2.0
"""Corrections undo what was done to the poses."""

from __future__ import annotations

import numpy as np
import pytest

from raytran.capture.doctor.finding import Correction

from ..forms import OPENGL


def test_a_fresh_correction_changes_nothing(walk):
    correction = Correction()
    assert not correction.changes_cameras
    np.testing.assert_array_equal(correction.apply(walk[0]), walk[0])


@pytest.mark.parametrize(
    ("storage", "write"),
    [
        ("inverted", np.linalg.inv),
        ("transposed", lambda p: p.transpose(0, 2, 1)),
        (
            "rotation transposed",
            lambda p: np.block([[p[:, :3, :3].transpose(0, 2, 1), p[:, :3, 3:]], [p[:, 3:]]]),
        ),
    ],
)
def test_each_storage_is_undone(walk, storage, write):
    stored = write(walk[0])
    correction = Correction(storage=storage)
    assert correction.changes_cameras
    np.testing.assert_allclose(correction.apply(stored), walk[0], atol=1e-12)


def test_turn_scale_and_world_are_applied_in_this_order(walk):
    poses = walk[0]
    stored = np.linalg.inv(OPENGL) @ poses
    stored[:, :3, 3] *= 100
    correction = Correction(scale=0.01, world_transform=OPENGL)
    np.testing.assert_allclose(correction.apply(stored), poses, atol=1e-12)
    assert correction.changes_cameras


def test_a_last_row_of_zeros_does_no_harm(walk):
    stored = np.linalg.inv(walk[0])
    stored[:, 3] = 0
    np.testing.assert_allclose(Correction(storage="inverted").apply(stored), walk[0], atol=1e-12)
