# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json
import shutil

import numpy as np
import pytest

from raytran.errors import DataError
from raytran.rooms.cad import sample_model
from raytran.rooms.kinds import CATID_BY_CLASS, KINDS
from raytran.rooms.library import list_models, read_library, survey, write_library
from raytran.rooms.shapenet_files import write_model

QUIET = {"processes": 1, "progress": False}
CHAIR = CATID_BY_CLASS["chair"]


@pytest.fixture(scope="module")
def generated(tmp_path_factory):
    """Return a folder of generated models of four classes, whose ``.json`` tell no unit, as ShapeNet's."""
    root = tmp_path_factory.mktemp("cads")
    models = [
        sample_model(category, np.random.default_rng(seed))
        for category in ("chair", "table", "trashbin", "sofa")
        for seed in range(6)
    ]
    for model in models:
        write_model(model, root)
    return root, {model.model_id: model for model in models}


@pytest.fixture(scope="module")
def library(generated):
    return survey(generated[0], **QUIET)


def test_every_model_is_found_and_measured(generated, library):
    _, models = generated
    assert {model.model_id for model in library.models} == set(models)
    assert library.left_out == {}
    for found in library.models:
        model = models[found.model_id]
        assert (found.category, found.symmetry) == (model.category, model.symmetry)
        assert KINDS[found.kind].category == model.category
        np.testing.assert_allclose(
            np.divide(found.size_m, np.linalg.norm(found.size_m)),
            model.size_m / np.linalg.norm(model.size_m),
            atol=1e-4,
        )


def test_both_splits_are_there_and_each_model_is_in_one(library):
    assert {model.split for model in library.models} == {"train", "val"}
    assert len({(model.catid, model.model_id) for model in library.models}) == len(library.models)


def test_a_loaded_model_is_what_was_written(generated, library):
    for found in library.models[:4]:
        model, loaded = generated[1][found.model_id], library.load(found)
        # The file groups faces by material.
        order = np.argsort(model.face_group, kind="stable")
        np.testing.assert_allclose(
            loaded.vertices[loaded.faces], model.vertices[model.faces[order]], atol=1e-6
        )
        np.testing.assert_allclose(loaded.face_color, model.face_color[order], atol=1 / 400)
        assert loaded.source == generated[0]
        np.testing.assert_allclose(loaded.size_m, found.size_m)


def test_what_the_json_tells_is_believed(generated, tmp_path):
    name = next((generated[0] / CHAIR).iterdir()).name
    shutil.copytree(generated[0] / CHAIR / name, tmp_path / CHAIR / name)
    path = tmp_path / CHAIR / name / "models" / "model_normalized.json"
    told = {"unit": "m", "kind": "office chair", "symmetry": 4, "split": "val"}
    path.write_text(json.dumps(json.loads(path.read_text()) | told))
    (found,) = survey(tmp_path, **QUIET).models
    assert (found.kind, found.symmetry, found.split) == ("office chair", 4, "val")
    np.testing.assert_allclose(found.size_m, generated[1][name].size_m, atol=1e-4)
    path.write_text(json.dumps(told | {"kind": "desk", "symmetry": 7, "split": "none", "min": "x"}))
    (found,) = survey(tmp_path, **QUIET).models
    assert KINDS[found.kind].category == "chair"
    assert found.symmetry == generated[1][name].symmetry


def test_models_that_cannot_be_used_are_named_with_the_reason(generated, tmp_path, monkeypatch):
    for name in ("good", "damaged", "flat", "large", "heavy"):
        source = next((generated[0] / CHAIR).iterdir())
        shutil.copytree(source, tmp_path / CHAIR / name)
    path = {
        name: tmp_path / CHAIR / name / "models" / "model_normalized.obj"
        for name in ("damaged", "flat", "large", "heavy")
    }
    path["damaged"].write_text("v 0 0 nonsense\n")
    path["flat"].write_text("v -.5 0 0\nv .5 0 0\nv 0 .1 0\nf 1 2 3\n")
    path["large"].write_text("v 0 0 0\nv 9 0 0\nv 0 9 9\nf 1 2 3\n")
    text = path["heavy"].read_text()
    count = text.count("\nf ")
    path["heavy"].write_text(text + text[text.index("\nf ") + 1 :])
    monkeypatch.setattr("raytran.rooms.library.MOST_FACES", count)
    found = survey(tmp_path, **QUIET)
    assert [model.model_id for model in found.models] == ["good"]
    why = {name.split("/")[1]: reason for name, reason in found.left_out.items()}
    words = {"damaged": "damaged", "flat": "flat", "large": "not normalised", "heavy": "triangles"}
    assert set(why) == set(words)
    for name, word in words.items():
        assert word in why[name]
        assert f"{CHAIR}/{name}" in why[name]


def test_a_library_is_read_as_it_was_written(library, tmp_path):
    write_library(library, tmp_path / "cads.json")
    assert str(library.root) not in (tmp_path / "cads.json").read_text()
    assert read_library(tmp_path / "cads.json", library.root) == library
    (tmp_path / "bad.json").write_text('{"models": [{}]}')
    with pytest.raises(DataError, match=r"bad\.json is damaged"):
        read_library(tmp_path / "bad.json", library.root)


def test_a_folder_without_furniture_is_refused(tmp_path):
    with pytest.raises(DataError, match="no CAD model of furniture"):
        list_models(tmp_path)
    folder = tmp_path / CHAIR / "broken" / "models"
    folder.mkdir(parents=True)
    (folder / "model_normalized.obj").write_text("")
    with pytest.raises(DataError, match=f"none of the 1 CAD models .* {CHAIR}/broken"):
        survey(tmp_path, **QUIET)


def test_real_shapenet_models_can_be_used(shared_dir):
    found = survey(shared_dir / "realdata" / "scene0470_00" / "shapenet", **QUIET)
    assert found.left_out == {}
    kinds = sorted(model.kind for model in found.models)
    assert kinds == ["bin", "dining chair", "dining chair", "dining chair", "dining chair", "dining table"]
    table = next(model for model in found.models if model.kind == "dining table")
    assert table.symmetry == 0, "the round table of the annotation, __SYM_ROTATE_UP_INF"
