# SPDX-License-Identifier: Apache-2.0
"""Generated CAD models on disk: what is written is read back."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from raytran.data.shapenet.meshes import read_binvox
from raytran.data.shapenet.models import read_mesh
from raytran.rooms.cad import CadModel, sample_model
from raytran.rooms.shapenet_files import write_model


@pytest.fixture(scope="module")
def model() -> CadModel:
    return sample_model("chair", np.random.default_rng(3))


@pytest.fixture(scope="module")
def root(model: CadModel, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("shapenet")
    write_model(model, folder)
    return folder


def test_written_mesh_is_read_back(model: CadModel, root: Path) -> None:
    mesh = read_mesh(root, model.catid, model.model_id)
    np.testing.assert_allclose(mesh.vertices, model.vertices, atol=1e-7)
    as_set = {tuple(face) for face in mesh.faces.tolist()}
    assert as_set == {tuple(face) for face in model.faces.tolist()}
    assert len(mesh.faces) == len(model.faces)


def test_written_folder_holds_the_files_of_shapenet(model: CadModel, root: Path) -> None:
    folder = root / model.catid / model.model_id
    assert {path.name for path in folder.iterdir()} == {"models"}
    endings = ("obj", "mtl", "json", "solid.binvox", "surface.binvox")
    assert {path.name for path in (folder / "models").iterdir()} == {f"model_normalized.{e}" for e in endings}


def test_facts_give_the_original_metres(model: CadModel, root: Path) -> None:
    path = root / model.catid / model.model_id / "models/model_normalized.json"
    facts = json.loads(path.read_text())
    low, high, centroid = (np.array(facts[key]) for key in ("min", "max", "centroid"))
    np.testing.assert_allclose(high - low, model.size_m)
    assert low[1] == pytest.approx(0.0)
    assert facts["id"] == model.model_id
    assert facts["numVertices"] == len(model.vertices)
    # ShapeNet's rule: normalised = (original - centroid) / box diagonal.
    np.testing.assert_allclose((low - centroid) / np.linalg.norm(high - low), model.vertices.min(axis=0))


def test_written_voxels_enclose_the_vertices(model: CadModel, root: Path) -> None:
    folder = root / model.catid / model.model_id / "models"
    solid, translate, scale = read_binvox(folder / "model_normalized.solid.binvox")
    surface, *_ = read_binvox(folder / "model_normalized.surface.binvox")
    assert solid.shape == (128, 128, 128)
    assert (surface <= solid).all()
    assert scale == pytest.approx(np.ptp(model.vertices, axis=0).max())
    cell = np.minimum((model.vertices - translate) / scale * 128, 127).astype(int)
    assert surface[tuple(cell.T)].mean() > 0.99


def test_materials_carry_the_colours(model: CadModel, root: Path) -> None:
    folder = root / model.catid / model.model_id / "models"
    words = [line.split() for line in (folder / "model_normalized.mtl").read_text().splitlines() if line]
    colors = [tuple(map(float, line[1:])) for line in words if line[0] == "Kd"]
    assert len(colors) == model.face_group.max() + 1
    np.testing.assert_allclose(colors[model.face_group[0]], model.face_color[0], atol=1e-4)
    assert (folder / "model_normalized.obj").read_text().count("usemtl ") == len(colors)


def test_writing_twice_leaves_the_first_alone(model: CadModel, root: Path) -> None:
    path = root / model.catid / model.model_id / "models/model_normalized.obj"
    before = path.stat().st_mtime_ns
    assert write_model(model, root) == path.parent
    assert path.stat().st_mtime_ns == before


def test_nothing_is_left_of_a_write_that_fails(
    model: CadModel, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise OSError("disk full")

    monkeypatch.setattr("raytran.rooms.shapenet_files.write_binvox", fail)
    with pytest.raises(OSError, match="disk full"):
        write_model(model, tmp_path)
    assert list((tmp_path / model.catid / model.model_id).iterdir()) == []
