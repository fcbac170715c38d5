# SPDX-License-Identifier: Apache-2.0
"""Camera axes, up and unit of a scan: measured from cameras and images, checked, and brought to ours.

Ours are OpenCV axes, +z up, metres. The data doctor reports what these measurements say (``check_up``,
``check_unit``); ``predict`` applies it to scans of any format (``to_our_world``).
"""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import get_args

import numpy as np
import torch
from numpy.typing import NDArray

from raytran.capture.doctor.cameras import agreement, check_cameras, is_clearly_better
from raytran.capture.doctor.finding import Finding
from raytran.capture.doctor.matches import Matches, match_frames
from raytran.capture.exif import described, is_shown_by_up, read_the_other_way, sides_of_up, tags_of
from raytran.capture.frames import RawScan, read_grey
from raytran.capture.recording import Axes
from raytran.data.images import box_within, fill_up
from raytran.data.scan import OpenScan
from raytran.errors import ConfigError

_log = logging.getLogger(__name__)

UPS = ("auto", "+x", "-x", "+y", "-y", "+z", "-z")
CONVENTIONS = ("auto", *get_args(Axes))

OPENGL = np.diag([1.0, -1.0, -1.0])
"""Rotates OpenGL camera axes into OpenCV's, and back."""

_FEW_FRAMES = 8
_MIN_WALK, _MAX_WALK = 0.1, 200.0
"""Metres between which the diagonal of the cameras' positions lies in a room."""

_TILTED_DEG, _WRONG_DEG = 12.0, 35.0
"""Angles between up and an axis of the world: below the first it is the axis for certain, below the second it
is if the cameras look one way, which tilts what they tell of up."""

_STEEP_DEG = 65.0
"""Angle between +z and the tops of cameras that look one way within which +z may be up."""

_OFF_AXIS_DEG = 15.0
"""Angle from another axis within which the doctor calls a wrong up by the name of that axis."""

_NEAR, _FAR = 0.3, 15.0
"""Metres between which the median distance of what an indoor video shows must lie."""

_TYPICAL_DISTANCE = 2.5
"""Metres; without depth maps the unit is the one that brings the median distance closest to this."""

_UNITS = {
    "centimetres": 0.01,
    "millimetres": 0.001,
    "kilometres": 1000.0,
    "feet": 0.3048,
    "inches": 0.0254,
}
_LIKELY_UNITS = ("centimetres", "millimetres", "kilometres")
"""Those that are guessed from distances alone; feet and inches need depth maps to be told from metres."""

_FEWEST_DISTANCES, _FEWEST_MEASURED = 30, 20
_SIDEWAYS = 0.5
"""Smallest mean of cos(angle between up and a side of the image) for which up is at that side."""

_LEAST_REACH = 0.4
"""Smallest mean of |cos| between an axis of level cameras and the images' columns, or rows if they lie on
their side: they do not all look straight up or down."""

_TURNED_FAR = 0.2
"""Spread of the level columns from which cameras lie on their side and look about; nodding has less."""

_NODDED = 0.1
"""The same below which level rows may be from nodding, of images that lie on their side by what files say."""

_LOOKS_DOWN = 0.08
"""Mean of cos(angle between where cameras look and the axis of up) from which they look down and not up."""

_FAR_ACROSS, _LEVEL_WALK = 0.2, 0.4
"""A walk tells up if it goes across by the first part of its extent, and rises by the second part of that."""

_MIXED_CAMERAS = 40
_MIXED_TILT = 0.01
"""Mean square of the tilt of level cameras of which some lie on their side; 0.1 rad in the mean."""
_FEWEST_MIXED = 0.15
"""Least share of those that lie on their side, and of the others; fewer do not hide which way is up."""

_TWO_WAYS = 0.75
"""Least share of the images that are held one of two ways, if each is turned by itself."""

_NEARLY_SIDEWAYS = 0.2
"""Cosine between +z and the tops of cameras which look one way from which they may look steeply down."""


@dataclass(frozen=True, kw_only=True)
class WorldSettings:
    """What a user says about a scan's world; the defaults leave it to the format and the images.

    Attributes:
        up: direction of up in the scan's world: one of ``UPS``, or a vector of three numbers, or the text
            ``x,y,z``.
        scale: metres in a unit of its positions; None: as the format promises, else one.
        convention: its camera axes, one of ``CONVENTIONS``.
        check: whether points are matched between images to check axes and unit.

    Raises:
        ConfigError: a value is unknown.
    """

    up: str | Sequence[float] = "auto"
    scale: float | None = None
    convention: str = "auto"
    check: bool = True

    def __post_init__(self) -> None:
        _direction(self.up)
        if self.convention not in CONVENTIONS:
            raise ConfigError(f"unknown convention={self.convention}: choose one of {', '.join(CONVENTIONS)}")
        if self.scale is not None and not (math.isfinite(self.scale) and self.scale > 0):
            raise ConfigError(f"scale={self.scale} is no positive number: give the metres in a unit")

    @property
    def direction(self) -> NDArray[np.float64] | None:
        """``(3,)`` direction of up, of length one; None: the format or the cameras tell it."""
        return _direction(self.up)


def _direction(up: object) -> NDArray[np.float64] | None:
    """Return the unit vector that ``up=`` asks for; None for ``auto``.

    Raises:
        ConfigError: it is none.
    """
    if isinstance(up, str) and up == "auto":
        return None
    if isinstance(up, str) and up in UPS[1:]:
        return (-1.0 if up[0] == "-" else 1.0) * np.eye(3)["xyz".index(up[1])]
    shown = str(up)[:60]
    words = up.strip("[]() ").replace(",", " ").split() if isinstance(up, str) else up
    try:
        vector = np.array([float(word) for word in words], dtype=np.float64)  # type: ignore[attr-defined]
    except (TypeError, ValueError, OverflowError):
        vector = np.zeros(0)
    if vector.shape != (3,):
        raise ConfigError(
            f"unknown up={shown}: choose one of {', '.join(UPS)}, or give a direction such as up=0.1,0.2,0.97"
        )
    largest = float(np.abs(vector).max())
    if not (math.isfinite(largest) and largest > 0):
        raise ConfigError(f"up={shown} is no direction: give three finite numbers that are not all zero")
    vector = vector / largest
    return vector / float(np.linalg.norm(vector))


@dataclass(frozen=True)
class MeasuredUp:
    """Where up is by the cameras.

    Attributes:
        direction: ``(3,)`` of length one.
        is_level: whether the cameras look about, so that the axis of up is certain; otherwise it is tilted as
            far as they look up or down.
        is_side_known: whether it is certain at which side of the images up is.
    """

    direction: NDArray[np.float64]
    is_level: bool
    is_side_known: bool = True


@dataclass(frozen=True)
class _LevelAxis:
    """The direction to which some axes of all cameras are at right angles.

    Attributes:
        direction: ``(3,)`` of length one, with either sign.
        spread: mean square of what those axes have along it, over that of the direction next to it.
        turn: that mean square, large if the cameras were turned far about it.
        reach: mean of what the other axes have along it, whatever their sign.
    """

    direction: NDArray[np.float64]
    spread: float
    turn: float
    reach: float


def measured_up(
    world_from_camera: NDArray[np.float64], *, sides: Sequence[int] | None = None, tops_tell: bool = True
) -> MeasuredUp | None:
    """Measure where up is, supposing that cameras are held level, upright or on their side, and look about.

    The image rows of a level camera are horizontal, or its columns if it lies on its side; so up is the
    direction at right angles to all rows, or to all columns: the eigenvector of their smallest spread. Its
    sign is that of the images' tops; for cameras on their side, that of ``sides``, or else the one with which
    they look down on the whole, as people do in rooms. Where cameras look one way that direction is not
    determined: then the mean of the upper sides is taken, which a camera that looks down tilts.

    Args:
        world_from_camera: ``(n, 4, 4)`` in OpenCV axes.
        sides: at which side of each image up is by its file: top, right, bottom or left, 0 to 3.
        tops_tell: whether images are more likely upright than on their heads.

    Returns:
        None if it cannot be told.
    """
    if sides is not None:
        hinted = _turned_about_view(world_from_camera, sides)
        rows = _level_axis(hinted[:, :3, 0], hinted[:, :3, 1])
        plain = _level_axis(world_from_camera[:, :3, 0], world_from_camera[:, :3, 1])
        if rows is not None and not (plain and plain.spread < rows.spread and plain.reach > rows.reach):
            return MeasuredUp(_towards(rows.direction, -hinted[:, :3, 1].mean(axis=0)), is_level=True)
        if plain is None or plain.turn < _NODDED or plain.reach < _LEAST_REACH:
            return _mean_top(hinted)
        # A program that turned the pixels has left the tags: the images are level as they are.
    right, down, forward = (world_from_camera[:, :3, axis] for axis in range(3))
    level, lies = _axis_of_up(world_from_camera)
    if level is None or lies:
        mixed = _mixed_axis(right, down, math.inf if level is None else level.spread * level.turn)
        if mixed is not None:
            return MeasuredUp(mixed, is_level=True)
    if level is not None:
        axis = level.direction
        upper_side = (-right if lies else -down).mean(axis=0)
        if tops_tell and not lies:
            return MeasuredUp(_towards(axis, upper_side), is_level=True)
        # Phones that are held upright mostly store images whose left side is up.
        looks_down = abs(float(axis @ forward.mean(axis=0))) > _LOOKS_DOWN
        direction = -forward.mean(axis=0) if looks_down else upper_side
        return MeasuredUp(_towards(axis, direction), is_level=True, is_side_known=False)
    return _mean_top(world_from_camera)


def _mean_top(world_from_camera: NDArray[np.float64]) -> MeasuredUp | None:
    """Return the mean of the images' tops as up, or None if they point in all directions."""
    mean = -world_from_camera[:, :3, 1].mean(axis=0)
    length = float(np.linalg.norm(mean))
    return MeasuredUp(mean / length, is_level=False) if length > 0.5 else None


def _axis_of_up(world_from_camera: NDArray[np.float64]) -> tuple[_LevelAxis | None, bool]:
    """Return the axis of up of level cameras, and whether they lie on their side."""
    right, down = world_from_camera[:, :3, 0], world_from_camera[:, :3, 1]
    rows, columns = _level_axis(right, down), _level_axis(down, right)
    if rows is not None and columns is not None and rows.reach < _LEAST_REACH:
        rows = None
    if columns is None or columns.reach < _LEAST_REACH:
        return rows, False
    if rows is not None:
        lies = columns.spread < 0.2 * rows.spread and rows.spread > 0.05
    else:
        # Cameras that look one way and nod have level columns too; but people walk on a floor.
        lies = columns.turn > _TURNED_FAR or _walks_across(world_from_camera, columns.direction)
    return (columns, True) if lies else (rows, False)


def _level_axis(level: NDArray[np.float64], other: NDArray[np.float64]) -> _LevelAxis | None:
    """Return the direction at right angles to all axes ``level`` ``(n, 3)``, if there is just one."""
    spread, axes = np.linalg.eigh(level.T @ level / len(level))
    if not (spread[1] > 0.05 and spread[0] < 0.25 * spread[1]):
        return None
    direction = axes[:, 0]
    reach = float(np.abs(other @ direction).mean())
    return _LevelAxis(direction, float(spread[0] / spread[1]), float(spread[1]), reach)


def _walks_across(world_from_camera: NDArray[np.float64], axis: NDArray[np.float64]) -> bool:
    """Whether cameras move much less along an axis than along the mean of their images' columns."""
    position = world_from_camera[:, :3, 3] - world_from_camera[:, :3, 3].mean(axis=0)
    columns = world_from_camera[:, :3, 1].mean(axis=0)
    along_axis, along_columns = position @ axis, position @ columns
    is_far = along_columns.std() > _FAR_ACROSS * np.linalg.norm(position.std(axis=0))
    return bool(is_far and along_axis.std() < _LEVEL_WALK * along_columns.std())


def _mixed_axis(
    right: NDArray[np.float64], down: NDArray[np.float64], tilt: float
) -> NDArray[np.float64] | None:
    """Return up of cameras of which some are upright and others on their side; None if it cannot be told.

    Of the directions at right angles to an axis of each of two cameras, that one is taken to which a row or a
    column of all cameras is nearest to a right angle.

    Args:
        right: ``(n, 3)`` direction of the rows of each image.
        down: ``(n, 3)`` direction of its columns.
        tilt: mean square of the tilt if all lie on their side, which must be clearly more than if some do.
    """
    if len(right) < _FEW_FRAMES:
        return None
    some = np.unique(np.linspace(0, len(right) - 1, min(len(right), _MIXED_CAMERAS)).round().astype(int))
    right, down = right[some], down[some]
    axes = np.concatenate([right, down])
    first, second = np.triu_indices(len(axes), 1)
    candidates = np.cross(axes[first], axes[second])
    length = np.linalg.norm(candidates, axis=1)
    candidates = candidates[length > 0.3] / length[length > 0.3, None]
    # (cameras, candidates): what each image's rows and columns have along each candidate.
    rows, columns = np.abs(right @ candidates.T), np.abs(down @ candidates.T)
    error = (np.minimum(rows, columns) ** 2).mean(axis=0)
    error[np.maximum(rows, columns).mean(axis=0) < _LEAST_REACH] = np.inf
    best = int(error.argmin())
    is_upright = rows[:, best] < columns[:, best]
    level = np.where(is_upright[:, None], right, down)
    turn = np.linalg.eigvalsh(level.T @ level / len(level))[1]
    is_mixed = _FEWEST_MIXED < is_upright.mean() < 1 - _FEWEST_MIXED
    if not is_mixed or turn < 0.05 or error[best] > min(_MIXED_TILT, 0.25 * tilt):
        return None
    return _towards(candidates[best], -down[is_upright].mean(axis=0))


def _towards(axis: NDArray[np.float64], direction: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the axis with the sign that has it point along a direction."""
    return axis * np.sign(axis @ direction or 1.0)


def _turned_about_view(world_from_camera: NDArray[np.float64], sides: Sequence[int]) -> NDArray[np.float64]:
    """Return the cameras of images that were turned so that the given sides are at the top."""
    poses = world_from_camera.copy()
    x, y = world_from_camera[:, :3, 0], world_from_camera[:, :3, 1]
    side = np.array(sides)[:, None]
    poses[:, :3, 0] = np.select([side == 1, side == 2, side == 3], [y, -x, -y], x)
    poses[:, :3, 1] = np.select([side == 1, side == 2, side == 3], [-x, -y, x], y)
    return poses


def rotation_to_z(direction: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the smallest rotation ``(3, 3)`` that takes a unit vector to +z (Rodrigues); -z goes about x."""
    z = np.array([0.0, 0.0, 1.0])
    if direction @ z < -0.9999:
        return np.diag([1.0, -1.0, -1.0])
    v = np.cross(direction, z)
    cross = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
    return np.eye(3) + cross + cross @ cross / (1 + direction @ z)


def check_up(world_from_camera: NDArray[np.float64]) -> tuple[NDArray[np.float64] | None, Finding]:
    """Check that up is +z; see ``measured_up``.

    Args:
        world_from_camera: ``(n, 4, 4)`` in OpenCV axes.

    Returns:
        The rotation ``(3, 3)`` that takes up to +z, None if it is there or cannot be told; and the finding.
    """
    measured = measured_up(world_from_camera)
    if measured is None:
        return None, Finding("up", "unknown", "cameras are turned in all ways, so up cannot be told")
    up = measured.direction
    if not measured.is_side_known and up[2] < 0:
        up = -up
    angle = math.degrees(math.acos(float(np.clip(up[2], -1, 1))))
    text = f"up by the cameras is ({up[0]:+.2f}, {up[1]:+.2f}, {up[2]:+.2f}), {angle:.0f}° from +z"
    side = np.bincount(sides_of_up(world_from_camera, up) + 1, minlength=5).argmax() - 1
    if side > 0:
        text = f"{text}; most images lie on their {'head' if side == 2 else 'side'}"
    axis = _nearest_axis(up)
    if angle < _TILTED_DEG:
        return None, Finding("up", "note" if side > 0 else "ok", text)
    if not measured.is_level and up[2] > _NEARLY_SIDEWAYS:
        return None, Finding("up", "ok", f"{text}, as far as cameras that look one way can tell")
    if not measured.is_level and up[2] > -_SIDEWAYS:
        text = f"{text}, unsure, for they look one way: their images may lie on their side, or the world"
        return None, Finding("up", "note", text)
    if angle < _WRONG_DEG:
        text = f"{text}: objects are taken to stand upright, so turn the world if it leans"
        return None, Finding("up", "note", text)
    if up @ axis > math.cos(math.radians(_OFF_AXIS_DEG)):
        rotation = rotation_to_z(axis)
        cause = f"wrong up ({_axis_name(axis)})"
        rows = str(rotation.astype(int).tolist())
    else:
        rotation = rotation_to_z(up)
        cause = "world not level"
        rows = str(rotation.round(4).tolist())
    fix = f"multiply rotation and position of each camera-to-world matrix from the left by {rows}"
    return rotation, Finding("up", "fault", text, cause, fix, "certain" if measured.is_level else "likely")


def check_unit(depth: NDArray[np.float64], measured: NDArray[np.float64] | None) -> tuple[float, Finding]:
    """Check that positions are in metres, from the distances of matched points.

    Args:
        depth: ``(n,)`` of points seen from two frames, unit of the poses.
        measured: ``(n,)`` metres, of the same points in depth maps, NaN where there is none; or None.

    Returns:
        Metres per unit, and the finding.
    """
    if len(depth) < _FEWEST_DISTANCES:
        return 1.0, Finding("unit", "unknown", "too few points were found again to tell distances")
    median = float(np.median(depth))
    in_maps = np.zeros(len(depth), dtype=bool) if measured is None else np.isfinite(measured)
    has_maps = measured is not None and int(in_maps.sum()) >= _FEWEST_MEASURED
    if measured is not None and has_maps:
        scale = float(np.median(measured[in_maps] / depth[in_maps]))
        text = (
            f"distances from the poses times {scale:.3g} are those of the depth maps ({in_maps.sum()} points)"
        )
        if 0.8 < scale < 1.25:
            return 1.0, Finding("unit", "ok", f"{text}; what is seen is {median:.1f} m away in the median")
    else:
        text = f"what is seen is {median:.3g} units away in the median"
        if _NEAR < median < _FAR:
            return 1.0, Finding("unit", "ok", f"{text}, as metres would have it")
        likely = [_UNITS[name] for name in _LIKELY_UNITS]
        scale = min(likely, key=lambda unit: abs(math.log(median * unit / _TYPICAL_DISTANCE)))
    # A named unit must explain the scale and put things at distances of a room.
    names = [
        name
        for name, unit in _UNITS.items()
        if abs(math.log(scale / unit)) < 0.2 and _NEAR < median * unit < _FAR
    ]
    unnamed = scale if has_maps else _TYPICAL_DISTANCE / median
    metres = _UNITS[names[0]] if names else unnamed
    return metres, Finding(
        "unit",
        "fault",
        text,
        f"positions in {names[0]}" if names else "positions in no known unit",
        f"multiply the last column of each camera-to-world matrix by {metres:.4g}",
        "certain" if has_maps else "likely",
    )


def to_our_world(
    scan: OpenScan,
    settings: WorldSettings,
    *,
    axes: Axes = "opencv",
    up: tuple[float, float, float] | None = None,
    metric: bool = True,
    aligned: bool = False,
) -> OpenScan:
    """Return the scan in OpenCV axes, metres and a world whose +z is up; what was decided is logged.

    Camera axes are corrected where the images show others. Up is what the user says, else what the format
    promises, else what the cameras show; images stored on their side or head are turned by it. A unit
    that cannot be metres is only reported.

    Args:
        scan: as its reader returned it.
        settings: what the user says.
        axes: camera axes of the format.
        up: direction of up that the format promises, or None.
        metric: whether the format promises metres.
        aligned: whether its worlds mostly have an axis that is up.
    """
    convention = axes if settings.convention == "auto" else settings.convention
    if convention == "opengl":
        scan = _transformed(scan, camera_rotation=OPENGL)
    if settings.scale is not None:
        scan = _transformed(scan, scale=settings.scale)
    if len(scan) < _FEW_FRAMES:
        _log.warning(
            "%s: only %d frames have an image and a pose, from which little can be seen: "
            "give 20 or more that show the room from all sides",
            scan.scene_id,
            len(scan),
        )
    known = settings.direction
    if known is None and up is not None:
        known = np.array(up, dtype=np.float64)
    distance, tops_tell = None, True
    if settings.check:
        scan, matches = _read_as_images_agree(scan, known)
        scan, distance, tops_tell = _with_checked_cameras(scan, matches, settings, convention)
    else:
        scan = _read_as_up_agrees(scan, known)
    scan = _with_z_up(scan, settings.direction, up, tops_tell=tops_tell, aligned=aligned)
    _check_scale(scan, settings, metric, distance)
    return scan


def _read_as_images_agree(scan: OpenScan, up: NDArray[np.float64] | None) -> tuple[OpenScan, Matches]:
    """Return the scan with its images read as shown or stored, as they agree with the poses; and matches."""
    matches = _matches(scan)
    other = read_the_other_way(scan)
    if other is None:
        return _read_as_up_agrees(scan, up), matches
    matches_of_other = _matches(other)
    share = agreement(RawScan.of(scan), matches)
    share_of_other = agreement(RawScan.of(other), matches_of_other)
    if is_clearly_better(share_of_other, share):
        _say_how_tags_are_read(other, "as the images agree with the poses")
        return other, matches_of_other
    if is_clearly_better(share, share_of_other):
        _say_how_tags_are_read(scan, "as the images agree with the poses")
        return scan, matches
    read = _read_as_up_agrees(scan, up)
    return read, matches if tags_of(read) == tags_of(scan) else matches_of_other


def _matches(scan: OpenScan) -> Matches:
    picture = None if scan.picture is None else scan.picture.numpy()
    return match_frames(partial(read_grey, scan), len(scan), picture=picture)


def _read_as_up_agrees(scan: OpenScan, up: NDArray[np.float64] | None) -> OpenScan:
    """Return the scan with its images read as shown or as stored: as up has it, if up tells."""
    tags, other = tags_of(scan), read_the_other_way(scan)
    if tags is None:
        return scan
    how = "as programs of its format do"
    is_shown = None if up is None or other is None else is_shown_by_up(scan, up)
    if is_shown is not None and other is not None:
        how = "as up in their poses has it"
        if is_shown != any(tags.applied):
            scan = other
    elif other is None:
        how = "as their intrinsics have it"
    _say_how_tags_are_read(scan, how)
    return scan


def _say_how_tags_are_read(scan: OpenScan, how: str) -> None:
    tags = tags_of(scan)
    if tags is not None:
        what = "shown" if any(tags.applied) else "stored"
        text = "%s: %s by what their files say; poses are taken to be those of the images as %s, %s"
        _log.info(text, scan.scene_id, described(tags), what, how)


def _with_checked_cameras(
    scan: OpenScan, matches: Matches, settings: WorldSettings, convention: str
) -> tuple[OpenScan, float | None, bool]:
    """Return the scan with the camera axes that its images agree with.

    Returns:
        the scan, the median distance that its images show, and whether images are likely upright: not where
        they were turned against their poses.
    """
    reading = check_cameras(RawScan.of(scan), matches)
    correction = reading.correction
    rotation = correction.camera_rotation
    is_opengl = correction.storage == "as stored" and np.allclose(rotation, OPENGL)
    is_about_view = correction.storage == "as stored" and rotation[2, 2] == 1.0 and not is_opengl
    other = "opengl" if convention == "opencv" else "opencv"
    tops_tell = True
    for finding in reading.findings:
        if finding.state != "fault":
            continue
        about_axes = finding.check == "camera axes" and (is_opengl or is_about_view)
        if about_axes and settings.convention == "auto":
            degrees = round(math.degrees(math.atan2(rotation[1, 0], rotation[0, 0]))) % 360
            seen = other if is_opengl else f"turned by {degrees}° about where the camera looks"
            _log.warning(
                "%s: camera axes are %s, not %s as the format has it (%s); convention=%s would keep them",
                scan.scene_id,
                seen,
                convention,
                finding.text,
                convention,
            )
            scan = _transformed(scan, camera_rotation=rotation)
            tops_tell = is_opengl
        else:
            fix = f"give convention={other}" if about_axes and is_opengl else finding.fix
            _log.warning("%s: %s: %s; %s", scan.scene_id, finding.cause, finding.text, fix)
    depth = reading.depth[reading.agrees]
    if len(depth) < _FEWEST_DISTANCES:
        return scan, None, tops_tell
    metres, unit = check_unit(depth, None)
    if unit.state == "fault":
        _log.warning(
            "%s: %s: %s; nothing is scaled: give scale=%.3g if that is right",
            scan.scene_id,
            unit.cause,
            unit.text,
            (settings.scale or 1.0) * metres,
        )
    return scan, float(np.median(depth)), tops_tell


def _with_z_up(
    scan: OpenScan,
    asked: NDArray[np.float64] | None,
    promised: tuple[float, float, float] | None,
    *,
    tops_tell: bool,
    aligned: bool,
) -> OpenScan:
    """Return the scan in a world whose +z is up, with images turned that lie on their side or head.

    A world of which up is promised is turned to +z exactly, whatever the cameras say; what they say certainly
    against it is reported.
    """
    tags = tags_of(scan)
    sides = None if tags is None else tags.sides
    measured = measured_up(scan.world_from_camera.double().numpy(), sides=sides, tops_tell=tops_tell)
    if asked is not None:
        up, how = asked, "as up= says"
    elif promised is not None:
        up, how = np.array(promised, dtype=np.float64), "as the format has it"
        _doubt(scan, up, measured)
    elif measured is None:
        _log.warning(
            "%s: cameras are turned in all ways, so up cannot be told; it is taken to be +z: give up=",
            scan.scene_id,
        )
        return scan
    else:
        up = _likely_up(measured, aligned)
        how = f"measured from the cameras, {_certainty(measured)}"
    log = _log.info if up[2] == 1.0 else _log.warning
    log("%s: up is %s (%s); up= would override it", scan.scene_id, _axis_name(up), how)
    upright = rotate_upright(scan, up)
    if upright is not scan:
        _log.info("%s: images are stored sideways or on their heads and get turned", scan.scene_id)
    return upright if up[2] == 1.0 else _transformed(upright, world_rotation=rotation_to_z(up))


def _likely_up(measured: MeasuredUp, aligned: bool) -> NDArray[np.float64]:
    """Return the measured direction, or the axis of the world that it is likely to mean."""
    axis = _nearest_axis(measured.direction)
    tolerance = _TILTED_DEG if measured.is_level else _WRONG_DEG
    if measured.direction @ axis > math.cos(math.radians(tolerance)):
        return axis
    if measured.is_level or not aligned:
        return measured.direction
    # Cameras that look one way and steeply down tell nothing against a world that is level.
    looks_down = measured.direction[2] > math.cos(math.radians(_STEEP_DEG))
    return np.array([0.0, 0.0, 1.0]) if looks_down else axis


def _certainty(measured: MeasuredUp) -> str:
    if not measured.is_level:
        return "unsure, for they look one way"
    if measured.is_side_known:
        return "certain"
    return "unsure which side of the images it is: it is taken that they look down rather than up"


def _doubt(scan: OpenScan, promised: NDArray[np.float64], measured: MeasuredUp | None) -> None:
    """Warn of cameras that certainly have another up than the format promises."""
    if measured is None or not measured.is_level:
        return
    along = abs(float(measured.direction @ promised))  # Images may stand on their heads.
    if along < math.cos(math.radians(_WRONG_DEG)):
        axis = _nearest_axis(measured.direction)
        seen = axis if measured.direction @ axis > math.cos(math.radians(_TILTED_DEG)) else measured.direction
        _log.warning(
            "%s: up is %s by the cameras, not %s as the format has it, which is kept: give up=%s if the "
            "cameras are right",
            scan.scene_id,
            _axis_name(seen),
            _axis_name(promised),
            _axis_name(seen).strip("()").replace(" ", "").replace(",+", ","),
        )


def _check_scale(scan: OpenScan, settings: WorldSettings, metric: bool, distance: float | None) -> None:
    """Warn of a walk that is no walk through a room in metres, and of a unit that nothing tells."""
    positions = scan.world_from_camera[:, :3, 3]
    span = positions.amax(dim=0) - positions.amin(dim=0)
    walk = float(span.norm())
    if not _MIN_WALK < walk < _MAX_WALK:
        _log.warning(
            "%s: the cameras lie %.3g m apart, no walk through a room: give scale= (metres in a unit), or "
            "another video",
            scan.scene_id,
            walk,
        )
    elif not metric and settings.scale is None:
        seen = "" if distance is None else f" and what they see is {distance:.2g} units away"
        _log.warning(
            "%s: this format does not tell the unit and one metre is supposed; cameras then rise and fall by "
            "%.2g m, their path spans %.2g x %.2g m%s: give scale= (metres in a unit) if that is wrong",
            scan.scene_id,
            span[2],
            span[0],
            span[1],
            seen,
        )


def _nearest_axis(up: NDArray[np.float64]) -> NDArray[np.float64]:
    index = int(np.abs(up).argmax())
    return np.eye(3)[index] * np.sign(up[index])


def _axis_name(up: NDArray[np.float64]) -> str:
    """Return e.g. ``-y``, or the numbers of a direction that is no axis."""
    index = int(np.abs(up).argmax())
    if abs(up[index]) == 1.0:
        return f"{'-' if up[index] < 0 else '+'}{'xyz'[index]}"
    return f"({up[0]:+.2f}, {up[1]:+.2f}, {up[2]:+.2f})"


def _transformed(
    scan: OpenScan,
    *,
    world_rotation: NDArray[np.float64] | None = None,
    camera_rotation: NDArray[np.float64] | None = None,
    scale: float = 1.0,
) -> OpenScan:
    """Return the scan with positions scaled, then cameras rotated about themselves, then with the world."""
    poses = scan.world_from_camera.double().clone()
    alignment = scan.axis_alignment.double().clone()
    poses[:, :3, 3] *= scale
    alignment[:3, 3] *= scale
    if camera_rotation is not None:
        poses[:, :3, :3] = poses[:, :3, :3] @ torch.from_numpy(camera_rotation)
    if world_rotation is not None:
        rotation = torch.from_numpy(world_rotation)
        poses[:, :3] = rotation @ poses[:, :3]
        # aligned_from_world is from another world now.
        alignment[:3, :3] = alignment[:3, :3] @ rotation.T
    moved = scan.world_from_input
    if world_rotation is not None or scale != 1.0:
        step = torch.eye(4, dtype=torch.float64)
        step[:3, :3] *= scale
        if world_rotation is not None:
            step[:3, :3] = torch.from_numpy(world_rotation) @ step[:3, :3]
        moved = step if moved is None else step @ moved
    return replace(scan, world_from_camera=poses, axis_alignment=alignment, world_from_input=moved)


@dataclass(frozen=True, kw_only=True)
class RotatedScan(OpenScan):
    """Another scan with its images rotated by quarter turns, and its cameras with them.

    Attributes:
        stored: the scan as it is stored.
        quarters: number of quarter turns counter-clockwise of each image, 0 to 3.
    """

    stored: OpenScan
    quarters: tuple[int, ...]

    @property
    def path(self) -> Path:
        """Where the stored scan lies."""
        return self.stored.path

    def color_bytes(self, index: int) -> bytes | None:
        """See ``OpenScan``; None for a frame that is turned."""
        is_stored = self.quarters[index] == 0 and self.image_size == self.stored.image_size
        return self.stored.color_bytes(index) if is_stored else None

    def read_color(self, index: int, image_size: tuple[int, int] | None = None) -> NDArray[np.uint8]:
        """See ``OpenScan``."""
        quarters = self.quarters[index]
        turned = _turned(self.stored.image_size, quarters)
        fits = turned == self.image_size
        size = None if image_size is None or not fits else _turned(image_size, quarters)
        pixels = np.ascontiguousarray(np.rot90(self.stored.read_color(index, size), quarters))
        if fits:
            return pixels
        return fill_up(pixels, box_within(turned, self.image_size), self.image_size, image_size)

    def close(self) -> None:
        """Close the stored scan."""
        self.stored.close()


def _turned(size: tuple[int, int], quarters: int) -> tuple[int, int]:
    """Return ``(H, W)`` of an image after some quarter turns."""
    return (size[1], size[0]) if quarters % 2 else size


def rotate_upright(scan: OpenScan, up: NDArray[np.float64]) -> OpenScan:
    """Return the scan with its images rotated so that up in the world is up in them.

    All are rotated alike, unless the camera was turned on the way: then each is, and those of another shape
    than most are filled up.

    Args:
        scan: with cameras in OpenCV axes.
        up: ``(3,)`` direction of up in its world, known by other means than the images' tops.

    Returns:
        The scan itself if its images are upright, or are turned in all ways.
    """
    quarters = _quarters_to_upright(scan.world_from_camera.double().numpy(), up)
    if not quarters.any():
        return scan
    turns = np.bincount(quarters, minlength=4)
    image_size = _turned(scan.image_size, 1 if turns[1] + turns[3] > turns[0] + turns[2] else 0)
    poses, intrinsics = scan.world_from_camera.clone(), scan.intrinsics.clone()
    whole = torch.tensor([0.0, 0.0, image_size[1], image_size[0]], dtype=torch.float64)
    picture = whole.repeat(len(scan), 1)
    for turn in np.unique(quarters).tolist():
        chosen = torch.from_numpy(quarters == turn)
        cameras = scan.cameras[chosen]
        for _ in range(turn):
            cameras = cameras.quarter_turned()
        left, top, right, bottom = box_within(cameras.image_size, image_size)
        if cameras.image_size != image_size:
            cameras = cameras.scaled_to((bottom - top, right - left))
        poses[chosen], intrinsics[chosen] = cameras.world_from_camera, cameras.intrinsics
        intrinsics[chosen, :2, 2] += torch.tensor([left, top], dtype=torch.float64)
        shift = torch.tensor([left, top, left, top], dtype=torch.float64)
        box = torch.tensor([0, 0, right - left, bottom - top])
        picture[chosen] = shift + (box if cameras.picture is None else cameras.picture)
    return RotatedScan(
        scene_id=scan.scene_id,
        frame_id=scan.frame_id,
        world_from_camera=poses,
        intrinsics=intrinsics,
        image_size=image_size,
        picture=None if bool((picture == whole).all()) else picture,
        axis_alignment=scan.axis_alignment,
        dropped=scan.dropped,
        damage=scan.damage,
        world_from_input=scan.world_from_input,
        stored=scan,
        quarters=tuple(quarters.tolist()),
    )


def _quarters_to_upright(
    world_from_camera: NDArray[np.float64], up: NDArray[np.float64]
) -> NDArray[np.int64]:
    """Return by how many quarter turns counter-clockwise each image becomes upright, ``(n,)``."""
    sides = sides_of_up(world_from_camera, up)
    share = np.bincount(sides[sides >= 0], minlength=4) / len(sides)
    first, second, *_ = np.argsort(-share, kind="stable")
    if share[second] > _FEWEST_MIXED and share[first] + share[second] > _TWO_WAYS:
        return np.where(np.isin(sides, (first, second)), sides, first)
    # How far up points to the right and to the bottom of the images, in the mean.
    right, bottom = (world_from_camera[:, :3, :2].transpose(0, 2, 1) @ up).mean(axis=0)
    side = int(np.argmax([-bottom, right, bottom, -right]))
    is_clear = max(abs(right), abs(bottom)) >= _SIDEWAYS
    return np.full(len(sides), side if is_clear else 0)
