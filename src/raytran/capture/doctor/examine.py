# SPDX-License-Identifier: Apache-2.0
"""One scan examined: every check, in the order in which a fault would spoil the next one."""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from raytran.capture.doctor.cameras import NO_READING, CameraCheck, check_cameras
from raytran.capture.doctor.depth import (
    SurfacePoints,
    depth_of_matches,
    points_from_depth_maps,
    points_from_matches,
)
from raytran.capture.doctor.finding import Correction, Finding
from raytran.capture.doctor.matches import Matches, match_frames
from raytran.capture.doctor.objects import (
    MISPLACED,
    check_boxes,
    check_in_view,
    check_models,
    check_placement,
    count_hits,
    rotated,
)
from raytran.capture.frames import RawScan, read_grey
from raytran.capture.orientation import check_unit, check_up
from raytran.data.scan import OpenScan
from raytran.data.scan2cad import SceneAnnotation, scene_objects
from raytran.data.scannet.find import ScanSource
from raytran.data.scannet.layout import find_layout
from raytran.data.scannet.text import are_rigid, read_pose
from raytran.errors import DataError
from raytran.geometry.camera import Cameras
from raytran.structs import ObjectSet

_MAX_IMAGES = 150
"""Images that are decoded to see whether they can be; a scan with more is sampled."""

OBJECTS_OUTSIDE = "objects outside the volume"
"""Cause where most boxes are beyond the volume around the cameras."""

_MANY_OUTSIDE = 0.25
"""Share of cameras outside the volume that is a fault; a long walk has some."""


@dataclass(frozen=True)
class Examination:
    """What is known about one scan.

    Attributes:
        scene_id: its name.
        path: where it lies.
        findings: result of each check.
        raw: the scan as stored, or None if it cannot be read.
        correction: what would mend the cameras.
        surface: points that the images show, in metres under the corrected cameras; or None.
        objects: boxes of the annotation; none without one.
        annotation: the CADs that stand in it, or None.
        shapenet_root: folder of their meshes, or None.
        num_matches: number of points matched between frames.
        seconds: time taken.
    """

    scene_id: str
    path: Path
    findings: tuple[Finding, ...]
    raw: RawScan | None = None
    correction: Correction = field(default_factory=Correction)
    surface: SurfacePoints | None = None
    objects: ObjectSet = field(default_factory=ObjectSet.empty)
    annotation: SceneAnnotation | None = None
    shapenet_root: Path | None = None
    num_matches: int = 0
    seconds: float = 0.0

    @property
    def faults(self) -> tuple[Finding, ...]:
        """The findings that need mending."""
        return tuple(finding for finding in self.findings if finding.state == "fault")


def examine(
    source: ScanSource,
    *,
    annotation: SceneAnnotation | None = None,
    shapenet_root: Path | None = None,
    grid_extent: tuple[float, float, float] = (9.0, 9.0, 3.5),
) -> Examination:
    """Examine one scan; the scan stays readable for as long as the result is kept.

    Args:
        source: where it lies.
        annotation: its entry in Scan2CAD, if there is one.
        shapenet_root: folder of the CADs, if there is one.
        grid_extent: of the model's volume, metres.
    """
    started = time.perf_counter()
    result = Examination(source.scene_id, source.path, ())
    try:
        scan = source.open(any_size=True)
    except DataError as error:
        result = replace(result, findings=(_unopened(source.path, error),))
    else:
        result = _examine_scan(scan, annotation, result, grid_extent)
    if annotation is not None:
        findings = (*result.findings, *check_models(annotation, shapenet_root))
        result = replace(result, findings=findings, annotation=annotation, shapenet_root=shapenet_root)
    return replace(result, seconds=time.perf_counter() - started)


def check_volume(
    positions: NDArray[np.float64], centers: NDArray[np.float64], extent: tuple[float, float, float]
) -> Finding:
    """Check that the volume, centred on the mean camera, holds the cameras and the objects.

    Args:
        positions: ``(n, 3)`` of the cameras, metres.
        centers: ``(M, 3)`` of the objects.
        extent: of the volume, metres.
    """
    half, middle = np.array(extent) / 2, positions.mean(axis=0)
    cameras = int((np.abs(positions - middle) > half).any(axis=1).sum())
    objects = int((np.abs(centers - middle) > half).any(axis=1).sum()) if len(centers) else 0
    span = " x ".join(f"{length:.1f}" for length in np.ptp(positions, axis=0))
    size = " x ".join(f"{length:g}" for length in extent)
    text = f"{cameras} of {len(positions)} cameras (their path spans {span} m)"
    text += f" and {objects} of {len(centers)} objects" if len(centers) else ""
    text += f" are outside the volume of {size} m"
    if cameras > _MANY_OUTSIDE * len(positions):
        fix = "predict on parts of the walk, or give a model a larger model.grid_extent"
        return Finding("volume", "fault", text, "cameras outside the volume", fix, "certain")
    if objects > len(centers) / 2:
        fix = "check that annotation and poses share one world; if so, use frames near the objects"
        return Finding("volume", "fault", text, OBJECTS_OUTSIDE, fix, "certain")
    return Finding("volume", "note" if cameras or objects else "ok", text)


def _examine_scan(
    scan: OpenScan,
    annotation: SceneAnnotation | None,
    result: Examination,
    extent: tuple[float, float, float],
) -> Examination:
    """Return the examination with everything but the CADs: files, cameras, unit, up, boxes, volume."""
    raw = RawScan.of(scan)
    matches = match_frames(partial(read_grey, scan), len(scan))
    cameras = check_cameras(raw, matches)
    measured = depth_of_matches(raw, matches)
    agreeing = cameras.agrees
    scale, unit = check_unit(cameras.depth[agreeing], None if measured is None else measured[agreeing])
    surface = _surface_points(raw, matches, cameras, scale)
    is_lost = cameras.findings[0].cause == NO_READING
    result = replace(
        result,
        findings=(*_check_files(raw), *cameras.findings, *([] if is_lost else [unit])),
        raw=raw,
        correction=replace(cameras.correction, scale=scale),
        surface=surface,
        objects=ObjectSet.empty() if annotation is None else scene_objects(annotation),
        num_matches=len(matches),
    )
    if is_lost:
        return result
    result = _check_world(result, raw, surface)
    poses = result.correction.apply(raw.stored)
    # Where boxes are known to be misplaced it says nothing that they are outside, too.
    misplaced = any(finding.cause == MISPLACED for finding in result.findings)
    objects = ObjectSet.empty() if misplaced else result.objects
    volume = check_volume(poses[:, :3, 3], objects.center.double().numpy(), extent)
    result = replace(result, findings=(*result.findings, volume))
    if not len(objects) or volume.cause == OBJECTS_OUTSIDE:
        return result
    in_view = check_in_view(objects, _corrected_cameras(raw, result.correction))
    return replace(result, findings=(*result.findings, in_view))


def _check_world(result: Examination, raw: RawScan, surface: SurfacePoints) -> Examination:
    """Return the examination with what is known of up and of the annotation's place in the world."""
    correction, objects = result.correction, result.objects
    findings: list[Finding] = []
    if len(objects):
        objects, findings = check_boxes(objects)
    poses = correction.apply(raw.stored)
    rotation, up = check_up(poses)
    if rotation is not None:
        transform = np.eye(4)
        transform[:3, :3] = rotation
        # If boxes fit the cameras now, the annotation shares their world and must be rotated with them.
        now, after = (count_hits(surface, poses, objects, moved).score for moved in (np.eye(4), transform))
        if now > after:
            objects = rotated(objects, rotation)
            # That the boxes lie down is the same fault.
            findings = findings[:1]
            up = replace(up, fix=f"{up.fix}, and the annotation's scan transforms likewise")
        correction = replace(correction, world_transform=transform)
    findings.append(up)
    alignment = raw.axis_alignment
    if not are_rigid(alignment[None])[0]:
        text = "axisAlignment in the scan's text file is no rigid motion"
        fix = "take it from ScanNet again, or remove the line"
        findings.append(Finding("axisAlignment", "fault", text, "damaged axisAlignment", fix, "certain"))
        alignment = np.eye(4)
    if len(objects):
        moved, placed = check_placement(surface, correction.apply(raw.stored), objects, alignment)
        correction = replace(correction, world_transform=moved @ correction.world_transform)
        findings.append(placed)
    return replace(result, findings=(*result.findings, *findings), correction=correction, objects=objects)


def _corrected_cameras(raw: RawScan, correction: Correction) -> Cameras:
    intrinsics = raw.intrinsics if correction.intrinsics is None else correction.intrinsics
    poses = torch.from_numpy(correction.apply(raw.stored))
    return Cameras(torch.from_numpy(intrinsics), poses, raw.scan.image_size, raw.scan.picture)


def _surface_points(raw: RawScan, matches: Matches, cameras: CameraCheck, scale: float) -> SurfacePoints:
    """Return points of the depth maps if there are maps, else the matched points that agree."""
    corrected = cameras.correction.intrinsics
    intrinsics = raw.intrinsics if corrected is None else corrected
    from_maps = points_from_depth_maps(raw, intrinsics)
    if from_maps is not None:
        return from_maps
    agreeing = Matches(matches.frame[cameras.agrees], matches.pixel[cameras.agrees], matches.tolerance_px)
    return points_from_matches(agreeing, cameras.depth[cameras.agrees] * scale, intrinsics)


def _check_files(raw: RawScan) -> list[Finding]:
    """Return the findings on frames without image or pose, and on damaged images."""
    scan = raw.scan
    total = len(scan) + len(scan.dropped)
    text = f"all {total} are usable"
    if scan.dropped:
        reasons = "; ".join(sorted(set(scan.dropped.values())))
        text = f"{len(scan.dropped)} of {total} frames are left out ({reasons})"
    frames = Finding("frames", "note" if scan.dropped else "ok", text)
    if len(scan.dropped) > total / 2 or scan.damage:
        fix = "export the scan again; frames whose tracking was lost cannot be mended"
        frames = Finding("frames", "fault", scan.damage or text, "most frames unusable", fix, "certain")
    tried, failures = raw.unreadable_images(max_images=_MAX_IMAGES)
    images = Finding("images", "ok", f"{tried} of {len(scan)} were decoded without fault")
    if failures:
        text = f"{len(failures)} of the {tried} images tried cannot be read, the first: {failures[0]}"
        images = Finding("images", "fault", text, "damaged images", "copy or export them again", "certain")
    return [frames, images]


def _unopened(path: Path, error: DataError) -> Finding:
    """Return the finding about a scan that cannot be opened; left-handed poses are told apart."""
    cause, fix = "cannot be read", ""
    if _is_left_handed(path):
        cause = "left-handed poses"
        fix = (
            "the rotations have determinant -1, as Unity and some renderers write them: negate the second "
            "column of each matrix, and check again"
        )
    return Finding("files", "fault", str(error), cause, fix, "certain")


def _is_left_handed(path: Path) -> bool:
    """Whether most pose files hold an orthonormal matrix of determinant -1."""
    try:
        matrices = [read_pose(file) for file in list(find_layout(path).poses().values())[:50]]
    except DataError:
        return False
    rotations = [matrix[:3, :3] for matrix in matrices if matrix is not None and np.isfinite(matrix).all()]
    mirrored = [
        np.abs(rotation @ rotation.T - np.eye(3)).max() < 0.01 and np.linalg.det(rotation) < 0
        for rotation in rotations
    ]
    return bool(mirrored) and sum(mirrored) > len(mirrored) / 2
