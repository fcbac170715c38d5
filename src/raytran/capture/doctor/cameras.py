# SPDX-License-Identifier: Apache-2.0
"""Camera axes, storage of the poses, and intrinsics: the reading of the files that the images agree with."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import get_args

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from raytran.capture.doctor.finding import Correction, Finding, Storage
from raytran.capture.doctor.matches import Matches, triangulate
from raytran.capture.frames import RawScan

NO_READING = "poses do not belong to the images"
"""Cause where no reading of the poses is right; what else is measured with them then means nothing."""

_MIN_MATCHES, _MANY_MATCHES = 60, 150
"""Matches below which nothing is told, and above which a clear result is certain."""

_POOR = 0.3
"""Share of agreeing matches below which no reading is right."""

_CLEARLY_BETTER, _TIMES_BETTER = 0.15, 1.4
"""Other camera axes must win this share of all matches, and this many times as many as the stored ones."""

_NET_GAIN, _GAINED_PER_LOST = 0.06, 5
"""Other intrinsics must win this share of all matches, and this many for each that they lose."""

_FOCAL_FACTORS = np.geomspace(0.4, 2.5, 38)
_FINE_FACTORS = np.linspace(0.95, 1.05, 11)
"""Factors of the focal length that are tried: steps of five per cent, then of one."""

_SAME = 0.03
"""Relative difference of image sizes or focal lengths that are taken for equal."""

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
_IMAGES_ROTATED = "the images were turned after the poses were made: turn them back, or the cameras with them"
_NAMED_ROTATIONS: tuple[tuple[str, str, NDArray[np.float64]], ...] = (
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
    ("camera turned by 90°", _IMAGES_ROTATED, np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])),
    ("camera turned by 90°", _IMAGES_ROTATED, np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])),
)
"""Cause, fix and correcting rotation of the camera axes that other programs use."""


@dataclass(frozen=True)
class CameraCheck:
    """The reading of the cameras that most matches agree with.

    Attributes:
        correction: what makes it of the stored matrices; scale and world are still those stored.
        findings: on camera axes (with the storage of the poses) and on intrinsics.
        agrees: ``(n,)`` bool, the matches that agree.
        depth: ``(n,)`` depth of each match in its first frame, unit of the poses.
    """

    correction: Correction
    findings: tuple[Finding, ...]
    agrees: NDArray[np.bool_]
    depth: NDArray[np.float64]


def check_cameras(raw: RawScan, matches: Matches) -> CameraCheck:
    """Find the reading of poses and intrinsics that the matches between images agree with.

    All 24 rotations of the camera axes, of each matrix as stored, inverted and transposed, are tried with the
    intrinsics as stored and scaled to the images; then the focal length. Epipolar geometry tells them apart;
    it says nothing about the unit, or about a rotation of the whole world.

    Args:
        raw: the scan.
        matches: n points, each in two of its frames.
    """
    score = _Score(raw, matches)
    if len(matches) < _MIN_MATCHES:
        text = f"only {len(matches)} points were found again in other frames, too few to tell"
        findings = tuple(Finding(check, "unknown", text) for check in ("camera axes", "intrinsics"))
        none = np.zeros(len(matches))
        return CameraCheck(Correction(), findings, none.astype(bool), none)
    scaled = _scaled_intrinsics(raw)
    candidates = [
        Correction(storage=storage, camera_rotation=rotation, intrinsics=intrinsics)
        for intrinsics in (None, *scaled)
        for storage, rotation in product(get_args(Storage), _axis_rotations())
    ]
    # The stored reading comes first, then plain ones: among equals the first is taken.
    best = max(candidates, key=lambda candidate: round(score.share(candidate), 2))
    stored = score.share(Correction())
    if not is_clearly_better(score.share(best), stored):
        best = Correction()
    best = _with_better_intrinsics(replace(best, intrinsics=None), scaled, score)
    agrees, depth = score.triangulate(best)
    findings = _findings(raw, best, len(matches), stored, float(agrees.mean()))
    return CameraCheck(best, findings, agrees, depth)


def agreement(raw: RawScan, matches: Matches) -> float:
    """Return the share of matches that agree with a scan's cameras as stored; 0 of too few matches."""
    return _Score(raw, matches).share(Correction()) if len(matches) >= _MIN_MATCHES else 0.0


def is_clearly_better(share: float, other: float) -> bool:
    """Whether a share of agreeing matches is clearly larger than that of another reading."""
    return share > other + _CLEARLY_BETTER and share > _TIMES_BETTER * other


class _Score:
    """Scores a correction by the matches that agree with the corrected cameras."""

    def __init__(self, raw: RawScan, matches: Matches) -> None:
        self._raw, self._matches = raw, matches

    def intrinsics(self, correction: Correction) -> NDArray[np.float64]:
        return self._raw.intrinsics if correction.intrinsics is None else correction.intrinsics

    def triangulate(self, correction: Correction) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
        poses = correction.apply(self._raw.stored)
        return triangulate(self._matches, poses, self.intrinsics(correction))

    def share(self, correction: Correction) -> float:
        return float(self.triangulate(correction)[0].mean())


def _axis_rotations() -> list[NDArray[np.float64]]:
    """Return the 24 rotations that map axes to axes, named ones first."""
    named = [np.eye(3), *(rotation for *_, rotation in _NAMED_ROTATIONS)]
    octahedral = Rotation.create_group("O").as_matrix().round() + 0.0
    others = [rotation for rotation in octahedral if not any(np.array_equal(rotation, n) for n in named)]
    return named + others


def _scaled_intrinsics(raw: RawScan) -> list[NDArray[np.float64]]:
    """Return candidates for intrinsics that are for another image size; none if the principal point fits.

    The size that they are for is twice the principal point, which may itself be off in a true camera: so one
    factor for both rows, from either side, is tried too, and the image centre with the focal length as it is.
    """
    height, width = raw.scan.image_size
    matrix = np.median(raw.intrinsics, axis=0)
    stated_width, stated_height = 2 * matrix[0, 2], 2 * matrix[1, 2]
    error = max(abs(stated_width / width - 1), abs(stated_height / height - 1))
    if min(stated_width, stated_height) <= 0 or error < _SAME:
        return []
    scale_x, scale_y = width / stated_width, height / stated_height
    factors = ((scale_x, scale_y), (scale_x, scale_x), (scale_y, scale_y))
    centered = raw.intrinsics.copy()
    centered[:, :2, 2] = width / 2, height / 2
    return [*(np.diag([x, y, 1.0]) @ raw.intrinsics for x, y in factors), centered]


def _with_better_intrinsics(best: Correction, scaled: list[NDArray[np.float64]], score: _Score) -> Correction:
    """Return ``best`` with scaled intrinsics or another focal length, whichever is clearly better."""
    best = _winner(best, [replace(best, intrinsics=matrix) for matrix in scaled], score)
    coarse = _winner(best, _with_focal_lengths(best, _FOCAL_FACTORS, score), score)
    if coarse is best:
        return best
    return max(_with_focal_lengths(coarse, _FINE_FACTORS, score), key=score.share)


def _with_focal_lengths(base: Correction, factors: NDArray, score: _Score) -> list[Correction]:
    focal = np.diag([1.0, 1.0, 0.0])
    matrix = score.intrinsics(base)
    return [replace(base, intrinsics=matrix * (1 + focal * (factor - 1))) for factor in factors.tolist()]


def _winner(current: Correction, candidates: Sequence[Correction], score: _Score) -> Correction:
    """Return the best candidate if it wins many more matches than it loses, else ``current``."""
    if not candidates:
        return current
    best = max(candidates, key=score.share)
    before, after = score.triangulate(current)[0], score.triangulate(best)[0]
    gained, lost = int((after & ~before).sum()), int((before & ~after).sum())
    wins = gained - lost > _NET_GAIN * len(before) and gained > _GAINED_PER_LOST * lost
    return best if wins else current


def _findings(
    raw: RawScan, best: Correction, count: int, stored: float, share: float
) -> tuple[Finding, Finding]:
    """Return the findings on camera axes and intrinsics.

    Args:
        raw: the scan.
        best: the reading that most matches agree with.
        count: number of matches.
        stored: share of them that agrees with the cameras as stored.
        share: share that agrees with ``best``.
    """
    text = f"{stored:.0%} of {count} points matched between frames agree with the cameras as stored"
    if share < _POOR:
        fix = "check that each pose file belongs to the image of its name and that the poses are accurate"
        text = f"{text}, and no other reading of them does better than {share:.0%}"
        return (
            Finding("camera axes", "fault", text, NO_READING, fix, "likely"),
            Finding("intrinsics", "unknown", "cannot be told while no reading of the poses agrees"),
        )
    with_fix = f"{text}, {share:.0%} after the change"
    confidence = "certain" if count >= _MANY_MATCHES and share > 2 * stored else "likely"
    if best.storage != "as stored" or not np.allclose(best.camera_rotation, np.eye(3)):
        axes = Finding("camera axes", "fault", with_fix, *_pose_advice(best), confidence)
    else:
        axes = Finding("camera axes", "ok", text if best.intrinsics is None else with_fix)
    if best.intrinsics is None:
        (fx, _, cx), (_, fy, cy), _ = np.median(raw.intrinsics, axis=0)
        fit = f"focal lengths {fx:.1f}, {fy:.1f} and centre {cx:.1f}, {cy:.1f} pixels fit"
        return axes, Finding("intrinsics", "ok", fit)
    advice = _intrinsics_advice(raw, best.intrinsics)
    return axes, Finding("intrinsics", "fault", with_fix, *advice, confidence)


def _pose_advice(best: Correction) -> tuple[str, str]:
    """Return cause and fix of poses that must be corrected."""
    advice = []
    if best.storage != "as stored":
        advice.append(_STORAGE_ADVICE[best.storage])
    if not np.allclose(best.camera_rotation, np.eye(3)):
        rows = best.camera_rotation.astype(int).tolist()
        unnamed = ("unusual camera axes", f"multiply each camera-to-world rotation from the right by {rows}")
        named = (
            (cause, fix)
            for cause, fix, rotation in _NAMED_ROTATIONS
            if np.allclose(rotation, best.camera_rotation)
        )
        advice.append(next(named, unnamed))
    causes, fixes = zip(*advice, strict=True)
    return " and ".join(causes), ", then ".join(fixes)


def _intrinsics_advice(raw: RawScan, corrected: NDArray[np.float64]) -> tuple[str, str]:
    """Return cause and fix of intrinsics that must be corrected, with the medians of all frames'."""
    height, width = raw.scan.image_size
    stored, right = np.median(raw.intrinsics, axis=0), np.median(corrected, axis=0)
    scale_x, scale_y = stored[0, 2] / right[0, 2], stored[1, 2] / right[1, 2]
    center_moved = max(abs(scale_x - 1), abs(scale_y - 1)) > _SAME
    if center_moved and abs(right[0, 0] / stored[0, 0] - 1) < _SAME:
        return (
            "wrong image centre",
            f"give cx, cy of about {right[0, 2]:.0f}, {right[1, 2]:.0f} instead of "
            f"{stored[0, 2]:.0f}, {stored[1, 2]:.0f} pixels, or calibrate",
        )
    if not center_moved:
        return (
            "wrong focal length",
            f"give fx, fy of about {right[0, 0]:.0f}, {right[1, 1]:.0f} instead of "
            f"{stored[0, 0]:.0f}, {stored[1, 1]:.0f} pixels, or calibrate",
        )
    return (
        "intrinsics for another image size",
        f"they are for images of about {scale_x * width:.0f}x{scale_y * height:.0f}, not {width}x{height}: "
        f"multiply their first row by {1 / scale_x:.4f} and their second by {1 / scale_y:.4f}",
    )
