# SPDX-License-Identifier: Apache-2.0
"""A whole scan examined: a right one is left in peace, and each fault is called by its name."""

from __future__ import annotations

import json
import time

import numpy as np
import pytest

from raytran.capture.doctor.examine import check_volume, examine
from raytran.data.scan2cad import read_annotations
from raytran.data.scannet.find import find_scans

from ..forms import OPENGL, SCAN

CHECKS = [
    *("frames", "images", "camera axes", "intrinsics", "unit", "annotation unit", "objects upright", "up"),
    *("annotation placed", "volume", "boxes in view", "handedness", "CAD meshes"),
]
YUP = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])


def diagnose(root, **changes):
    annotation = read_annotations(root / "scan2cad" / "full_annotations.json")[SCAN]
    arguments = {"annotation": annotation, "shapenet_root": root / "shapenet"} | changes
    return examine(find_scans(root)[SCAN][0], **arguments)


def spoil_poses(root, change):
    for path in (root / "scannet" / "scans" / SCAN / "pose").iterdir():
        pose = np.loadtxt(path)
        if np.isfinite(pose).all():
            np.savetxt(path, change(pose))


def alignment(root):
    text = (root / "scannet" / "scans" / SCAN / f"{SCAN}.txt").read_text()
    line = next(line for line in text.splitlines() if line.startswith("axisAlignment"))
    return np.array([float(word) for word in line.split("=")[1].split()]).reshape(4, 4)


def in_centimetres(pose):
    return np.block([[pose[:3, :3], 100 * pose[:3, 3:]], [pose[3:]]])


def test_a_right_room_is_not_flagged(room):
    started = time.perf_counter()
    result = diagnose(room)
    elapsed = time.perf_counter() - started
    assert result.faults == ()
    assert [finding.check for finding in result.findings] == CHECKS
    assert {finding.state for finding in result.findings} <= {"ok", "note"}
    assert not result.correction.changes_cameras
    assert result.scene_id == SCAN
    # All but reading the annotation is examining.
    assert 0.5 * elapsed < result.seconds <= elapsed


def test_without_annotation_only_the_scan_is_judged(room):
    result = diagnose(room, annotation=None, shapenet_root=None)
    assert result.faults == ()
    assert "annotation placed" not in [finding.check for finding in result.findings]


@pytest.mark.parametrize(
    ("change", "cause"),
    [
        (np.linalg.inv, "inverted poses"),
        (lambda pose: pose @ OPENGL, "OpenGL camera axes"),
        (in_centimetres, "positions in centimetres"),
        (lambda pose: YUP @ pose, "wrong up (+y)"),
    ],
)
def test_a_spoiled_room_is_diagnosed_and_mended(copy, raw, change, cause):
    spoil_poses(copy, change)
    result = diagnose(copy)
    assert [finding.cause for finding in result.faults] == [cause]
    mended = result.correction.apply(result.raw.stored)
    np.testing.assert_allclose(mended, raw.stored, atol=1e-6)


def test_alignment_on_one_side_is_diagnosed(copy):
    moved = alignment(copy)
    spoil_poses(copy, lambda pose: moved @ moved @ pose)
    assert [finding.cause for finding in diagnose(copy).faults] == [
        "axisAlignment applied twice (to the cameras)"
    ]


def test_a_wrong_up_of_cameras_and_annotation_together_is_one_fault(copy):
    spoil_poses(copy, lambda pose: YUP @ pose)
    annotation = read_annotations(copy / "scan2cad" / "full_annotations.json")[SCAN]
    annotation.scan_from_cad[:] = annotation.scan_from_cad.new_tensor(YUP) @ annotation.scan_from_cad
    result = diagnose(copy, annotation=annotation)
    assert [finding.cause for finding in result.faults] == ["wrong up (+y)"]
    assert "annotation" in result.faults[0].fix


def test_intrinsics_that_a_loader_would_refuse_are_diagnosed(copy):
    path = copy / "scannet" / "scans" / SCAN / "intrinsic" / "intrinsic_color.txt"
    np.savetxt(path, np.diag([2.0, 2.0, 1, 1]) @ np.loadtxt(path))
    assert [finding.cause for finding in diagnose(copy).faults] == ["intrinsics for another image size"]


def test_a_damaged_alignment_is_named_and_does_no_harm(copy):
    path = copy / "scannet" / "scans" / SCAN / f"{SCAN}.txt"
    path.write_text("axisAlignment = " + "0 " * 16)
    assert [finding.cause for finding in diagnose(copy).faults] == ["damaged axisAlignment"]


def test_left_handed_poses_are_diagnosed(copy):
    spoil_poses(copy, lambda pose: pose @ np.diag([1.0, -1, 1, 1]))
    result = diagnose(copy)
    assert [finding.cause for finding in result.faults] == ["left-handed poses"]
    assert result.raw is None


def test_damaged_and_lost_frames_are_counted(copy):
    folder = copy / "scannet" / "scans" / SCAN
    image = sorted((folder / "color").iterdir())[0]
    image.write_bytes(b"no image")
    fault = diagnose(copy).faults[0]
    assert fault.cause == "damaged images"
    assert fault.text.startswith("1 of the ")
    for path in sorted((folder / "pose").iterdir())[3:]:
        path.write_text("-inf " * 16)
    findings = {finding.check: finding for finding in diagnose(copy).findings}
    assert findings["frames"].cause == "most frames unusable"
    assert findings["camera axes"].state in ("unknown", "ok")


def test_a_missing_part_is_one_fault_with_the_readers_words(copy):
    folder = copy / "scannet" / "scans" / SCAN
    for path in (*(folder / "intrinsic").iterdir(), folder / f"{SCAN}.txt"):
        path.unlink()  # the header would fill in for the intrinsics
    result = diagnose(copy, annotation=None)
    assert [finding.cause for finding in result.faults] == ["cannot be read"]
    assert "intrinsic_color.txt is missing" in result.faults[0].text


def test_objects_of_another_scan_are_astray(copy):
    path = copy / "scan2cad" / "full_annotations.json"
    entries = json.loads(path.read_text())
    for entry in entries:
        entry["trs"]["translation"] = [value + 20 for value in entry["trs"]["translation"]]
    path.write_text(json.dumps(entries))
    assert [finding.cause for finding in diagnose(copy).faults] == ["objects outside the volume"]


def test_the_volume_holds_a_room_but_not_a_hall():
    corners = np.stack(np.meshgrid([-1.0, 1.0], [-1.0, 1.0], [0.0]), axis=-1).reshape(-1, 3)
    extent = (9.0, 9.0, 3.5)
    nothing = np.zeros((0, 3))
    assert check_volume(corners, nothing, extent).state == "ok"
    assert check_volume(corners * 6, nothing, extent).cause == "cameras outside the volume"
    few = np.concatenate([np.zeros((20, 3)), [[5.0, 0, 0]]])
    finding = check_volume(few, nothing, extent)
    assert finding.state == "note"
    assert finding.text.startswith("1 of 21 cameras")
    boxes = np.array([[0.0, 0, 0], [20, 0, 0], [30, 0, 0]])
    assert check_volume(corners, boxes, extent).cause == "objects outside the volume"
    assert check_volume(corners, boxes[:2], extent).state == "note"
