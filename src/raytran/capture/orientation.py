# SPDX-License-Identifier: Apache-2.0
"""Camera axes, up and unit of a scan: measured from cameras and images, checked, and brought to ours.

Ours are OpenCV axes, +z up, metres. The data doctor reports what these measurements say (``check_up``,
``check_unit``); ``predict`` applies it to scans of any format (``to_our_world``).
"""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import get_args

import numpy as np
import torch
from numpy.typing import NDArray

from raytran.capture.doctor.cameras import check_cameras
from raytran.capture.doctor.finding import Finding
from raytran.capture.doctor.matches import match_frames
from raytran.capture.frames import RawScan, read_grey
from raytran.capture.recording import Axes
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


@dataclass(frozen=True, kw_only=True)
class WorldSettings:
    """What a user says about a scan's world; the defaults leave it to the format and the images.

    Attributes:
        up: direction of up in the scan's world, one of ``UPS``.
        scale: metres in a unit of its positions; None: as the format promises, else one.
        convention: its camera axes, one of ``CONVENTIONS``.
        check: whether points are matched between images to check axes and unit.

    Raises:
        ConfigError: a value is unknown.
    """

    up: str = "auto"
    scale: float | None = None
    convention: str = "auto"
    check: bool = True

    def __post_init__(self) -> None:
        if self.up not in UPS:
            raise ConfigError(f"unknown up={self.up}: choose one of {', '.join(UPS)}")
        if self.convention not in CONVENTIONS:
            raise ConfigError(f"unknown convention={self.convention}: choose one of {', '.join(CONVENTIONS)}")
        if self.scale is not None and not (math.isfinite(self.scale) and self.scale > 0):
            raise ConfigError(f"scale={self.scale} is no positive number: give the metres in a unit")


def measured_up(world_from_camera: NDArray[np.float64]) -> tuple[NDArray[np.float64] | None, bool]:
    """Measure where up is, supposing that cameras are held level and look about.

    A level camera's image rows are horizontal, so up is the direction to which all rows are at right angles
    (the eigenvector of their smallest spread), with the sign of the images' tops. Where the cameras look one
    way that direction is not determined: then the mean of the tops is taken, which a camera that looks down
    tilts.

    Args:
        world_from_camera: ``(n, 4, 4)`` in OpenCV axes.

    Returns:
        ``(3,)`` of length one, or None if it cannot be told; and whether the cameras look about.
    """
    right, top = world_from_camera[:, :3, 0], -world_from_camera[:, :3, 1]
    mean = top.mean(axis=0)
    spread, axes = np.linalg.eigh(right.T @ right / len(right))
    if spread[1] > 0.05 and spread[0] < 0.25 * spread[1]:
        return axes[:, 0] * np.sign(axes[:, 0] @ mean or 1.0), True
    length = float(np.linalg.norm(mean))
    return (mean / length if length > 0.5 else None), False


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
    up, looks_about = measured_up(world_from_camera)
    if up is None:
        return None, Finding("up", "unknown", "cameras are turned in all ways, so up cannot be told")
    angle = math.degrees(math.acos(float(np.clip(up[2], -1, 1))))
    text = f"up by the cameras is ({up[0]:+.2f}, {up[1]:+.2f}, {up[2]:+.2f}), {angle:.0f}° from +z"
    axis = _nearest_axis(up)
    if angle < _TILTED_DEG:
        return None, Finding("up", "ok", text)
    if not looks_about and axis[2] > 0:
        return None, Finding("up", "ok", f"{text}, as far as cameras that look one way can tell")
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
    return rotation, Finding("up", "fault", text, cause, fix, "certain" if looks_about else "likely")


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

    Camera axes and up are corrected where the images or cameras show another; a unit that cannot be metres is
    only reported.

    Args:
        scan: as its reader returned it.
        settings: what the user says.
        axes: camera axes of the format.
        up: direction of up that the format promises, or None.
        metric: whether the format promises metres.
        aligned: whether up is an axis of the format's worlds.
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
    distance = None
    if settings.check:
        scan, distance = _with_checked_cameras(scan, settings, convention)
    scan = _with_z_up(scan, settings.up, up, aligned)
    _check_scale(scan, settings, metric, distance)
    return scan


def _with_checked_cameras(
    scan: OpenScan, settings: WorldSettings, convention: str
) -> tuple[OpenScan, float | None]:
    """Return the scan with the camera axes that its images agree with, and the median distance they show."""
    raw = RawScan.of(scan)
    picture = None if scan.picture is None else scan.picture.numpy()
    reading = check_cameras(raw, match_frames(partial(read_grey, scan), len(scan), picture=picture))
    correction = reading.correction
    is_opengl = correction.storage == "as stored" and np.allclose(correction.camera_rotation, OPENGL)
    other = "opengl" if convention == "opencv" else "opencv"
    for finding in reading.findings:
        if finding.state != "fault":
            continue
        about_axes = is_opengl and finding.check == "camera axes"
        if about_axes and settings.convention == "auto":
            _log.warning(
                "%s: camera axes are %s, not %s as the format has it (%s); convention=%s would keep them",
                scan.scene_id,
                other,
                convention,
                finding.text,
                convention,
            )
            scan = _transformed(scan, camera_rotation=OPENGL)
        else:
            fix = f"give convention={other}" if about_axes else finding.fix
            _log.warning("%s: %s: %s; %s", scan.scene_id, finding.cause, finding.text, fix)
    depth = reading.depth[reading.agrees]
    if len(depth) < _FEWEST_DISTANCES:
        return scan, None
    metres, unit = check_unit(depth, None)
    if unit.state == "fault":
        _log.warning(
            "%s: %s: %s; nothing is scaled: give scale=%.3g if that is right",
            scan.scene_id,
            unit.cause,
            unit.text,
            (settings.scale or 1.0) * metres,
        )
    return scan, float(np.median(depth))


def _with_z_up(
    scan: OpenScan, asked: str, promised: tuple[float, float, float] | None, aligned: bool
) -> OpenScan:
    """Return the scan in a world whose +z is up.

    Where up is known by other means than the images' tops, images that were stored sideways are rotated too.
    """
    if asked != "auto":
        sign = -1.0 if asked[0] == "-" else 1.0
        up, how = sign * np.eye(3)["xyz".index(asked[1])], "as up= says"
    elif promised is not None:
        up, how = np.array(promised, dtype=np.float64), "as the format has it"
    else:
        measured, looks_about = measured_up(scan.world_from_camera.double().numpy())
        if measured is None:
            _log.warning(
                "%s: cameras are turned in all ways, so up cannot be told; it is taken to be +z: give up=",
                scan.scene_id,
            )
            return scan
        tolerance = _TILTED_DEG if looks_about and not aligned else _WRONG_DEG
        axis = _nearest_axis(measured)
        up = axis if measured @ axis > math.cos(math.radians(tolerance)) else measured
        how = f"measured from the cameras, {'certain' if looks_about else 'unsure, for they look one way'}"
    log = _log.info if up[2] == 1.0 else _log.warning
    log("%s: up is %s (%s); up= would override it", scan.scene_id, _axis_name(up), how)
    if asked != "auto" or promised is not None:
        upright = rotate_upright(scan, up)
        if upright is not scan:
            _log.info("%s: images are stored sideways or on their heads and get turned", scan.scene_id)
        scan = upright
    return scan if up[2] == 1.0 else _transformed(scan, world_rotation=rotation_to_z(up))


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
    return replace(scan, world_from_camera=poses, axis_alignment=alignment)


@dataclass(frozen=True, kw_only=True)
class RotatedScan(OpenScan):
    """Another scan with its images rotated by quarter turns, and its cameras with them.

    Attributes:
        stored: the scan as it is stored.
        quarters: number of quarter turns counter-clockwise, 1 to 3.
    """

    stored: OpenScan
    quarters: int

    @property
    def path(self) -> Path:
        """Where the stored scan lies."""
        return self.stored.path

    def color_bytes(self, index: int) -> None:
        """Return None: no frame is used as stored."""
        return

    def read_color(self, index: int, image_size: tuple[int, int] | None = None) -> NDArray[np.uint8]:
        """See ``OpenScan``."""
        if image_size is not None and self.quarters != 2:
            image_size = (image_size[1], image_size[0])
        return np.ascontiguousarray(np.rot90(self.stored.read_color(index, image_size), self.quarters))

    def close(self) -> None:
        """Close the stored scan."""
        self.stored.close()


def rotate_upright(scan: OpenScan, up: NDArray[np.float64]) -> OpenScan:
    """Return the scan with its images rotated so that up in the world is up in most of them.

    Args:
        scan: with cameras in OpenCV axes.
        up: ``(3,)`` direction of up in its world, known by other means than the images' tops.

    Returns:
        The scan itself if its images are upright, or are turned in all ways.
    """
    # How far up points to the right and to the bottom of the images, in the mean.
    axes = scan.world_from_camera[:, :3, :2].double().numpy()
    right, bottom = (axes.transpose(0, 2, 1) @ up).mean(axis=0)
    # Index of the side where up is: top, right, bottom, left.
    quarters = int(np.argmax([-bottom, right, bottom, -right]))
    if quarters == 0 or max(abs(right), abs(bottom)) < _SIDEWAYS:
        return scan
    cameras = scan.cameras
    for _ in range(quarters):
        cameras = cameras.quarter_turned()
    return RotatedScan(
        scene_id=scan.scene_id,
        frame_id=scan.frame_id,
        world_from_camera=cameras.world_from_camera,
        intrinsics=cameras.intrinsics,
        image_size=cameras.image_size,
        picture=cameras.picture,
        axis_alignment=scan.axis_alignment,
        dropped=scan.dropped,
        damage=scan.damage,
        stored=scan,
        quarters=quarters,
    )
