# SPDX-License-Identifier: Apache-2.0
"""The world of the cameras: its unit, its up, and whether the model's volume holds the walk."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from raytran.capture.doctor.finding import Finding

_NEAR, _FAR = 0.3, 15.0
"""Metres between which the median distance of what an indoor video shows must lie."""

_TYPICAL = 2.5
"""Metres; the unit is the one that brings the median distance closest to this."""

_UNITS = {
    "centimetres": 0.01,
    "millimetres": 0.001,
    "kilometres": 1000.0,
    "feet": 0.3048,
    "inches": 0.0254,
}
_LIKELY_UNITS = ("centimetres", "millimetres", "kilometres")
"""Those that are guessed from the size of things alone; feet and inches need depth maps to be told."""

_TILTED_DEG, _WRONG_DEG = 12.0, 35.0
_OFF_AXIS_DEG = 15.0
"""Up within this angle of an axis of the world is taken for the axis."""

_MANY_OUTSIDE = 0.25
"""Share of cameras outside the volume that is a fault; a long walk has some."""


def check_unit(depth: NDArray[np.float64], measured: NDArray[np.float64] | None) -> tuple[float, Finding]:
    """Say in which unit positions are, from the distances of matched points.

    Args:
        depth: ``(n,)`` of points seen from two frames, unit of the poses.
        measured: ``(n,)`` metres, of the same points in depth maps, NaN where there is none; or None.

    Returns:
        metres per unit, and the finding.
    """
    if len(depth) < 30:
        return 1.0, Finding("unit", "unknown", "too few points were found again to tell distances")
    middle = float(np.median(depth))
    known = np.zeros(len(depth), dtype=bool) if measured is None else np.isfinite(measured)
    if measured is not None and known.sum() >= 20:
        scale = float(np.median(measured[known] / depth[known]))
        seen = (
            f"distances from the poses times {scale:.3g} are those of the depth maps ({known.sum()} points)"
        )
        if 0.8 < scale < 1.25:
            return 1.0, Finding("unit", "ok", f"{seen}; what is seen is {middle:.1f} m away in the median")
    else:
        seen = f"what is seen is {middle:.3g} units away in the median"
        if _NEAR < middle < _FAR:
            return 1.0, Finding("unit", "ok", f"{seen}, as metres would have it")
        scale = min(
            (_UNITS[name] for name in _LIKELY_UNITS),
            key=lambda value: abs(math.log(middle * value / _TYPICAL)),
        )
    names = [name for name, value in _UNITS.items() if abs(math.log(scale / value)) < 0.2]
    names = [name for name in names if _NEAR < middle * _UNITS[name] < _FAR]
    metres = _UNITS[names[0]] if names else scale if known.sum() >= 20 else _TYPICAL / middle
    return metres, Finding(
        "unit",
        "fault",
        seen,
        f"positions in {names[0]}" if names else "positions in no known unit",
        f"multiply the last column of each camera-to-world matrix by {metres:.4g}",
        "certain" if known.sum() >= 20 else "likely",
    )


def measured_up(world_from_camera: NDArray[np.float64]) -> tuple[NDArray[np.float64] | None, bool]:
    """Return where up is, supposing that cameras are held level and turn about.

    The direction to which all image rows are at right angles is up, signed by the images' tops; where the
    camera hardly turns the mean of the tops alone must do, and a camera that looks down tilts it.

    Returns:
        ``(3,)`` of length one, or None if it cannot be told; and whether the cameras turn about.
    """
    right, top = world_from_camera[:, :3, 0], -world_from_camera[:, :3, 1]
    mean = top.mean(axis=0)
    spread, axes = np.linalg.eigh(right.T @ right / len(right))
    if spread[1] > 0.05 and spread[0] < 0.25 * spread[1]:
        return axes[:, 0] * np.sign(axes[:, 0] @ mean or 1.0), True
    length = float(np.linalg.norm(mean))
    return (mean / length if length > 0.5 else None), False


def check_up(world_from_camera: NDArray[np.float64]) -> tuple[NDArray[np.float64] | None, Finding]:
    """Say whether up is +z; see ``measured_up``.

    Returns:
        ``(3, 3)`` the turn that takes up to +z, or None if it is there or cannot be told; and the finding.
    """
    up, turns_about = measured_up(world_from_camera)
    if up is None:
        return None, Finding("up", "unknown", "cameras are turned in all ways, so up cannot be told")
    off = math.degrees(math.acos(float(np.clip(up[2], -1, 1))))
    seen = f"up by the cameras is ({up[0]:+.2f}, {up[1]:+.2f}, {up[2]:+.2f}), {off:.0f}° from +z"
    nearest = int(np.abs(up).argmax())
    axis = np.eye(3)[nearest] * np.sign(up[nearest])
    if off < _TILTED_DEG:
        return None, Finding("up", "ok", seen)
    if not turns_about and axis[2] > 0:
        return None, Finding("up", "ok", f"{seen}, as far as cameras that look one way can tell")
    if off < _WRONG_DEG:
        text = f"{seen}: objects are taken to stand upright, so turn the world if it leans"
        return None, Finding("up", "note", text)
    return _wrong_up(up, axis, seen, "certain" if turns_about else "likely")


def _wrong_up(up: NDArray, axis: NDArray, seen: str, sure: str) -> tuple[NDArray[np.float64], Finding]:
    if up @ axis > math.cos(math.radians(_OFF_AXIS_DEG)):
        turn = turn_to_z(axis)
        cause = f"wrong up ({'-' if axis.sum() < 0 else '+'}{'xyz'[int(np.abs(axis).argmax())]})"
        rows = str(turn.astype(int).tolist())
    else:
        turn, cause = turn_to_z(up), "world not level"
        rows = str(turn.round(4).tolist())
    fix = f"multiply rotation and position of each camera-to-world matrix from the left by {rows}"
    return turn, Finding("up", "fault", seen, cause, fix, sure)


def turn_to_z(direction: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the ``(3, 3)`` smallest turn that takes a direction of length one to +z; -z turns about x."""
    z = np.array([0.0, 0.0, 1.0])
    if direction @ z < -0.9999:
        return np.diag([1.0, -1.0, -1.0])
    v = np.cross(direction, z)
    cross = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
    return np.eye(3) + cross + cross @ cross / (1 + direction @ z)


def check_volume(
    positions: NDArray[np.float64], centers: NDArray[np.float64], extent: tuple[float, float, float]
) -> Finding:
    """Say whether the volume, centred on the mean camera, holds the cameras and the objects.

    Args:
        positions: ``(n, 3)`` of the cameras, metres.
        centers: ``(M, 3)`` of the objects.
        extent: of the volume.
    """
    half, middle = np.array(extent) / 2, positions.mean(axis=0)
    cameras = int((np.abs(positions - middle) > half).any(axis=1).sum())
    objects = int((np.abs(centers - middle) > half).any(axis=1).sum()) if len(centers) else 0
    span = " x ".join(f"{size:.1f}" for size in np.ptp(positions, axis=0))
    size = " x ".join(f"{length:g}" for length in extent)
    text = f"{cameras} of {len(positions)} cameras (their path spans {span} m)"
    text += f" and {objects} of {len(centers)} objects" if len(centers) else ""
    text += f" are outside the volume of {size} m"
    if cameras > _MANY_OUTSIDE * len(positions) or (objects > len(centers) / 2):
        cause = (
            "cameras outside the volume"
            if cameras > _MANY_OUTSIDE * len(positions)
            else "objects outside the volume"
        )
        fix = "predict on parts of the walk, or give a model a larger model.grid_extent"
        if cause.startswith("objects"):
            fix = "check that annotation and poses share one world; if so, use frames near the objects"
        return Finding("volume", "fault", text, cause, fix, "certain")
    return Finding("volume", "note" if cameras or objects else "ok", text)
