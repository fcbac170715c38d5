# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json
import shutil

import numpy as np
import pytest
import torch

from raytran.capture.boxes.arkitscenes import find_arkitscenes
from raytran.capture.boxes.categories import Categories
from raytran.classes import Classes
from raytran.data.dataset import scan2cad_dataset
from raytran.data.prepare.prepare_boxes import prepare_boxes
from raytran.data.prepare.scan import PrepareSettings
from raytran.data.scan2cad import read_annotations, scene_objects
from raytran.data.scannet.scan import read_scan
from raytran.errors import ConfigError, DataError
from raytran.geometry.boxes import OrientedBoxes
from raytran.run.prepare.check import check_folder

from .forms import write_arkitscenes

CLASSES = Classes(("bookshelf", "cabinet", "chair", "display", "sofa", "table"))
CATEGORIES = Categories(CLASSES, unknown_left_out=True)
SETTINGS = PrepareSettings((48, 64))
HELD = {"40000001": 0, "40000002": 1, "40000003": 3}
"""Scan → quarter turns by which the phone was held."""


@pytest.fixture(scope="module")
def released(rooms, tmp_path_factory):
    """Three scans as downloaded, the phone held in three ways, the last in the split for validation."""
    root = tmp_path_factory.mktemp("arkitscenes")
    for name, quarters in HELD.items():
        split = "Validation" if name == "40000003" else "Training"
        write_arkitscenes(rooms[0], root / "3dod" / split / name, quarters=quarters)
    return root


def prepare(root, output, **options):
    found = find_arkitscenes(root, CATEGORIES, **options)
    return prepare_boxes(
        output, found.sources, SETTINGS, left_out=found.left_out, processes=1, progress=False
    )


@pytest.fixture(scope="module")
def prepared(released, tmp_path_factory):
    output = tmp_path_factory.mktemp("out") / "data"
    return output, prepare(released, output)


def corners(center, size, rotation):
    return OrientedBoxes(
        *(torch.as_tensor(x, dtype=torch.float64) for x in (center, size, rotation))
    ).corners()


def test_boxes_are_those_of_the_source_to_a_millimetre(prepared, rooms):
    output, result = prepared
    assert result.report["scans"] == {"prepared": 3, "train": 2, "val": 1}
    kept = [i for i, name in enumerate(rooms[0].category) if name in CLASSES.names]
    assert 0 < len(kept) < len(rooms[0].category)
    wanted = corners(*(x[kept] for x in (rooms[0].center, rooms[0].size, rooms[0].rotation)))
    for annotation in read_annotations(output / "scan2cad" / "full_annotations.json").values():
        objects = scene_objects(annotation, CLASSES)
        assert objects.category == tuple(rooms[0].category[i] for i in kept)
        found = corners(objects.center, objects.size, objects.rotation)
        # Where a box's front is, the release does not tell: corners are compared as sets.
        apart = torch.cdist(found, wanted).min(dim=2).values
        assert float(apart.max()) < 1e-3
        assert (objects.size[:, 0] >= objects.size[:, 2] - 1e-6).all()
        assert (objects.rotation[:, 2, 1] > 0.9).all()
        assert torch.linalg.det(objects.rotation.double()).sub(1).abs().max() < 1e-5
        assert set(objects.symmetry.tolist()) <= {2, 4}


def test_frames_are_upright_and_each_has_its_own_camera(prepared, rooms):
    output, result = prepared
    # Of the twelve images of each scan two were taken after the last pose.
    assert result.report["frames"]["dropped"] == {"no pose": 6}
    assert result.report["frames"]["written"] == 30
    for name in HELD:
        scan = read_scan(output / "scannet" / "scans" / name)
        np.testing.assert_allclose(scan.world_from_camera[:, :3, 3], rooms[0].poses[:, :3, 3], atol=0.02)
        tops = -scan.world_from_camera[:, 2, 1]
        assert (tops > 0.5).all()
        focal = scan.intrinsics[:, 0, 0]
        assert len(set(focal.tolist())) == 10
        np.testing.assert_allclose(focal, rooms[0].camera[0], rtol=0.005)
        image = scan.read_color(3).astype(float)
        assert np.abs(image - rooms[0].images[3]).mean() < 6  # JPEG


def test_it_trains_like_any_other_data(prepared):
    output, _ = prepared
    dataset = scan2cad_dataset(
        output, "train", cache_dir=output / "cache", image_size=(48, 64), num_views=4, classes=CLASSES
    )
    scene = dataset[0]
    (objects,) = scene.objects
    assert objects.shape.flatten(1).any(dim=1).all()
    assert scene.occupancy.any()
    assert 0 < scene.foreground.float().mean() < 1


def test_the_doctor_finds_nothing(prepared):
    output, _ = prepared
    examinations, count = check_folder(output)
    assert count == 3
    assert not [finding for examination in examinations for finding in examination.faults]
    assert {f.check for e in examinations for f in e.findings} >= {"boxes in view", "CAD meshes"}


def test_labels_of_no_class_are_left_out_and_named(prepared, rooms):
    others = sorted(set(rooms[0].category) - set(CLASSES.names))
    assert others
    assert prepared[1].report["noticed"]["categories_left_out"] == dict.fromkeys(HELD, ", ".join(others))


@pytest.mark.parametrize(
    ("place", "count"), [(".", 3), ("3dod", 3), ("3dod/Training", 2), ("3dod/Training/40000001", 1)]
)
def test_any_folder_of_a_download_will_do(released, place, count):
    scans = find_arkitscenes(released / place, CATEGORIES).sources
    assert [scan.scene_id for scan in scans] == sorted(HELD)[:count]
    assert [scan.split for scan in scans] == ["train", "train", "val"][:count]


def test_scans_are_chosen_by_name_and_split(released):
    assert [s.scene_id for s in find_arkitscenes(released, CATEGORIES, splits=["val"]).sources] == [
        "40000003"
    ]
    found = find_arkitscenes(released, CATEGORIES, scenes=["4*2"])
    assert [scan.scene_id for scan in found.sources] == ["40000002"]
    with pytest.raises(DataError, match=r"no scan in .* is called 5"):
        find_arkitscenes(released, CATEGORIES, scenes=["5*"])
    with pytest.raises(ConfigError, match=r"unknown splits"):
        find_arkitscenes(released, CATEGORIES, splits=["all"])


def test_incomplete_and_damaged_scans_are_named_and_the_others_prepared(released, tmp_path):
    root = tmp_path / "download"
    training = root / "Training"
    for name in ("1", "2", "3", "4", "5", "6"):
        shutil.copytree(released / "3dod" / "Training" / "40000001", training / name)
        for path in sorted(training.joinpath(name).rglob("40000001*"), reverse=True):
            path.rename(path.with_name(path.name.replace("40000001", name)))
    shutil.rmtree(training / "1" / "1_frames")
    (training / "2" / "2_3dod_annotation.json").unlink()
    (training / "3" / "3_3dod_annotation.json").write_text('{"data": [], "skipped": true}')
    (training / "4" / "4_frames" / "lowres_wide.traj").write_text("1 2 3")
    content = json.loads((training / "5" / "5_3dod_annotation.json").read_text())
    content["data"][0]["segments"]["obbAligned"]["normalizedAxes"] = [1, 0, 0, 1, 0, 0, 0, 0, 1]
    (training / "5" / "5_3dod_annotation.json").write_text(json.dumps(content))
    (training / "6" / "6_3dod_mesh.ply").unlink()
    report = prepare(root, tmp_path / "out").report
    assert report["scans"]["prepared"] == 1
    left_out = report["left_out"]
    assert (left_out["boxes_without_scan"], left_out["scans_without_boxes"]) == (["1"], ["2"])
    failed = left_out["scans_failed"]
    assert "was skipped: it has no boxes" in failed["3"]
    assert "does not hold a time, a turn and a shift" in failed["4"]
    assert "normalizedAxes of box 0 in" in failed["5"]
    assert report["noticed"]["meshes_missing"] == {"6": "6_3dod_mesh.ply"}


def test_what_is_missing_is_told(tmp_path):
    with pytest.raises(DataError, match=r"there is no folder"):
        find_arkitscenes(tmp_path / "none", CATEGORIES)
    with pytest.raises(DataError, match=r"holds no scans of ARKitScenes: give the folder with 3dod/Training"):
        find_arkitscenes(tmp_path, CATEGORIES)
    (tmp_path / "Training" / "1").mkdir(parents=True)
    with pytest.raises(DataError, match=r"none of the 1 scans in .* has boxes: download"):
        find_arkitscenes(tmp_path, CATEGORIES)
    (tmp_path / "Training" / "1" / "1_3dod_annotation.json").write_text("{}")
    with pytest.raises(DataError, match=r"scan 1 in .* has an annotation and no frames: download"):
        find_arkitscenes(tmp_path, CATEGORIES)
