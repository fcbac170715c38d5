# SPDX-License-Identifier: Apache-2.0
"""Annotations to boxes in the scan frame."""

from __future__ import annotations

import json
import logging
import math

import pytest
import torch

from raytran.classes import PAPER_CLASSES
from raytran.data.scan2cad import read_annotations, scene_alignments, scene_objects
from raytran.errors import DataError
from raytran.geometry.rotation import (
    geodesic_angle,
    matrix_from_quaternion,
    rotation_from_yaw,
    yaw_from_rotation,
)
from raytran.structs import SYMMETRY_INFINITE

IDENTITY = {"translation": [0, 0, 0], "rotation": [1, 0, 0, 0], "scale": [1, 1, 1]}


def objects_of(path, scene_id="scene0000_00"):
    return scene_objects(read_annotations(path)[scene_id])


def test_upright_cube(write_annotations, cube_entry) -> None:
    objects = objects_of(write_annotations({"scene0000_00": [cube_entry(scale=(1.0, 2.0, 3.0))]}))
    assert len(objects) == 1
    assert objects.label.tolist() == [PAPER_CLASSES.index("chair")]
    assert objects.model_id == ("03001627/cube",)
    assert objects.score.tolist() == [1.0]
    assert objects.shape is None
    torch.testing.assert_close(objects.center, torch.tensor([[3.0, 0.0, 1.0]]))
    torch.testing.assert_close(objects.size, torch.tensor([[1.0, 2.0, 3.0]]))
    torch.testing.assert_close(objects.rotation[0], rotation_from_yaw(torch.tensor(0.0)), atol=1e-6, rtol=0)


def test_box_centre_is_not_the_origin_of_the_model(write_annotations, cube_entry) -> None:
    """Model y points up, so a box centre at y = 0.25 under scale 2 lies half a metre higher."""
    entry = cube_entry(scale=(1.0, 2.0, 1.0), center=[0.0, 0.25, 0.0], bbox=[0.5, 0.1, 0.2])
    objects = objects_of(write_annotations({"scene0000_00": [entry]}))
    torch.testing.assert_close(objects.center, torch.tensor([[3.0, 0.0, 1.5]]))
    torch.testing.assert_close(objects.size, torch.tensor([[1.0, 0.4, 0.4]]))


def test_annotation_frame_is_undone(write_annotations, cube_entry) -> None:
    """Turn the annotation frame by 30° about x and shift it: the boxes in the scan stay where they are."""
    path = write_annotations({"scene0000_00": [cube_entry()]})
    expected = objects_of(path)
    turn = math.radians(30)
    w, x = math.cos(turn / 2), math.sin(turn / 2)
    entry = json.loads(path.read_text())[0]
    entry["trs"] = {"translation": [1.0, 2.0, 3.0], "rotation": [-w, -x, 0, 0], "scale": [1, 1, 1]}
    model = entry["aligned_models"][0]["trs"]
    px, py, pz = model["translation"]
    cos, sin = math.cos(turn), math.sin(turn)
    model["translation"] = [px + 1.0, cos * py - sin * pz + 2.0, sin * py + cos * pz + 3.0]
    angle = turn + math.pi / 2
    model["rotation"] = [math.cos(angle / 2), math.sin(angle / 2), 0, 0]
    path.write_text(json.dumps([entry]))
    actual = objects_of(path)
    torch.testing.assert_close(actual.center, expected.center, atol=1e-5, rtol=0)
    torch.testing.assert_close(actual.rotation, expected.rotation, atol=1e-6, rtol=0)


def test_classes_and_symmetries(write_annotations, cube_entry) -> None:
    catids = ["04379243", "03337140", "02747177", "02818832"]
    symmetries = ["__SYM_ROTATE_UP_2", "__SYM_ROTATE_UP_4", "__SYM_ROTATE_UP_INF", "__SYM_NONE"]
    entries = [cube_entry(catid_cad=c, sym=s) for c, s in zip(catids, symmetries, strict=True)]
    objects = objects_of(write_annotations({"scene0000_00": entries}))
    # A file cabinet is no cabinet in Scan2CAD's benchmark, and a bed no class of its own.
    assert [PAPER_CLASSES.names[i] for i in objects.label] == ["table", "other", "trashbin", "other"]
    assert objects.symmetry.tolist() == [2, 4, SYMMETRY_INFINITE, 1]


def test_degenerate_scale_is_skipped_and_counted(write_annotations, cube_entry, caplog) -> None:
    entries = [cube_entry(scale=(1.0, 1e-5, 1.0), id_cad="flat"), cube_entry()]
    with caplog.at_level(logging.WARNING):
        objects = objects_of(write_annotations({"scene0000_00": entries}))
    assert objects.model_id == ("03001627/cube",)
    assert len(objects) == 1
    assert "scene0000_00: skipped 1 models" in caplog.text


def test_flat_model_has_a_size_whose_logarithm_is_finite(write_annotations, cube_entry) -> None:
    objects = objects_of(write_annotations({"scene0000_00": [cube_entry(bbox=[0.5, 0.5, 0.0])]}))
    assert objects.size.log().isfinite().all()


def test_scene_without_models(write_annotations) -> None:
    assert len(objects_of(write_annotations({"scene0000_00": []}))) == 0


def test_files_that_cannot_be_used(tmp_path, write_annotations, cube_entry) -> None:
    with pytest.raises(DataError, match=r"nothing\.json"):
        read_annotations(tmp_path / "nothing.json")
    broken = tmp_path / "broken.json"
    for text in ('[{"id_scan": ', "[" * 100_000):
        broken.write_text(text)
        with pytest.raises(DataError, match="no valid JSON"):
            read_annotations(broken)
    broken.write_text('{"scene": 1}')
    with pytest.raises(DataError, match="not a list of scenes"):
        read_annotations(broken)
    for entry in (
        cube_entry(sym="mirror"),
        cube_entry(bbox=[1, 2]),
        cube_entry(translation=(math.nan, 0, 0)),
        cube_entry(translation=(10**400, 0, 0)),
    ):
        with pytest.raises(DataError, match=r"entry 1 of .*full_annotations\.json"):
            read_annotations(write_annotations({"a": [cube_entry()], "b": [entry]}))


def test_real_annotation(shared_dir) -> None:
    root = shared_dir / "realdata" / "scene0470_00"
    objects = scene_objects(read_annotations(root / "scan2cad" / "full_annotations.json")["scene0470_00"])
    expected = json.loads((root / "reference" / "objects_scan_frame.json").read_text())["objects"]
    assert [PAPER_CLASSES.names[i] for i in objects.label] == [o["class_name"] for o in expected]
    assert objects.model_id == tuple(f"{o['catid_cad']}/{o['id_cad']}" for o in expected)
    assert objects.symmetry.tolist() == [2, 1, 1, 1, 1, SYMMETRY_INFINITE, 1]
    millimetre = {"atol": 1e-3, "rtol": 0.0}
    torch.testing.assert_close(
        objects.center, torch.tensor([o["box_center"] for o in expected]), **millimetre
    )
    torch.testing.assert_close(
        objects.size, torch.tensor([o["box_size_metres"] for o in expected]), **millimetre
    )
    rotation = torch.tensor([o["rotation_matrix"] for o in expected], dtype=torch.float64)
    assert geodesic_angle(objects.rotation.double(), rotation).rad2deg().max() < 0.1
    tilt = torch.acos(objects.rotation[:, 2, 1]).rad2deg()
    assert tilt.tolist() == pytest.approx([o["tilt_of_cad_up_from_scan_z_deg"] for o in expected], abs=0.1)
    yaw = yaw_from_rotation(objects.rotation).rad2deg()
    off = yaw - torch.tensor([o["yaw_about_scan_z_deg"] for o in expected])
    assert ((off + 180) % 360 - 180).abs().max() < 0.2
    signs = torch.tensor([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) / 2
    corners = (signs * objects.size[:, None]) @ objects.rotation.mT + objects.center[:, None]
    true_corners = torch.tensor([o["corners"] for o in expected])
    assert torch.cdist(corners, true_corners).amin(dim=-1).max() < 1e-3


def test_alignments_are_the_poses_taken_apart(shared_dir) -> None:
    path = shared_dir / "realdata" / "scene0470_00" / "scan2cad" / "full_annotations.json"
    annotation = read_annotations(path)["scene0470_00"]
    alignments, objects = scene_alignments(annotation), scene_objects(annotation)
    turned = matrix_from_quaternion(alignments.quaternion) * alignments.scale[:, None]
    torch.testing.assert_close(turned, annotation.scan_from_cad[:, :3, :3], atol=1e-12, rtol=0)
    centre = alignments.translation + (turned @ alignments.center[..., None])[..., 0]
    torch.testing.assert_close(centre.float(), objects.center)
    torch.testing.assert_close((2 * alignments.half_extent * alignments.scale).float(), objects.size)
    assert alignments.model_id == objects.model_id
    assert alignments.category == tuple(PAPER_CLASSES.names[label] for label in objects.label.tolist())
    assert alignments.symmetry.tolist() == [2, 1, 1, 1, 1, SYMMETRY_INFINITE, 1]


def test_alignments_keep_what_is_degenerate(write_annotations, cube_entry) -> None:
    path = write_annotations({"scene0000_00": [cube_entry(scale=(1.0, 0.0, 1.0)), cube_entry()]})
    alignments = scene_alignments(read_annotations(path)["scene0000_00"])
    assert len(alignments) == 2
    assert alignments.quaternion.isnan().all(dim=1).tolist() == [True, False]
    assert alignments.annotated_scale.tolist() == [[1, 0, 1], [1, 1, 1]]


NONSENSE = [
    {"translation": (1e300, 0, 0)},
    {"scale": (1e300, 1, 1)},
    {"bbox": [10**400, 1, 1]},
    {"bbox": [-1, 1, 1]},
    {"bbox": {"x": 1}},
    {"center": [None] * 3},
    {"sym": ["__SYM_NONE"]},
    {"catid_cad": 3001627},
    {"id_cad": "x" * 10**6},
    {"id_cad": "\x1b[2J"},
    {"trs": "none"},
    {"trs": {}},
]


@pytest.mark.parametrize("fields", NONSENSE)
def test_nonsense_ends_in_one_short_sentence(write_annotations, cube_entry, fields) -> None:
    with pytest.raises(DataError, match=r"^entry 0 of .*full_annotations\.json") as error:
        read_annotations(write_annotations({"a": [cube_entry(**fields)]}))
    assert len(str(error.value).replace(str(error.value).split(" ")[3], "")) < 250


@pytest.mark.parametrize(
    "entry",
    [
        5,
        None,
        [],
        "a",
        {},
        {"id_scan": "a"},
        {"id_scan": "a", "aligned_models": {}, "trs": {}},
        {"id_scan": ["a"], "aligned_models": [], "trs": IDENTITY},
        {"id_scan": "a", "aligned_models": [5], "trs": IDENTITY},
        {"id_scan": "a", "aligned_models": [], "trs": IDENTITY | {"scale": [0, 1, 1]}},
        {"id_scan": "a", "aligned_models": [], "trs": IDENTITY | {"rotation": [0, 0, 0, 1e-300]}},
    ],
)
def test_entries_of_another_shape_are_named(tmp_path, entry) -> None:
    path = tmp_path / "full_annotations.json"
    path.write_text(json.dumps([entry]))
    with pytest.raises(DataError, match=r"^entry 0 of .*full_annotations\.json"):
        read_annotations(path)
