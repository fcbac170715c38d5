# SPDX-License-Identifier: Apache-2.0
"""Bringing a scan's world to ours: camera axes, up and metres, each known, given, or found and said."""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np
import torch
from numpy.typing import NDArray

from raytran.capture.doctor.cameras import read_cameras
from raytran.capture.doctor.matches import match_frames
from raytran.capture.doctor.recording import Recording
from raytran.capture.doctor.world import check_unit, measured_up, turn_to_z
from raytran.capture.turned import turned_upright
from raytran.data.scan import OpenScan
from raytran.errors import ConfigError

_log = logging.getLogger(__name__)

Axes = Literal["opencv", "opengl"]
"""Axes of a camera: x right, y down, z forward; or x right, y up, z backward."""

UPS = ("auto", "+x", "-x", "+y", "-y", "+z", "-z")
CONVENTIONS = ("auto", *get_args(Axes))

OPENGL = np.diag([1.0, -1.0, -1.0])
"""What turns OpenGL axes into OpenCV's, and back."""

_FEW_FRAMES = 8
_LONGEST_WALK, _SHORTEST_WALK = 200.0, 0.1
"""Metres between which the diagonal of the cameras' positions lies in a room."""

_NEAR_AXIS_DEG, _NEAR_AXIS_UNSURE_DEG = 12.0, 35.0
"""Up within this angle of an axis of the world is taken for the axis, if cameras turn about and if not."""


@dataclass(frozen=True, kw_only=True)
class WorldSettings:
    """What a user may say about a source's world; the defaults leave it to the source and its images.

    Attributes:
        up: direction of up in the source's world, one of ``UPS``.
        scale: metres in a unit of its positions; None: as many as the format says, else one.
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

    Only camera axes and up are found by themselves. A unit that cannot be metres is said, not mended.

    Args:
        scan: as its source has it.
        settings: what the user says.
        axes: the format's.
        up: direction of up that the format promises, or None.
        metric: whether the format promises metres.
        aligned: whether up is an axis of the format's worlds.
    """
    convention = axes if settings.convention == "auto" else settings.convention
    if convention == "opengl":
        scan = _moved(scan, camera_turn=OPENGL)
    if settings.scale is not None:
        scan = _moved(scan, scale=settings.scale)
    if len(scan) < _FEW_FRAMES:
        _log.warning(
            "%s: only %d frames have an image and a pose, from which little can be seen: "
            "give 20 or more that show the room from all sides",
            scan.scene_id,
            len(scan),
        )
    distance = None
    if settings.check:
        scan, distance = _checked(scan, settings, convention)
    scan = _upright(scan, settings.up, up, aligned)
    _check_scale(scan, settings, metric, distance)
    return scan


def _checked(scan: OpenScan, settings: WorldSettings, convention: str) -> tuple[OpenScan, float | None]:
    """Return the scan with the camera axes that its images agree with, and the median distance they show."""
    recording = Recording.of(scan)
    matches = match_frames(recording.read_grey, len(recording))
    reading = read_cameras(recording, matches)
    opengl = reading.correction.storage == "as stored" and np.allclose(reading.correction.camera_turn, OPENGL)
    other = "opengl" if convention == "opencv" else "opencv"
    for finding in reading.findings:
        if finding.state != "fault":
            continue
        about_axes = opengl and finding.check == "camera axes"
        if about_axes and settings.convention == "auto":
            _log.warning(
                "%s: camera axes are %s, not %s as the format has it (%s); convention=%s would keep them",
                scan.scene_id,
                other,
                convention,
                finding.text,
                convention,
            )
            scan = _moved(scan, camera_turn=OPENGL)
        else:
            fix = f"give convention={other}" if about_axes else finding.fix
            _log.warning("%s: %s: %s; %s", scan.scene_id, finding.cause, finding.text, fix)
    depth = reading.depth[reading.agrees]
    if len(depth) < 30:
        return scan, None
    metres, unit = check_unit(depth, None)
    if unit.state == "fault":
        known = settings.scale or 1.0
        _log.warning(
            "%s: %s: %s; nothing is scaled: give scale=%.3g if that is right",
            scan.scene_id,
            unit.cause,
            unit.text,
            known * metres,
        )
    return scan, float(np.median(depth))


def _upright(
    scan: OpenScan, asked: str, promised: tuple[float, float, float] | None, aligned: bool
) -> OpenScan:
    """Return the scan turned until up is +z, its images upright too where up does not come from them."""
    if asked != "auto":
        up, how = _axis(asked), "as up= says"
    elif promised is not None:
        up, how = np.array(promised, dtype=np.float64), "as the format has it"
    else:
        found, turns_about = measured_up(scan.world_from_camera.double().numpy())
        if found is None:
            _log.warning(
                "%s: cameras are turned in all ways, so up cannot be told; it is taken to be +z: give up=",
                scan.scene_id,
            )
            return scan
        up = _nearest_axis(found, _NEAR_AXIS_DEG if turns_about and not aligned else _NEAR_AXIS_UNSURE_DEG)
        how = f"measured from the cameras, {'certain' if turns_about else 'unsure, for they look one way'}"
    level = np.abs(up).max() == 1.0
    log = _log.info if level and up[2] == 1.0 else _log.warning
    log("%s: up is %s (%s); up= would override it", scan.scene_id, _name(up), how)
    if asked != "auto" or promised is not None:
        turned = turned_upright(scan, up)
        if turned is not scan:
            _log.info("%s: images are stored sideways or on their heads and get turned", scan.scene_id)
        scan = turned
    return scan if up[2] == 1.0 else _moved(scan, world_turn=turn_to_z(up))


def _check_scale(scan: OpenScan, settings: WorldSettings, metric: bool, distance: float | None) -> None:
    """Warn of a walk that is no walk through a room in metres, and of a unit that nothing tells."""
    positions = scan.world_from_camera[:, :3, 3]
    span = positions.amax(dim=0) - positions.amin(dim=0)
    walk = float(span.norm())
    if not _SHORTEST_WALK < walk < _LONGEST_WALK:
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


def _axis(name: str) -> NDArray[np.float64]:
    return np.eye(3)["xyz".index(name[1])] * (-1.0 if name[0] == "-" else 1.0)


def _nearest_axis(up: NDArray[np.float64], within_deg: float) -> NDArray[np.float64]:
    """Return the axis of the world that is within some degrees of a direction, or else the direction."""
    index = int(np.abs(up).argmax())
    near = abs(up[index]) > math.cos(math.radians(within_deg))
    return np.eye(3)[index] * np.sign(up[index]) if near else up


def _name(up: NDArray[np.float64]) -> str:
    index = int(np.abs(up).argmax())
    if abs(up[index]) == 1.0:
        return f"{'-' if up[index] < 0 else '+'}{'xyz'[index]}"
    return f"({up[0]:+.2f}, {up[1]:+.2f}, {up[2]:+.2f})"


def _moved(
    scan: OpenScan,
    *,
    world_turn: NDArray[np.float64] | None = None,
    camera_turn: NDArray[np.float64] | None = None,
    scale: float = 1.0,
) -> OpenScan:
    """Return the scan with its cameras turned about themselves or with the world, and positions scaled."""
    poses, alignment = scan.world_from_camera.double().clone(), scan.axis_alignment.double().clone()
    poses[:, :3, 3] *= scale
    alignment[:3, 3] *= scale
    if camera_turn is not None:
        poses[:, :3, :3] = poses[:, :3, :3] @ torch.from_numpy(camera_turn)
    if world_turn is not None:
        turn = torch.from_numpy(world_turn)
        poses[:, :3] = turn @ poses[:, :3]
        alignment[:3, :3] = alignment[:3, :3] @ turn.T
    return replace(scan, world_from_camera=poses, axis_alignment=alignment)
