# SPDX-License-Identifier: Apache-2.0
"""What to tell about camera axes, inversion and intrinsics, and how to mend them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from raytran.capture.doctor.finding import Correction, Finding, Storage
from raytran.capture.doctor.recording import Recording

_POOR = 0.3
"""Below this share of agreeing matches no reading is right."""

NO_READING = "poses do not belong to the images"
"""Cause where no reading of the poses is right; what else is measured with them then means nothing."""

_STORAGE_ADVICE: dict[Storage, tuple[str, str]] = {
    "inverted": (
        "inverted poses",
        "invert each matrix: it is camera-from-world and should be world-from-camera",
    ),
    "transposed": ("transposed poses", "transpose each matrix: it was written column by column"),
    "rotation transposed": (
        "transposed rotations",
        "transpose the 3x3 rotation in each matrix and leave its last column as it is",
    ),
}

NAMED_TURNS: tuple[tuple[str, str, NDArray[np.float64]], ...] = (
    (
        "OpenGL camera axes",
        "negate the second and third column of each camera-to-world matrix",
        np.diag([1.0, -1.0, -1.0]),
    ),
    (
        "PyTorch3D camera axes",
        "negate the first and second column of each camera-to-world matrix",
        np.diag([-1.0, -1.0, 1.0]),
    ),
    (
        "robot camera axes (x forward, z up)",
        "replace the first three columns (a, b, c) of each camera-to-world matrix by (-b, -c, a)",
        np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]),
    ),
    (
        "camera turned by 90°",
        "the images were turned after the poses were made: turn them back, or the cameras with them",
        np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]),
    ),
    (
        "camera turned by 90°",
        "the images were turned after the poses were made: turn them back, or the cameras with them",
        np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]),
    ),
)


def camera_findings(
    recording: Recording, best: Correction, count: int, shares: tuple[float, float] | None
) -> tuple[Finding, ...]:
    """Return the findings on camera axes and intrinsics.

    Args:
        recording: the scan.
        best: the reading that most matches agree with.
        count: number of matches.
        shares: part of them that agrees with the cameras as stored and with ``best``; None: too few to tell.
    """
    if shares is None:
        text = f"only {count} points were found again in other frames, too few to tell"
        return tuple(Finding(check, "unknown", text) for check in ("camera axes", "intrinsics"))
    given, share = shares
    seen = f"{given:.0%} of {count} points matched between frames agree with the cameras as stored"
    if share < _POOR:
        return (
            Finding(
                "camera axes",
                "fault",
                f"{seen}, and no other reading of them does better than {share:.0%}",
                NO_READING,
                "check that each pose file belongs to the image of its name and that the poses are accurate",
                "likely",
            ),
            Finding("intrinsics", "unknown", "cannot be told while no reading of the poses agrees"),
        )
    turned = best.storage != "as stored" or not np.allclose(best.camera_turn, np.eye(3))
    with_fix = f"{seen}, {share:.0%} after the change"
    sure = "certain" if count >= 150 and share > 2 * given else "likely"
    axes = (
        Finding("camera axes", "fault", with_fix, *_camera_advice(best), sure)
        if turned
        else Finding("camera axes", "ok", seen if best.intrinsics is None else with_fix)
    )
    if best.intrinsics is None:
        return axes, Finding("intrinsics", "ok", _describe(recording.intrinsics))
    return axes, Finding(
        "intrinsics", "fault", with_fix, *_intrinsics_advice(recording, best.intrinsics), sure
    )


def _camera_advice(best: Correction) -> tuple[str, str]:
    causes, steps = [], []
    if best.storage != "as stored":
        cause, step = _STORAGE_ADVICE[best.storage]
        causes.append(cause)
        steps.append(step)
    if not np.allclose(best.camera_turn, np.eye(3)):
        known = [(name, advice) for name, advice, turn in NAMED_TURNS if np.allclose(turn, best.camera_turn)]
        rows = best.camera_turn.astype(int).tolist()
        unnamed = ("unusual camera axes", f"multiply each camera-to-world rotation from the right by {rows}")
        cause, step = known[0] if known else unnamed
        causes.append(cause)
        steps.append(step)
    return " and ".join(causes), ", then ".join(steps)


def _intrinsics_advice(recording: Recording, right: NDArray[np.float64]) -> tuple[str, str]:
    height, width = recording.scan.image_size
    stored = recording.intrinsics
    across, down = stored[0, 2] / right[0, 2], stored[1, 2] / right[1, 2]
    moved = max(abs(across - 1), abs(down - 1)) > 0.03
    if moved and abs(right[0, 0] / stored[0, 0] - 1) < 0.03:
        return (
            "wrong image centre",
            f"give cx, cy of about {right[0, 2]:.0f}, {right[1, 2]:.0f} instead of "
            f"{stored[0, 2]:.0f}, {stored[1, 2]:.0f} pixels, or calibrate",
        )
    if not moved:
        return (
            "wrong focal length",
            f"give fx, fy of about {right[0, 0]:.0f}, {right[1, 1]:.0f} instead of "
            f"{stored[0, 0]:.0f}, {stored[1, 1]:.0f} pixels, or calibrate",
        )
    return (
        "intrinsics for another image size",
        f"they are for images of about {across * width:.0f}x{down * height:.0f}, not {width}x{height}: "
        f"multiply their first row by {1 / across:.4f} and their second by {1 / down:.4f}",
    )


def _describe(matrix: NDArray[np.float64]) -> str:
    focal, center = f"{matrix[0, 0]:.1f}, {matrix[1, 1]:.1f}", f"{matrix[0, 2]:.1f}, {matrix[1, 2]:.1f}"
    return f"focal lengths {focal} and centre {center} pixels fit"
