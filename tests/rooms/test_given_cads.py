# SPDX-License-Identifier: Apache-2.0
"""Rooms furnished with given CAD models."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest

from raytran.data.scan2cad import read_annotations, scene_objects
from raytran.data.shapenet.models import has_model
from raytran.errors import DataError
from raytran.rooms.cad import RECIPES, finish_model
from raytran.rooms.generate import generate_rooms
from raytran.rooms.library import FEW, ModelPool, read_library
from raytran.rooms.shapenet_files import write_model

from ..factories import digests

SMALL = {"frames": 4, "image_size": (48, 64), "max_objects": 8, "progress": False, "seed": 3, "processes": 1}
NUMBERS = {"num_train": 2, "num_val": 1}


@pytest.fixture(scope="module")
def made(cads, tmp_path_factory):
    root = tmp_path_factory.mktemp("made")
    return root, generate_rooms(root, cads=cads, **NUMBERS, **SMALL)


def placed_models(root):
    entries = json.loads((root / "scan2cad" / "full_annotations.json").read_text())
    return {
        entry["id_scan"]: [(model["catid_cad"], model["id_cad"]) for model in entry["aligned_models"]]
        for entry in entries
    }


def test_given_models_stand_in_rooms_of_their_split_only(made, cads):
    root, report = made
    split = {(m.catid, m.model_id): m.split for m in read_library(root / "cads.json", cads).models}
    found = placed_models(root)
    given = {scan: {split[name] for name in names if name in split} for scan, names in found.items()}
    assert given == {scan: {"train" if scan in report.train else "val"} for scan in found}
    for names in found.values():
        assert all(has_model(root / "shapenet", *name) for name in names)


def test_objects_have_the_size_of_their_model(made, cads):
    root, _ = made
    size = {f"{m.catid}/{m.model_id}": m.size_m for m in read_library(root / "cads.json", cads).models}
    checked = 0
    for annotation in read_annotations(root / "scan2cad" / "full_annotations.json").values():
        objects = scene_objects(annotation)
        for name, box in zip(objects.model_id, objects.size.numpy(), strict=True):
            if name in size:
                np.testing.assert_allclose(box, size[name], rtol=0.051)
                checked += 1
    assert checked > 3


def test_symmetry_is_annotated(made, cads):
    root, _ = made
    symmetry = {f"{m.catid}/{m.model_id}": m.symmetry for m in read_library(root / "cads.json", cads).models}
    for annotation in read_annotations(root / "scan2cad" / "full_annotations.json").values():
        for name, value in zip(annotation.model_id, annotation.symmetry.tolist(), strict=True):
            assert value == symmetry.get(name, value)


def test_notices_go_with_the_models(made):
    assert (made[0] / "shapenet" / "credits.csv").read_text() == "model,creator\n"


def test_same_bytes_elsewhere_and_after_a_broken_off_run(made, cads, tmp_path):
    root, _ = made
    copy = tmp_path / "copy"
    shutil.copytree(root, copy)
    shutil.rmtree(copy / "scannet" / "scans" / "scene0001_00")
    shutil.rmtree(copy / "shapenet")
    (copy / "cads.json").unlink()
    moved = tmp_path / "moved"
    shutil.copytree(cads, moved)
    shutil.rmtree(copy / "scannet" / "scans" / "scene0000_00")
    shutil.rmtree(copy / "scannet" / "scans" / "scene0002_00")
    assert generate_rooms(copy, cads=moved, **NUMBERS, **SMALL).made == 3
    assert digests(copy) == digests(root)


def test_other_models_than_at_first_are_refused(made, cads, tmp_path):
    root, _ = made
    fewer = tmp_path / "fewer"
    shutil.copytree(cads, fewer)
    shutil.rmtree(next((fewer / "03001627").iterdir()))
    before = digests(root)
    for other in (fewer, None):
        with pytest.raises(DataError, match=r"other settings \(cads\)"):
            generate_rooms(root, cads=other, **NUMBERS, **SMALL)
    assert digests(root) == before


def test_damaged_models_are_left_out_and_named(cads, tmp_path, caplog):
    some = tmp_path / "some"
    shutil.copytree(cads, some)
    broken = next((some / "03001627").iterdir())
    (broken / "models" / "model_normalized.obj").write_text("f 1 2 3\n")
    report = generate_rooms(tmp_path / "out", cads=some, num_train=1, num_val=0, **SMALL)
    name = f"03001627/{broken.name}"
    assert list(report.cads_left_out) == [name]
    assert "1 of 36 CAD models are not used" in caplog.text
    assert json.loads((tmp_path / "out" / "cads.json").read_text())["left_out"][name]
    assert tuple(name.split("/")) not in placed_models(tmp_path / "out")["scene0000_00"]


def test_pools_fill_up_with_generated_models_only_where_few_are_given(made, cads):
    library = read_library(made[0] / "cads.json", cads)
    given = {m.model_id for m in library.models if m.split == "train" and m.category == "chair"}
    drawn = [ModelPool(0, library).draw("chair", np.random.default_rng(seed)) for seed in range(60)]
    share = np.mean([model.model_id in given for model in drawn])
    assert abs(share - len(given) / FEW) < 0.2
    assert all((model.source == cads) == (model.model_id in given) for model in drawn)


def test_kinds_that_nobody_has_are_not_drawn(made, cads):
    pool = ModelPool(0, read_library(made[0] / "cads.json", cads))
    assert pool.draw("other", np.random.default_rng(0), kinds=("piano",)) is None
    assert not pool.has("piano")
    assert not ModelPool(0).has("bed")


def test_an_unused_vertex_does_not_change_the_size(tmp_path):
    """ShapeNet's files hold vertices that no face uses; its box and its origin count them."""
    category, (_, recipe) = "trashbin", RECIPES["trashbin"][0]
    model = finish_model(category, recipe(np.random.default_rng(0)))
    path = write_model(model, tmp_path) / "model_normalized.obj"
    path.write_text(path.read_text() + "v 0.1 0 0.1\n")
    path.with_suffix(".json").unlink()
    generate_rooms(tmp_path / "out", cads=tmp_path, num_train=1, num_val=0, **SMALL)
    (found,) = read_library(tmp_path / "out" / "cads.json", tmp_path).models
    assert np.isclose(found.size_m[0] / found.size_m[1], model.size_m[0] / model.size_m[1], rtol=1e-3)
