# SPDX-License-Identifier: Apache-2.0
"""Camera axes, inversion and intrinsics: the reading of the pose files that the images agree with."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import permutations, product
from typing import get_args

import numpy as np
from numpy.typing import NDArray

from raytran.data.doctor.finding import Correction, Finding, Storage
from raytran.data.doctor.matches import Matches, triangulate
from raytran.data.doctor.recording import Recording

FEWEST_MATCHES = 60
_CLEARLY_BETTER = 0.15
"""A reading is better only if this share of all matches more agrees with it…"""
_TIMES_BETTER = 1.4
"""… and this many times as many."""
_POOR = 0.3
"""Below this share of agreeing matches no reading is right."""
_FOCAL_FACTORS = np.geomspace(0.4, 2.5, 38)

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

_NAMED_TURNS: tuple[tuple[str, str, NDArray[np.float64]], ...] = (
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


@dataclass(frozen=True)
class CameraReading:
    """The best reading of the cameras.

    Attributes:
        correction: what makes it of the stored matrices; scale and world are still those stored.
        findings: on camera axes, poses and intrinsics.
        agrees: ``(n,)`` bool, the matches that agree.
        depth: ``(n,)`` depth of each match in its first frame, unit of the poses.
    """

    correction: Correction
    findings: tuple[Finding, ...]
    agrees: NDArray[np.bool_]
    depth: NDArray[np.float64]


def read_cameras(recording: Recording, matches: Matches) -> CameraReading:
    """Find which reading of poses and intrinsics the matches between images agree with.

    All 24 turns of the camera axes, of each matrix as stored, inverted and transposed, are tried with the
    intrinsics as stored and scaled to the images; then the focal length. Epipolar geometry tells them apart;
    it says nothing about the unit, or about a turn of the whole world.

    Args:
        recording: the scan.
        matches: points seen twice in it.
    """

    def share(correction: Correction) -> float:
        intrinsics = recording.intrinsics if correction.intrinsics is None else correction.intrinsics
        agrees, _ = triangulate(matches, correction.apply(recording.stored), intrinsics)
        return float(agrees.mean()) if len(matches) else 0.0

    given = Correction()
    best = given
    if len(matches) >= FEWEST_MATCHES:
        candidates = [
            Correction(storage=storage, camera_turn=turn, intrinsics=intrinsics)
            for intrinsics in _intrinsics_candidates(recording)
            for storage, turn in product(get_args(Storage), _axis_turns())
        ]
        # The stored reading comes first, then plain ones: among equals the first is taken.
        best = max(candidates, key=lambda candidate: round(share(candidate), 2))
        if not _better(share(best), share(given)):
            best = given
        best = _with_focal_length(best, recording, share)
    intrinsics = recording.intrinsics if best.intrinsics is None else best.intrinsics
    agrees, depth = triangulate(matches, best.apply(recording.stored), intrinsics)
    findings = _findings(recording, best, len(matches), share(given), share(best))
    return CameraReading(best, findings, agrees, depth)


def _better(new: float, old: float) -> bool:
    return new > old + _CLEARLY_BETTER and new > _TIMES_BETTER * old


def _axis_turns() -> list[NDArray[np.float64]]:
    """Return the 24 turns that map axes to axes, named ones first."""
    named = [np.eye(3), *(turn for *_, turn in _NAMED_TURNS)]
    others = []
    for order, signs in product(permutations(range(3)), product((1.0, -1.0), repeat=3)):
        turn = np.eye(3)[:, order] * signs
        if np.linalg.det(turn) > 0 and not any(np.array_equal(turn, other) for other in named):
            others.append(turn)
    return named + others


def _intrinsics_candidates(recording: Recording) -> list[NDArray[np.float64] | None]:
    """Return None for the stored intrinsics, and these scaled from the size whose middle they name.

    The middle may be off in a true camera: so one factor for both rows, from either side, is tried too.
    """
    height, width = recording.scan.image_size
    matrix = recording.intrinsics
    wide, high = 2 * matrix[0, 2], 2 * matrix[1, 2]
    off = max(abs(wide / width - 1), abs(high / height - 1))
    if min(wide, high) <= 0 or off < 0.03:
        return [None]
    across, down = width / wide, height / high
    factors = ((across, down), (across, across), (down, down))
    return [None, *(np.diag([x, y, 1.0]) @ matrix for x, y in factors)]


def _with_focal_length(
    best: Correction, recording: Recording, share: Callable[[Correction], float]
) -> Correction:
    """Return ``best`` with the focal length that agrees clearly better, if there is one."""
    base = recording.intrinsics if best.intrinsics is None else best.intrinsics
    swept = [
        replace(best, intrinsics=base * np.array([[f, 1, 1], [1, f, 1], [1, 1, 1]])) for f in _FOCAL_FACTORS
    ]
    candidate = max(swept, key=share)
    return candidate if _better(share(candidate), share(best)) else best


def _findings(
    recording: Recording, best: Correction, count: int, given: float, share: float
) -> tuple[Finding, ...]:
    if count < FEWEST_MATCHES:
        text = f"only {count} points were found again in other frames, too few to tell"
        return tuple(Finding(check, "unknown", text) for check in ("camera axes", "intrinsics"))
    seen = f"{given:.0%} of {count} points matched between frames agree with the cameras as stored"
    if share < _POOR:
        return (
            Finding(
                "camera axes",
                "fault",
                f"{seen}, and no other reading of them does better than {share:.0%}",
                "poses do not belong to the images",
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
        known = [(name, advice) for name, advice, turn in _NAMED_TURNS if np.allclose(turn, best.camera_turn)]
        rows = best.camera_turn.astype(int).tolist()
        name, advice = (
            known[0]
            if known
            else (
                "unusual camera axes",
                f"multiply each camera-to-world rotation from the right by {rows}",
            )
        )
        causes.append(name)
        steps.append(advice)
    return " and ".join(causes), ", then ".join(steps)


def _intrinsics_advice(recording: Recording, right: NDArray[np.float64]) -> tuple[str, str]:
    height, width = recording.scan.image_size
    across, down = recording.intrinsics[0, 2] / right[0, 2], recording.intrinsics[1, 2] / right[1, 2]
    if max(abs(across - 1), abs(down - 1)) < 0.03:
        return (
            "wrong focal length",
            f"give fx, fy of about {right[0, 0]:.0f}, {right[1, 1]:.0f} instead of "
            f"{recording.intrinsics[0, 0]:.0f}, {recording.intrinsics[1, 1]:.0f} pixels, or calibrate",
        )
    return (
        "intrinsics for another image size",
        f"they are for images of about {across * width:.0f}x{down * height:.0f}, not {width}x{height}: "
        f"multiply their first row by {1 / across:.4f} and their second by {1 / down:.4f}",
    )


def _describe(matrix: NDArray[np.float64]) -> str:
    focal, center = f"{matrix[0, 0]:.1f}, {matrix[1, 1]:.1f}", f"{matrix[0, 2]:.1f}, {matrix[1, 2]:.1f}"
    return f"focal lengths {focal} and centre {center} pixels fit"
