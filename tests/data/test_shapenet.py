# SPDX-License-Identifier: Apache-2.0
"""CAD models on disk: what is written is read back; real and damaged files."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from raytran.data.rooms.cad import CadModel, sample_model
from raytran.data.shapenet import read_binvox, read_mesh, write_binvox, write_model
from raytran.errors import DataError


@pytest.fixture(scope="module")
def model() -> CadModel:
    return sample_model("chair", np.random.default_rng(3))


@pytest.fixture(scope="module")
def root(model: CadModel, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("shapenet")
    write_model(model, folder)
    return folder


def put_obj(root: Path, text: str) -> None:
    folder = root / "03001627/abc/models"
    folder.mkdir(parents=True)
    (folder / "model_normalized.obj").write_text(text)


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

    monkeypatch.setattr("raytran.data.shapenet.write_binvox", fail)
    with pytest.raises(OSError, match="disk full"):
        write_model(model, tmp_path)
    assert list((tmp_path / model.catid / model.model_id).iterdir()) == []


def test_all_forms_of_faces_are_read(tmp_path: Path) -> None:
    text = """# made by hand
mtllib model_normalized.mtl
v 0 0 0
v 1 0 0 0.5 0.5 0.5
v 1 1 0
v 0 1 0
v 9 9 9
vn 0 0 1
vt 0 0
g first
usemtl a
f 1//1 2//1 3//1
l 1 2
f 1/1/1 3/1/1 4/1/1
g second
f 1 2 3 4
f -5 -4 -3
"""
    put_obj(tmp_path, text)
    mesh = read_mesh(tmp_path, "03001627", "abc")
    assert mesh.vertices.shape == (5, 3)
    assert mesh.faces.tolist() == [[0, 1, 2], [0, 2, 3], [0, 1, 2], [0, 2, 3], [0, 1, 2]]


def test_the_official_parent_folder_is_accepted(tmp_path: Path) -> None:
    put_obj(tmp_path / "ShapeNetCore.v2", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    assert len(read_mesh(tmp_path, "03001627", "abc").faces) == 1


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\n", "no faces"),
        ("v 0 0 0\nv 1 0 0\nf 1 2 3\n", "misses vertices"),
        ("v 0 0 zero\nf 1 1 1\n", "damaged"),
        ("v 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "damaged"),
        ("v 0 0 0\nf 1 x 3\n", "damaged"),
    ],
)
def test_damaged_meshes_are_named(tmp_path: Path, text: str, reason: str) -> None:
    put_obj(tmp_path, text)
    with pytest.raises(DataError, match=rf"abc/models/model_normalized\.obj.*{reason}"):
        read_mesh(tmp_path, "03001627", "abc")


def test_missing_models_are_named(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"no CAD model at .*03001627/abc/models"):
        read_mesh(tmp_path, "03001627", "abc")
    (tmp_path / "03001627/abc/models").mkdir(parents=True)
    with pytest.raises(DataError, match=r"cannot read the CAD model .*model_normalized\.obj: No such file"):
        read_mesh(tmp_path, "03001627", "abc")


def test_binvox_is_read_in_the_order_x_z_y(tmp_path: Path) -> None:
    # Of 2 × 2 × 2 cells, the file's second value is (x, y, z) = (0, 1, 0) and its third (0, 0, 1).
    header = b"#binvox 1\ndim 2 2 2\ntranslate -0.5 0 0.25\nscale 2\ndata\n"
    path = tmp_path / "two.binvox"
    path.write_bytes(header + bytes([0, 1, 1, 1, 0, 6]))
    cells, translate, scale = read_binvox(path)
    assert np.argwhere(cells).tolist() == [[0, 1, 0]]
    assert translate.tolist() == [-0.5, 0.0, 0.25]
    assert scale == 2.0


@pytest.mark.parametrize("share", [0.0, 0.002, 0.5, 1.0])
def test_binvox_round_trip(tmp_path: Path, share: float) -> None:
    cells = np.random.default_rng(0).random((20, 20, 20)) < share
    write_binvox(tmp_path / "a.binvox", cells, (0.1, -0.2, 1 / 3), 0.7)
    again, translate, scale = read_binvox(tmp_path / "a.binvox")
    np.testing.assert_array_equal(again, cells)
    assert translate.tolist() == [0.1, -0.2, 1 / 3]
    assert scale == 0.7


def test_damaged_voxels_are_named(tmp_path: Path) -> None:
    path = tmp_path / "a.binvox"
    with pytest.raises(DataError, match=r"cannot read the voxels .*a\.binvox"):
        read_binvox(path)
    write_binvox(path, np.ones((8, 8, 8), dtype=bool), (0, 0, 0), 1.0)
    whole = path.read_bytes()
    for content in (whole[:-2], whole[:-1], whole[:20], b"", whole.replace(b"scale", b"scald")):
        path.write_bytes(content)
        with pytest.raises(DataError, match=r"a\.binvox is damaged"):
            read_binvox(path)


def test_real_models_are_normalised(shared_dir: Path) -> None:
    root = shared_dir / "realdata/scene0470_00/shapenet"
    folders = sorted(root.glob("*/*/models"))
    assert len(folders) == 6
    for folder in folders:
        mesh = read_mesh(root, folder.parts[-3], folder.parts[-2])
        facts = json.loads((folder / "model_normalized.json").read_text())
        assert len(mesh.vertices) == facts["numVertices"]
        # Files carry six decimals.
        assert np.linalg.norm(np.ptp(mesh.vertices, axis=0)) == pytest.approx(1, abs=2e-6)
        np.testing.assert_allclose(mesh.vertices.mean(axis=0), 0.0, atol=1e-6)
        solid, translate, scale = read_binvox(folder / "model_normalized.solid.binvox")
        surface, *_ = read_binvox(folder / "model_normalized.surface.binvox")
        assert (surface <= solid).all()
        np.testing.assert_allclose(translate, mesh.vertices.min(axis=0), atol=1e-5)
        assert scale == pytest.approx(np.ptp(mesh.vertices, axis=0).max(), abs=1e-5)
