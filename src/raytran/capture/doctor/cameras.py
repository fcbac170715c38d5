# SPDX-License-Identifier: Apache-2.0
"""Camera axes, inversion and intrinsics: the reading of the pose files that the images agree with."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import permutations, product
from typing import get_args

import numpy as np
from numpy.typing import NDArray

from raytran.capture.doctor.camera_findings import NAMED_TURNS, camera_findings
from raytran.capture.doctor.finding import Correction, Finding, Storage
from raytran.capture.doctor.matches import Matches, triangulate
from raytran.capture.doctor.recording import Recording

_FEWEST_MATCHES = 60

_CLEARLY_BETTER, _TIMES_BETTER = 0.15, 1.4
"""Other camera axes must win this share of all matches, and this many times as many as the stored ones."""

_NET_GAIN, _GAINED_PER_LOST = 0.06, 5
"""Other intrinsics must win this share of all matches, and this many for each that they lose."""

_FACTORS = np.geomspace(0.4, 2.5, 38)
"""Of the focal length: steps of five per cent, then of one."""


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
    jury = _Jury(recording, matches)
    if len(matches) < _FEWEST_MATCHES:
        findings = camera_findings(recording, Correction(), len(matches), None)
        nobody = np.zeros(len(matches))
        return CameraReading(Correction(), findings, nobody.astype(bool), nobody)
    scaled = _scaled_intrinsics(recording)
    candidates = [
        Correction(storage=storage, camera_turn=turn, intrinsics=intrinsics)
        for intrinsics in (None, *scaled)
        for storage, turn in product(get_args(Storage), _axis_turns())
    ]
    # The stored reading comes first, then plain ones: among equals the first is taken.
    best = max(candidates, key=lambda candidate: round(jury.share(candidate), 2))
    given = jury.share(Correction())
    if not (jury.share(best) > given + _CLEARLY_BETTER and jury.share(best) > _TIMES_BETTER * given):
        best = Correction()
    best = _with_better_intrinsics(replace(best, intrinsics=None), scaled, jury)
    agrees, depth = jury.hear(best)
    findings = camera_findings(recording, best, len(matches), (given, float(agrees.mean())))
    return CameraReading(best, findings, agrees, depth)


class _Jury:
    """The matches, asked which cameras they agree with."""

    def __init__(self, recording: Recording, matches: Matches) -> None:
        self._recording, self._matches = recording, matches

    def intrinsics(self, correction: Correction) -> NDArray[np.float64]:
        return self._recording.intrinsics if correction.intrinsics is None else correction.intrinsics

    def hear(self, correction: Correction) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
        poses = correction.apply(self._recording.stored)
        return triangulate(self._matches, poses, self.intrinsics(correction))

    def share(self, correction: Correction) -> float:
        return float(self.hear(correction)[0].mean())


def _axis_turns() -> list[NDArray[np.float64]]:
    """Return the 24 turns that map axes to axes, named ones first."""
    named = [np.eye(3), *(turn for *_, turn in NAMED_TURNS)]
    others = []
    for order, signs in product(permutations(range(3)), product((1.0, -1.0), repeat=3)):
        turn = np.eye(3)[:, order] * signs
        if np.linalg.det(turn) > 0 and not any(np.array_equal(turn, other) for other in named):
            others.append(turn)
    return named + others


def _scaled_intrinsics(recording: Recording) -> list[NDArray[np.float64]]:
    """Return the intrinsics scaled to the images from the size whose middle they name, if that is another.

    The middle may be off in a true camera: so one factor for both rows, from either side, is tried too; and
    the middle may be wrong by itself.
    """
    height, width = recording.scan.image_size
    matrix = recording.intrinsics
    wide, high = 2 * matrix[0, 2], 2 * matrix[1, 2]
    off = max(abs(wide / width - 1), abs(high / height - 1))
    if min(wide, high) <= 0 or off < 0.03:
        return []
    across, down = width / wide, height / high
    factors = ((across, down), (across, across), (down, down))
    centred = matrix.copy()
    centred[:2, 2] = width / 2, height / 2
    return [*(np.diag([x, y, 1.0]) @ matrix for x, y in factors), centred]


def _with_better_intrinsics(best: Correction, scaled: list[NDArray[np.float64]], jury: _Jury) -> Correction:
    """Return ``best`` with scaled intrinsics or another focal length, whichever is clearly better."""
    best = _winner(best, [replace(best, intrinsics=matrix) for matrix in scaled], jury)
    coarse = _winner(best, _focal_lengths(best, _FACTORS, jury), jury)
    if coarse is best:
        return best
    return max(_focal_lengths(coarse, np.linspace(0.95, 1.05, 11), jury), key=jury.share)


def _focal_lengths(reading: Correction, factors: NDArray, jury: _Jury) -> list[Correction]:
    focal = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 0.0]])
    matrix = jury.intrinsics(reading)
    return [replace(reading, intrinsics=matrix * (1 + focal * (factor - 1))) for factor in factors.tolist()]


def _winner(stands: Correction, challengers: list[Correction], jury: _Jury) -> Correction:
    """Return the best challenger if it wins many more matches than it loses, else ``stands``."""
    if not challengers:
        return stands
    best = max(challengers, key=jury.share)
    before, after = jury.hear(stands)[0], jury.hear(best)[0]
    gained, lost = int((after & ~before).sum()), int((before & ~after).sum())
    wins = gained - lost > _NET_GAIN * len(before) and gained > _GAINED_PER_LOST * lost
    return best if wins else stands
