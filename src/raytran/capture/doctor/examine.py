# SPDX-License-Identifier: Apache-2.0
"""One scan examined: every check, in the order in which a fault would spoil the next one."""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from raytran.capture.doctor.boxes import check_boxes, turned
from raytran.capture.doctor.camera_findings import NO_READING
from raytran.capture.doctor.cameras import CameraReading, read_cameras
from raytran.capture.doctor.finding import Correction, Finding
from raytran.capture.doctor.matches import Matches, match_frames
from raytran.capture.doctor.models import check_models
from raytran.capture.doctor.placement import ASTRAY, check_placement, weigh
from raytran.capture.doctor.recording import Recording
from raytran.capture.doctor.sightings import Sightings, depth_at, sightings_from_depth, sightings_from_matches
from raytran.capture.doctor.world import check_unit, check_up, check_volume
from raytran.data.scan import OpenScan
from raytran.data.scan2cad import SceneAnnotation, scene_objects
from raytran.data.scannet.find import ScanSource
from raytran.data.scannet.layout import find_layout
from raytran.data.scannet.text import are_rigid, read_matrix
from raytran.errors import DataError
from raytran.structs import ObjectSet

_MOST_IMAGES = 150
"""Images that are decoded to see whether they can be; a scan with more is sampled."""

_DEPTH_AGREES = 0.15
"""Relative difference of a depth map and a matched point that still counts as the same."""


@dataclass(frozen=True)
class Examination:
    """What is known about one scan.

    Attributes:
        scene_id: its name.
        path: where it lies.
        findings: result of each check.
        recording: the scan, or None if it cannot be read.
        correction: what would mend the cameras.
        sightings: rays with known ends, in metres under the corrected cameras; or None.
        objects: boxes of the annotation; none without one.
        annotation: the CADs that stand in it, or None.
        shapenet_root: folder of their meshes, or None.
        matches: number of points matched between frames.
        seconds: time taken.
    """

    scene_id: str
    path: Path
    findings: tuple[Finding, ...]
    recording: Recording | None = None
    correction: Correction = field(default_factory=Correction)
    sightings: Sightings | None = None
    objects: ObjectSet = field(default_factory=ObjectSet.empty)
    annotation: SceneAnnotation | None = None
    shapenet_root: Path | None = None
    matches: int = 0
    seconds: float = 0.0

    @property
    def faults(self) -> tuple[Finding, ...]:
        """The findings that need mending."""
        return tuple(finding for finding in self.findings if finding.state == "fault")

    @property
    def intrinsics(self) -> NDArray[np.float64] | None:
        """``(3, 3)`` of the corrected cameras for the stored images."""
        if self.recording is None:
            return None
        right = self.correction.intrinsics
        return self.recording.intrinsics if right is None else right


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
        result = _examine(scan, annotation, result, grid_extent)
    if annotation is not None:
        findings = (*result.findings, *check_models(annotation, shapenet_root))
        result = replace(result, findings=findings, annotation=annotation, shapenet_root=shapenet_root)
    return replace(result, seconds=time.perf_counter() - started)


def _examine(
    scan: OpenScan,
    annotation: SceneAnnotation | None,
    result: Examination,
    extent: tuple[float, float, float],
) -> Examination:
    recording = Recording.of(scan)
    objects = ObjectSet.empty() if annotation is None else scene_objects(annotation)
    matches = match_frames(recording.read_grey, len(recording))
    reading = read_cameras(recording, matches)
    intrinsics = (
        recording.intrinsics if reading.correction.intrinsics is None else reading.correction.intrinsics
    )
    measured = depth_at(recording, matches)
    scale, unit = check_unit(
        reading.depth[reading.agrees], None if measured is None else measured[reading.agrees]
    )
    correction = replace(reading.correction, scale=scale)
    sightings = _sightings(recording, matches, reading, scale, intrinsics)
    lost = reading.findings[0].cause == NO_READING
    result = replace(
        result,
        findings=(*_check_files(recording), *reading.findings, *([] if lost else [unit])),
        recording=recording,
        correction=correction,
        sightings=sightings,
        objects=objects,
        matches=len(matches),
    )
    if lost:
        return result
    result = _check_world(result, recording, sightings)
    poses = result.correction.apply(recording.stored)
    # Where boxes are known to be wrong it says nothing that they are outside, too.
    astray = any(finding.cause == ASTRAY for finding in result.findings)
    objects = ObjectSet.empty() if astray else result.objects
    volume = check_volume(poses[:, :3, 3], objects.center.double().numpy(), extent)
    return replace(result, findings=(*result.findings, volume))


def _check_world(result: Examination, recording: Recording, sightings: Sightings) -> Examination:
    """Return the examination with what is known of up and of the annotation's place in the world."""
    stored, correction, objects = recording.stored, result.correction, result.objects
    findings: list[Finding] = []
    if len(objects):
        objects, findings = check_boxes(objects)
    level, up = check_up(correction.apply(stored))
    if level is not None:
        turn = np.eye(4)
        turn[:3, :3] = level
        together = weigh(sightings, correction.apply(stored), objects, np.eye(4)).score
        if together > weigh(sightings, correction.apply(stored), objects, turn).score:
            objects, findings = turned(objects, level), findings[:1]
            up = replace(up, fix=f"{up.fix}, and the annotation's scan transforms likewise")
        correction = replace(correction, world_turn=turn)
    findings.append(up)
    alignment = recording.axis_alignment
    if not are_rigid(alignment[None])[0]:
        text = "axisAlignment in the scan's text file is no rigid motion"
        fix = "take it from ScanNet again, or remove the line"
        findings.append(Finding("axisAlignment", "fault", text, "damaged axisAlignment", fix, "certain"))
        alignment = np.eye(4)
    if len(objects):
        moved, placed = check_placement(sightings, correction.apply(stored), objects, alignment)
        correction = replace(correction, world_turn=moved @ correction.world_turn)
        findings.append(placed)
    return replace(result, findings=(*result.findings, *findings), correction=correction, objects=objects)


def _sightings(
    recording: Recording, matches: Matches, reading: CameraReading, scale: float, intrinsics: NDArray
) -> Sightings:
    """Return the depth maps' rays if there are maps, else those of matched points."""
    mapped = sightings_from_depth(recording, intrinsics)
    if mapped is not None:
        return mapped
    agreeing = Matches(matches.frame[reading.agrees], matches.pixel[reading.agrees], matches.tolerance_px)
    return sightings_from_matches(agreeing, reading.depth[reading.agrees] * scale, intrinsics)


def _check_files(recording: Recording) -> list[Finding]:
    scan = recording.scan
    total = len(scan) + len(scan.dropped)
    reasons = "; ".join(sorted(set(scan.dropped.values())))
    text = (
        f"{len(scan.dropped)} of {total} frames are left out ({reasons})"
        if scan.dropped
        else f"all {total} are usable"
    )
    frames = Finding("frames", "note" if scan.dropped else "ok", text)
    if len(scan.dropped) > total / 2 or scan.damage:
        fix = "export the scan again; frames whose tracking was lost cannot be mended"
        frames = Finding("frames", "fault", scan.damage or text, "most frames unusable", fix, "certain")
    looked, failed = recording.unreadable_images(most=_MOST_IMAGES)
    images = Finding("images", "ok", f"{looked} of {len(scan)} were decoded without fault")
    if failed:
        text = f"{len(failed)} of the {looked} images tried cannot be read, the first: {failed[0]}"
        images = Finding("images", "fault", text, "damaged images", "copy or export them again", "certain")
    return [frames, images]


def _unopened(path: Path, error: DataError) -> Finding:
    """Return the finding about a scan that cannot be opened; mirrored poses are told apart."""
    cause, fix = "cannot be read", ""
    if _mirrored(path):
        cause = "left-handed poses"
        fix = (
            "the rotations have determinant -1, as Unity and some renderers write them: negate the second "
            "column of each matrix, and check again"
        )
    return Finding("files", "fault", str(error), cause, fix, "certain")


def _mirrored(path: Path) -> bool:
    """Whether most pose files hold an orthonormal matrix of determinant -1."""
    try:
        matrices = [read_matrix(file) for file in list(find_layout(path).poses().values())[:50]]
    except DataError:
        return False
    turns = [matrix[:3, :3] for matrix in matrices if matrix is not None and np.isfinite(matrix).all()]
    flipped = [np.abs(turn @ turn.T - np.eye(3)).max() < 0.01 and np.linalg.det(turn) < 0 for turn in turns]
    return bool(flipped) and sum(flipped) > len(flipped) / 2
