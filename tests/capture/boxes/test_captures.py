# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from raytran.capture.boxes.captures import find_captures
from raytran.capture.boxes.categories import Categories
from raytran.classes import PAPER_CLASSES
from raytran.data.dataset import scan2cad_dataset
from raytran.data.prepare.prepare_boxes import prepare_boxes
from raytran.data.prepare.scan import PrepareSettings
from raytran.errors import DataError

from .forms import listed, write_capture, write_mesh

SETTINGS = PrepareSettings((48, 64))
CATEGORIES = Categories(PAPER_CLASSES)
KINDS = ("colmap", "tum", "video", "video file")


def prepare(folder, output, **options):
    found = find_captures(folder, CATEGORIES)
    return prepare_boxes(
        output, found.sources, SETTINGS, left_out=found.left_out, processes=1, progress=False, **options
    )


def scene_of(output, split, scene_id):
    dataset = scan2cad_dataset(
        output, split, cache_dir=output / "cache", image_size=(48, 64), num_views=4, view_choice="even"
    )
    return dataset[dataset.scene_ids.index(scene_id)]


@pytest.fixture(scope="module")
def prepared(rooms, tmp_path_factory):
    """One room as captures of four kinds, one of them with a mesh and one without boxes, prepared."""
    folder, output = tmp_path_factory.mktemp("captures"), tmp_path_factory.mktemp("out") / "data"
    for number, kind in enumerate(KINDS):
        write_capture(rooms[0], folder / f"{kind.replace(' ', '-')} {number}", kind)
    write_mesh(rooms[0], folder / "tum 1" / "mesh.ply")
    write_capture(rooms[0], folder / "plain", "tum")
    (folder / "plain" / "boxes.json").unlink()
    (folder / "lost.boxes.json").write_text("[]")
    return output, prepare(folder, output)


def test_captures_of_every_kind_are_prepared_alike(prepared, rooms):
    output, result = prepared
    assert result.report["scans"] == {"prepared": 4, "train": 3, "val": 1}
    assert result.report["left_out"] == {
        "scans_failed": {},
        "scans_without_boxes": ["plain"],
        "boxes_without_scan": ["lost.boxes.json"],
    }
    names = {
        split: (output / "scannet" / f"scannetv2_{split}.txt").read_text().split()
        for split in ("train", "val")
    }
    assert sorted(names["train"] + names["val"]) == ["colmap_0", "tum_1", "video-file_3", "video_2"]
    for split, scans in names.items():
        for scan in scans:
            scene = scene_of(output, split, scan)
            (objects,) = scene.objects
            assert objects.category == tuple(rooms[0].category)
            np.testing.assert_allclose(objects.center, rooms[0].center, atol=1e-3)
            np.testing.assert_allclose(objects.size, rooms[0].size, atol=1e-3)
            np.testing.assert_allclose(objects.rotation, rooms[0].rotation, atol=1e-5)
            assert scene.foreground.any()
            assert scene.occupancy.any()


def test_only_a_mesh_tells_shapes(prepared, rooms):
    output, result = prepared
    assert set(result.report["noticed"]["objects_without_shape"]) == {"colmap_0", "video-file_3", "video_2"}
    assert "nothing but the box is known: 3" in result.text
    split_of = {
        scan: split
        for split in ("train", "val")
        for scan in (output / "scannet" / f"scannetv2_{split}.txt").read_text().split()
    }
    with_mesh = scene_of(output, split_of["tum_1"], "tum_1")
    without = scene_of(output, split_of["colmap_0"], "colmap_0")
    assert with_mesh.objects[0].shape.flatten(1).any(dim=1).all()
    assert not without.objects[0].shape.any()
    # Boxes stand for objects in all other targets, which are larger for it.
    assert without.occupancy.sum() > with_mesh.occupancy.sum() > 0
    assert without.foreground.sum() >= with_mesh.foreground.sum() > 0
    assert len(with_mesh.objects[0]) == len(rooms[0].category)


def test_boxes_are_turned_with_a_world_that_is_not_upright(rooms, tmp_path):
    down = np.diag([1.0, -1.0, -1.0])
    turned = replace(
        rooms[0],
        poses=np.array(
            [np.block([[down @ p[:3, :3], (down @ p[:3, 3])[:, None]], [p[3:]]]) for p in rooms[0].poses]
        ),
        center=rooms[0].center @ down.T,
        rotation=down @ rooms[0].rotation,
    )
    lists = tmp_path / "lists"
    lists.mkdir()
    write_capture(turned, tmp_path / "captures" / "poses", "tum")
    write_capture(turned, tmp_path / "captures" / "upright", "tum")
    # As predict would write them: in the world that it turned upright.
    found = find_captures(tmp_path / "captures", CATEGORIES)
    with found.sources[1].open() as scan:
        moved = scan.world_from_input
    upright = found.sources[0].read_objects(scan)
    np.testing.assert_allclose(moved[:3, 2].numpy(), [0, 0, -1], atol=1e-6)
    entries = [
        {"category": c, "center": center.tolist(), "size": size.tolist(), "rotation": rotation.tolist()}
        for c, center, size, rotation in zip(
            upright.category, upright.center, upright.size, upright.rotation, strict=True
        )
    ]
    (lists / "upright.json").write_text(json.dumps({"up": "+z", "objects": entries}))
    again = find_captures(tmp_path / "captures", CATEGORIES, boxes=lists)
    assert again.sources[1].boxes == lists / "upright.json"
    prepare_boxes(tmp_path / "out", again.sources, SETTINGS, processes=1, progress=False, val_share=0)
    first, second = (scene_of(tmp_path / "out", "train", name) for name in ("poses", "upright"))
    torch.testing.assert_close(first.objects[0].center, second.objects[0].center)
    torch.testing.assert_close(first.foreground, second.foreground)
    assert (first.objects[0].rotation[:, 2, 1] > 0.9).all()  # they stand
    assert first.foreground.any()


def test_settings_of_the_capture_stand_in_its_list(rooms, tmp_path):
    small = replace(rooms[0], center=rooms[0].center / 2, size=rooms[0].size / 2, poses=rooms[0].poses.copy())
    small.poses[:, :3, 3] /= 2
    boxes = {"objects": listed(small), "split": "val", "capture": {"scale": 2.0, "check": False}}
    write_capture(small, tmp_path / "captures" / "half", "tum", boxes)
    prepare(tmp_path / "captures", tmp_path / "out")
    (objects,) = scene_of(tmp_path / "out", "val", "half").objects
    np.testing.assert_allclose(objects.center, rooms[0].center, atol=1e-3)
    np.testing.assert_allclose(objects.size, rooms[0].size, atol=1e-3)


def changed(scan, **factors):
    entries = listed(scan)
    for entry in entries:
        for key, factor in factors.items():
            entry[key] = [factor * value for value in entry[key]]
    return entries


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"size": 1000, "center": 1000}, "are in millimetres: write metres"),
        ({"size": 100, "center": 100}, "are in centimetres: write metres"),
        ({"center": 1000}, "lie .* m from the cameras: give their centres in metres"),
        ({"center": -20}, "no camera sees any of the 5 boxes .* they are in another world than the poses"),
    ],
)
def test_boxes_that_cannot_be_are_told_in_a_sentence(rooms, tmp_path, change, said):
    write_capture(rooms[0], tmp_path / "captures" / "room", "tum", changed(rooms[0], **change))
    with pytest.raises(DataError, match=said):
        prepare(tmp_path / "captures", tmp_path / "out")


def test_one_box_that_is_too_large_is_named(rooms, tmp_path):
    entries = listed(rooms[0])
    entries[1]["size"] = [25.0, 1, 1]
    write_capture(rooms[0], tmp_path / "captures" / "room", "tum", entries)
    with pytest.raises(DataError, match=r"object 1 \(\w+\) in .* is 25 m long, as nothing in a room is"):
        prepare(tmp_path / "captures", tmp_path / "out")


def test_what_is_missing_is_told(tmp_path):
    with pytest.raises(DataError, match=r"there is no folder"):
        find_captures(tmp_path / "none", CATEGORIES)
    with pytest.raises(DataError, match=r"there is no folder .* of lists: check boxes="):
        find_captures(tmp_path, CATEGORIES, boxes=tmp_path / "none")
    with pytest.raises(DataError, match=r"holds no captures"):
        find_captures(tmp_path, CATEGORIES)
    (tmp_path / "x").mkdir()
    with pytest.raises(
        DataError, match=r"none of the 1 captures in .* has a list of boxes: write boxes.json"
    ):
        find_captures(tmp_path, CATEGORIES)
    (tmp_path / "a.boxes.json").write_text("[]")
    with pytest.raises(DataError, match=r"a\.boxes\.json lies in .* without frames"):
        find_captures(tmp_path, CATEGORIES)
    (tmp_path / "x" / "boxes.json").write_text("[]")
    with pytest.raises(DataError, match=r"boxes\.json has no frames that can be read"):
        prepare(tmp_path, tmp_path.parent / f"{tmp_path.name}-out")


def test_two_captures_of_one_name_are_told_apart(tmp_path):
    for name in ("a b", "a_b"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "boxes.json").write_text("[]")
    with pytest.raises(DataError, match=r"two captures in .* are called a_b"):
        find_captures(tmp_path, CATEGORIES)
