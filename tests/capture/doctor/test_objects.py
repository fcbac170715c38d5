# SPDX-License-Identifier: Apache-2.0
"""Annotated boxes: size, stance and place; and CADs that are mirrored, turned or missing."""

from __future__ import annotations

import math
import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch

from raytran.capture.doctor.depth import SurfacePoints
from raytran.capture.doctor.objects import (
    MISPLACED,
    check_boxes,
    check_in_view,
    check_models,
    check_placement,
    count_hits,
    rotated,
)
from raytran.data.scan2cad import read_annotations
from raytran.data.shapenet.models import BOXED, mesh_path
from raytran.geometry.camera import Cameras
from raytran.geometry.rotation import rotation_from_yaw
from raytran.structs import ObjectSet

from ...scan_forms import look_along_x
from ..forms import SCAN


@pytest.fixture
def furniture():
    count = 5
    return replace(
        ObjectSet.empty(),
        label=torch.zeros(count, dtype=torch.int64),
        center=torch.arange(15.0).reshape(5, 3),
        size=torch.full((count, 3), 0.8),
        rotation=rotation_from_yaw(torch.linspace(0, 3, count)),
        symmetry=torch.ones(count, dtype=torch.int64),
        score=torch.ones(count),
    )


def test_furniture_is_right(furniture):
    same, findings = check_boxes(furniture)
    assert same is furniture
    assert [finding.state for finding in findings] == ["ok", "ok"]


@pytest.mark.parametrize(("name", "factor"), [("centimetres", 100), ("millimetres", 1000)])
def test_units_of_the_annotation_are_named_and_mended(furniture, name, factor):
    large = replace(furniture, center=furniture.center * factor, size=furniture.size * factor)
    mended, findings = check_boxes(large)
    assert findings[0].cause == f"annotation in {name}"
    torch.testing.assert_close(mended.center, furniture.center)
    torch.testing.assert_close(mended.size, furniture.size)


def test_boxes_that_lie_down_are_named_but_one_that_leans_is_not(furniture):
    quarter = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    lying = rotated(furniture, quarter)
    torch.testing.assert_close(lying.center[1], torch.tensor([3.0, -5.0, 4.0]))
    finding = check_boxes(lying)[1][1]
    assert finding.cause == "objects lie down"
    assert "90.0°" in finding.text
    one = furniture.rotation.clone()
    one[0] = lying.rotation[0]
    finding = check_boxes(replace(furniture, rotation=one))[1][1]
    assert finding.state == "ok"
    assert math.isclose(float(finding.text.split("at most by ")[1].rstrip("°")), 90, abs_tol=0.1)


CENTERS = np.array([[2.0, 0.5, 0.5], [0.5, 2.0, 0.4], [-1.5, 0.3, 0.6], [0.2, -1.8, 0.5]])


def alignment(angle, x, y):
    turn = np.eye(4)
    turn[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    turn[:2, 3] = x, y
    return turn


ALIGNMENT = alignment(0.3, -1.1, 0.7)


@pytest.fixture
def objects():
    count = len(CENTERS)
    return replace(
        ObjectSet.empty(),
        label=torch.zeros(count, dtype=torch.int64),
        center=torch.tensor(CENTERS, dtype=torch.float32),
        size=torch.tensor([[0.8, 0.9, 0.6]]).expand(count, 3),
        rotation=rotation_from_yaw(torch.linspace(0, 2, count)),
        symmetry=torch.ones(count, dtype=torch.int64),
        score=torch.ones(count),
    )


@pytest.fixture
def camera():
    """One camera at (0, 0, 1.5) with world axes; rays end at the objects' middles or on the floor."""
    rng = np.random.default_rng(1)
    at_objects = np.repeat(CENTERS, 50, axis=0) + rng.normal(0, 0.05, (200, 3))
    on_floor = np.c_[rng.uniform(-4, 4, (400, 2)), np.zeros(400)]
    way = np.concatenate([at_objects, on_floor]) - (0, 0, 1.5)
    poses = np.eye(4)[None].copy()
    poses[0, 2, 3] = 1.5
    return SurfacePoints(np.zeros(600, dtype=np.int64), way, np.ones(600), "a test"), poses


def test_rays_are_counted_where_they_end(objects, camera):
    surface, poses = camera
    evidence = count_hits(surface, poses, objects, np.eye(4))
    assert evidence.inside >= 200
    assert evidence.inside > 2 * evidence.through  # Some rays to the floor cross a box.
    behind = replace(surface, depth=np.full(600, 3.0))
    assert count_hits(behind, poses, objects, np.eye(4)).through >= 200
    away = count_hits(surface, poses, objects, alignment(0, 50, 0))
    assert (away.inside, away.through, away.score) == (0, 0, 0.0)


def test_boxes_in_place_are_right(objects, camera):
    surface, poses = camera
    moved, finding = check_placement(surface, poses, objects, ALIGNMENT)
    assert finding.state == "ok"
    np.testing.assert_array_equal(moved, np.eye(4))


@pytest.mark.parametrize(
    ("applied", "cause"),
    [
        (ALIGNMENT, "axisAlignment applied to one side only (the cameras)"),
        (ALIGNMENT @ ALIGNMENT, "axisAlignment applied twice (to the cameras)"),
        (np.linalg.inv(ALIGNMENT), "axisAlignment applied to one side only (the annotation)"),
        (alignment(np.pi / 2, 0, 0), "cameras and annotation are turned by -90° about +z to each other"),
    ],
)
def test_a_side_that_was_moved_is_named(objects, camera, applied, cause):
    surface, poses = camera
    moved, finding = check_placement(surface, applied @ poses, objects, ALIGNMENT)
    assert (finding.state, finding.cause) == ("fault", cause)
    np.testing.assert_allclose(moved @ applied, np.eye(4), atol=1e-9)


def test_a_reading_that_catches_fewer_rays_is_no_better(objects, camera):
    surface, poses = camera
    away = np.array([6.0, 6, 0])
    spot = np.repeat(CENTERS[:1] + away, 40, axis=0) - poses[0, :3, 3]
    through = SurfacePoints(
        np.zeros(640, dtype=np.int64),
        np.concatenate([surface.ray, spot]),
        np.concatenate([np.where(np.arange(600) % 2, 1.0, 3.0), np.ones(40)]),
        "a test",
    )
    moved = alignment(0, *away[:2])
    given = count_hits(through, poses, objects, np.eye(4))
    purer = count_hits(through, poses, objects, np.linalg.inv(moved))
    assert given.inside > 2 * purer.inside
    assert purer.score > given.score + 0.12
    assert check_placement(through, poses, objects, moved)[1].state == "ok"


def test_boxes_of_another_scan_are_astray(objects, camera):
    surface, poses = camera
    elsewhere = replace(objects, center=objects.center + torch.tensor([0.0, 0.0, 30.0]))
    _, finding = check_placement(replace(surface), poses, elsewhere, np.eye(4))
    assert finding.state == "unknown"  # 600 rays might miss all boxes of a true scan.
    many = SurfacePoints(
        *(np.tile(a, (4,) + (1,) * (a.ndim - 1)) for a in (surface.frame, surface.ray, surface.depth)),
        "a test",
    )
    assert check_placement(many, poses, elsewhere, np.eye(4))[1].cause == MISPLACED


def annotation(root):
    return read_annotations(root / "scan2cad" / "full_annotations.json")[SCAN]


def spoil(root, turn):
    for model in set(annotation(root).model_id):
        path = mesh_path(root / "shapenet", *model.split("/"))
        lines = []
        for line in path.read_text().splitlines():
            if line.startswith("v "):
                vertex = turn @ np.array([float(word) for word in line.split()[1:4]])
                line = "v {:.8f} {:.8f} {:.8f}".format(*vertex)
            lines.append(line)
        path.write_text("\n".join(lines) + "\n")


def faults(root, shapenet="shapenet"):
    findings = check_models(annotation(root), None if shapenet is None else root / shapenet)
    return {finding.check: finding for finding in findings if finding.state == "fault"}


def test_true_models_are_not_flagged(room):
    assert faults(room) == {}


@pytest.mark.parametrize(
    ("turn", "cause", "word"),
    [
        (np.diag([1.0, 1.0, -1.0]), "mirrored CADs", "mirrored in z"),
        (np.diag([1.0, -1.0, 1.0]), "mirrored CADs", "mirrored in y"),
        (np.array([[0.0, 0, -1], [0, 1, 0], [1, 0, 0]]), "turned CADs", "turned by 90° about y"),
        (np.diag([1.3, 1.3, 1.3]), "other CADs", "box differs"),
    ],
)
def test_spoiled_models_are_named(copy, turn, cause, word):
    spoil(copy, turn)
    found = faults(copy)
    assert list(found) == ["CAD meshes"]
    assert found["CAD meshes"].cause == cause
    assert word in found["CAD meshes"].text


def test_voxels_tell_when_the_annotation_was_mirrored_with_the_mesh(copy):
    spoil(copy, np.diag([1.0, 1.0, -1.0]))
    mirrored = annotation(copy)
    mirrored.box_center[:, 2] *= -1
    findings = check_models(mirrored, copy / "shapenet")
    assert findings[-1].cause == "mirrored CADs"
    assert "its voxels" in findings[-1].text
    assert findings[-1].confidence == "likely"


def test_negative_scale_is_named(room):
    mirrored = annotation(room)
    mirrored.scan_from_cad[1, :, 0] *= -1
    finding = check_models(mirrored, None)[0]
    assert finding.cause == "mirrored CADs (negative scale)"
    assert finding.text.startswith(f"1 of {len(mirrored.model_id)} alignments")


def test_missing_models_are_counted(copy):
    models = sorted(set(annotation(copy).model_id))
    shutil.rmtree(mesh_path(copy / "shapenet", *models[0].split("/")).parents[1])
    found = faults(copy)
    assert found["CAD files"].text.startswith(f"1 of {len(models)} CADs")
    assert found["CAD files"].cause == "missing CADs"


def test_without_models_meshes_are_unknown(room):
    findings = check_models(annotation(room), None)
    assert [finding.state for finding in findings] == ["ok", "unknown"]


def cameras_along_x(positions):
    poses = torch.from_numpy(np.stack([look_along_x(x) for x in positions]))
    intrinsics = torch.tensor([[40.0, 0, 24], [0, 40, 16], [0, 0, 1]], dtype=torch.float64)
    return Cameras(intrinsics.expand(len(poses), 3, 3), poses, (32, 48))


def test_boxes_where_no_camera_looks_are_a_fault(furniture):
    cameras = cameras_along_x([0.0, 0.1])
    ahead = replace(furniture, center=torch.tensor([[3.0, 0, 1]]).expand(5, 3))
    assert check_in_view(ahead, cameras).state == "ok"
    behind = replace(furniture, center=torch.tensor([[-3.0, 0, 1]]).expand(5, 3))
    finding = check_in_view(behind, cameras)
    assert (finding.state, finding.cause) == ("fault", "boxes in another world than the poses")
    assert finding.text == "5 of 5 boxes lie where no camera looks"
    far = replace(furniture, center=torch.tensor([[300.0, 0, 1]]).expand(5, 3))
    assert check_in_view(far, cameras).state == "fault"
    mixed = replace(furniture, center=torch.cat([ahead.center[:4], behind.center[:1]]))
    assert check_in_view(mixed, cameras).state == "note"


def test_the_mesh_in_a_box_may_be_a_part_but_not_leave_it(tmp_path, write_annotations, cube_entry):
    models = tmp_path / "shapenet" / "chair" / "a" / "models"
    models.mkdir(parents=True)
    entry = cube_entry(catid_cad="chair", id_cad="a", center=[0, 0, 0], bbox=[0.5, 0.5, 0.5])
    annotation = read_annotations(write_annotations({"scene0000_00": [entry]}))["scene0000_00"]
    for high, state in ((0.2, "ok"), (0.6, "fault")):
        (models / BOXED).write_text(f"v 0 0 0\nv {high} 0 0\nv 0 {high} 0\nf 1 2 3\n")
        finding = check_models(annotation, tmp_path / "shapenet")[-1]
        assert (finding.check, finding.state) == ("CAD meshes", state)
