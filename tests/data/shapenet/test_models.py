# SPDX-License-Identifier: Apache-2.0
"""CAD models of both releases of ShapeNetCore: found, read in one frame, copied whole."""

from __future__ import annotations

from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pytest

from raytran.data.shapenet.meshes import read_binvox, write_binvox
from raytran.data.shapenet.models import (
    copy_model,
    has_model,
    mesh_path,
    read_facts,
    read_mesh,
    shapenet_version,
)
from raytran.errors import DataError
from raytran.rooms.cad import CadModel, sample_model
from raytran.rooms.shapenet_files import write_model

CATID, MODEL_ID = "03001627", "abc"
MODEL = (CATID, MODEL_ID)
TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"


def put_v2(root: Path, text: str = TRIANGLE, model_id: str = MODEL_ID) -> Path:
    path = root / CATID / model_id / "models/model_normalized.obj"
    path.parent.mkdir(parents=True)
    path.write_text(text)
    return path


def put_v1(root: Path, text: str = TRIANGLE, model_id: str = MODEL_ID) -> Path:
    path = root / CATID / model_id / "model.obj"
    path.parent.mkdir(parents=True)
    path.write_text(text)
    return path


@pytest.fixture(scope="module")
def chair() -> CadModel:
    return sample_model("chair", np.random.default_rng(3))


@pytest.fixture
def both(chair: CadModel, tmp_path: Path) -> tuple[Path, Path, tuple[str, str]]:
    """Roots of one chair in v2 and in v1, where it looks along +X around the middle of a unit cube."""
    v2, v1 = tmp_path / "new", tmp_path / "old"
    folder = write_model(chair, v2)
    place = v1 / chair.catid / chair.model_id
    place.mkdir(parents=True)
    scale = 1 / np.ptp(chair.vertices, axis=0).max()
    center = (chair.vertices.min(axis=0) + chair.vertices.max(axis=0)) / 2
    x, y, z = ((chair.vertices - center) * scale).T
    old = iter(np.stack([-z, y, x], axis=1).tolist())
    lines = (folder / "model_normalized.obj").read_text().splitlines()
    text = "\n".join(
        "v {:.9f} {:.9f} {:.9f}".format(*next(old)) if line[:2] == "v " else line for line in lines
    )
    (place / "model.obj").write_text(text.replace("model_normalized.mtl", "model.mtl") + "\n")
    (place / "model.mtl").write_bytes((folder / "model_normalized.mtl").read_bytes())
    cells, low, side = read_binvox(folder / "model_normalized.solid.binvox")
    # v1's z is v2's x, and v1's x is minus v2's z.
    low = (low - center) * scale
    old_cells = cells.transpose(2, 1, 0)[::-1]
    write_binvox(
        place / "model.solid.binvox", old_cells, (-low[2] - side * scale, low[1], low[0]), side * scale
    )
    return v2, v1, (chair.catid, chair.model_id)


NESTS = (
    *(".", "ShapeNetCore.v2", "ShapeNetCore.v2/ShapeNetCore.v2", "ShapeNetCore", "ShapeNetCore.v1"),
    "shapenet",
)


@pytest.mark.parametrize("nest", NESTS)
@pytest.mark.parametrize(("put", "version"), [(put_v1, "v1"), (put_v2, "v2")])
def test_models_are_found_however_the_archive_nests(tmp_path: Path, nest: str, put, version: str) -> None:
    path = put(tmp_path / nest)
    assert mesh_path(tmp_path, *MODEL).samefile(path)
    assert shapenet_version(tmp_path) == version
    assert has_model(tmp_path, *MODEL)
    assert not has_model(tmp_path, CATID, "abd")
    assert len(read_mesh(tmp_path, *MODEL).faces) == 1


def test_v2_is_preferred(tmp_path: Path) -> None:
    put_v1(tmp_path / "ShapeNetCore.v1")
    path = put_v2(tmp_path / "ShapeNetCore.v2")
    assert mesh_path(tmp_path, *MODEL).samefile(path)
    assert shapenet_version(tmp_path) == "v2"
    put_v1(tmp_path / "ShapeNetCore.v1", model_id="only_old")
    assert mesh_path(tmp_path, CATID, "only_old").name == "model.obj"


def test_folders_without_models(tmp_path: Path) -> None:
    (tmp_path / CATID / MODEL_ID / "models").mkdir(parents=True)
    with pytest.raises(DataError, match=r"no CAD model of ShapeNetCore v1 or v2 lies in .*give the folder"):
        shapenet_version(tmp_path)
    (tmp_path / "03001627.zip").touch()
    with pytest.raises(DataError, match=r"unpack 03001627\.zip"):
        shapenet_version(tmp_path)
    with pytest.raises(DataError, match=r"no CAD model 03001627/abc in .*add it there"):
        read_mesh(tmp_path, *MODEL)


@pytest.mark.parametrize("model_id", ["../abc", "..", ".", "", "a/b", "/tmp"])
def test_names_cannot_lead_out_of_the_folder(tmp_path: Path, model_id: str) -> None:
    put_v2(tmp_path / "in")
    put_v2(tmp_path)
    for name in ((CATID, model_id), (model_id, MODEL_ID)):
        assert not has_model(tmp_path / "in", *name)
        with pytest.raises(DataError, match="no CAD model"):
            copy_model(tmp_path / "in", *name, tmp_path / "out" / "shapenet")
    assert not (tmp_path / "out").exists()


def test_the_front_of_v1_is_turned_to_that_of_v2(tmp_path: Path) -> None:
    # A wedge whose tip points to the front, +X, and whose left side is longer: +Z is right of the front.
    put_v1(tmp_path, "v 0.5 0 0\nv -0.5 0 -0.4\nv -0.5 0 0.1\nv -0.5 0.3 0\nf 1 2 3\nf 1 3 4\n")
    vertices = np.asarray(read_mesh(tmp_path, *MODEL).vertices)
    assert np.linalg.norm(np.ptp(vertices, axis=0)) == pytest.approx(1.0)
    np.testing.assert_allclose(vertices.mean(axis=0), 0.0, atol=1e-12)
    tip, left, right, top = vertices
    assert tip[2] == vertices[:, 2].min()
    assert top[1] == vertices[:, 1].max()
    # Seen along -Z with +Y up, the right is +X.
    assert left[0] < right[0]


def test_both_releases_give_one_mesh(both, chair: CadModel) -> None:
    v2, v1, model = both
    new, old = read_mesh(v2, *model), read_mesh(v1, *model)
    np.testing.assert_array_equal(new.faces, old.faces)
    np.testing.assert_allclose(old.vertices, new.vertices - new.vertices.mean(axis=0), atol=2e-7)
    facts = read_facts(v1, *model)
    assert facts.num_vertices == len(chair.vertices)
    shape = (facts.high - facts.low) / np.linalg.norm(facts.high - facts.low)
    np.testing.assert_allclose(shape, np.ptp(chair.vertices, axis=0), atol=1e-6)


def test_copies_of_v2_have_the_same_bytes(both, tmp_path: Path) -> None:
    v2, _, model = both
    (mesh_path(v2, *model).parents[1] / "images").mkdir()
    folder = copy_model(v2, *model, tmp_path / "out")
    assert folder == tmp_path / "out" / model[0] / model[1] / "models"
    names = {f"model_normalized.{ending}" for ending in ("obj", "mtl", "json", "solid.binvox")}
    assert {path.name for path in folder.iterdir()} == names
    assert [path.name for path in folder.parent.iterdir()] == ["models"]
    for name in names:
        assert (folder / name).read_bytes() == (mesh_path(v2, *model).parent / name).read_bytes()


def test_copies_of_v1_are_models_of_v2(both, tmp_path: Path) -> None:
    _, v1, model = both
    folder = copy_model(v1, *model, tmp_path / "out")
    assert shapenet_version(tmp_path / "out") == "v2"
    old, new = read_mesh(v1, *model), read_mesh(tmp_path / "out", *model)
    np.testing.assert_allclose(new.vertices, old.vertices, atol=1e-7)
    np.testing.assert_array_equal(new.faces, old.faces)
    facts, source = read_facts(tmp_path / "out", *model), read_facts(v1, *model)
    assert facts.num_vertices == source.num_vertices
    for value, expected in zip(
        (facts.low, facts.high, facts.centroid), (source.low, source.high, source.centroid), strict=True
    ):
        np.testing.assert_array_equal(value, expected)
    text = (folder / "model_normalized.obj").read_text()
    assert text.startswith("mtllib model_normalized.mtl\n")
    assert text.count("usemtl ") == (folder / "model_normalized.mtl").read_text().count("newmtl ")
    # The voxels lie on the mesh as those of v2 do on theirs.
    v2, *_ = both
    expected, low, side = read_binvox(mesh_path(v2, *model).with_name("model_normalized.solid.binvox"))
    cells, translate, scale = read_binvox(folder / "model_normalized.solid.binvox")
    np.testing.assert_array_equal(cells, expected)
    assert scale == pytest.approx(side, abs=1e-6)
    shift = read_mesh(v2, *model).vertices.mean(axis=0)
    np.testing.assert_allclose(translate, low - shift, atol=1e-6)


def test_damaged_voxels_do_not_cost_the_mesh(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    put_v1(tmp_path).with_name("model.solid.binvox").write_bytes(b"#binvox 1\n")
    folder = copy_model(tmp_path, *MODEL, tmp_path / "out")
    assert {path.name for path in folder.iterdir()} == {"model_normalized.obj", "model_normalized.json"}
    assert "model.solid.binvox is damaged" in caplog.text


def test_a_copy_is_whole_or_absent(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    put_v2(tmp_path)

    def fail(*_: object) -> None:
        raise OSError("disk full")

    monkeypatch.setattr("shutil.copyfile", fail)
    with pytest.raises(OSError, match="disk full"):
        copy_model(tmp_path, *MODEL, tmp_path / "out")
    assert [path for path in (tmp_path / "out").rglob("*") if path.is_file()] == []
    monkeypatch.undo()
    path = copy_model(tmp_path, *MODEL, tmp_path / "out") / "model_normalized.obj"
    time = path.stat().st_mtime_ns
    copy_model(tmp_path, *MODEL, tmp_path / "out")
    assert path.stat().st_mtime_ns == time


def test_damaged_models_are_not_copied(tmp_path: Path) -> None:
    put_v2(tmp_path, "v 0 0 0\n")
    put_v1(tmp_path, "v 1 1 1\nf 1 1 1\n", model_id="point")
    for model_id, reason in ((MODEL_ID, "no faces"), ("point", "in one point")):
        with pytest.raises(DataError, match=reason):
            copy_model(tmp_path, CATID, model_id, tmp_path / "out")
    assert not (tmp_path / "out").exists() or not [p for p in (tmp_path / "out").rglob("*") if p.is_file()]


def copy_many(root: Path, out: Path) -> None:
    for i in range(20):
        copy_model(root, CATID, f"m{i}", out)


def test_several_processes_copy_the_same_models(tmp_path: Path) -> None:
    for i in range(20):
        put_v1(tmp_path / "in", model_id=f"m{i}")
    copy_many(tmp_path / "in", tmp_path / "alone")
    context = get_context("fork")
    workers = [context.Process(target=copy_many, args=(tmp_path / "in", tmp_path / "out")) for _ in range(3)]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()
        assert worker.exitcode == 0
    tree = {p.relative_to(tmp_path / "alone"): p for p in (tmp_path / "alone").rglob("*")}
    assert {p.relative_to(tmp_path / "out") for p in (tmp_path / "out").rglob("*")} == set(tree)
    assert len(tree) == 20 * 4 + 1
    for name, path in tree.items():
        assert path.is_dir() or (tmp_path / "out" / name).read_bytes() == path.read_bytes()


@pytest.mark.parametrize("text", ["", "{", "[]", '{"numVertices": 3}', '{"numVertices": 1, "min": 1}'])
def test_damaged_facts_are_named(tmp_path: Path, text: str) -> None:
    path = put_v2(tmp_path).with_suffix(".json")
    with pytest.raises(DataError, match=r"cannot read .*model_normalized\.json \(No such file"):
        read_facts(tmp_path, *MODEL)
    path.write_text(text)
    with pytest.raises(DataError, match=r"model_normalized\.json .*(mend it|export it again)$"):
        read_facts(tmp_path, *MODEL)


def test_real_models_are_normalised(shared_dir: Path) -> None:
    root = shared_dir / "realdata/scene0470_00/shapenet"
    folders = sorted(root.glob("*/*/models"))
    assert len(folders) == 6
    assert shapenet_version(root) == "v2"
    for folder in folders:
        model = (folder.parts[-3], folder.parts[-2])
        mesh, facts = read_mesh(root, *model), read_facts(root, *model)
        assert len(mesh.vertices) == facts.num_vertices
        # Files carry six decimals.
        assert np.linalg.norm(np.ptp(mesh.vertices, axis=0)) == pytest.approx(1, abs=2e-6)
        np.testing.assert_allclose(mesh.vertices.mean(axis=0), 0.0, atol=1e-6)
        low = (facts.low - facts.centroid) / np.linalg.norm(facts.high - facts.low)
        np.testing.assert_allclose(mesh.vertices.min(axis=0), low, atol=2e-6)
        solid, translate, scale = read_binvox(folder / "model_normalized.solid.binvox")
        surface, *_ = read_binvox(folder / "model_normalized.surface.binvox")
        assert (surface <= solid).all()
        np.testing.assert_allclose(translate, mesh.vertices.min(axis=0), atol=1e-5)
        assert scale == pytest.approx(np.ptp(mesh.vertices, axis=0).max(), abs=1e-5)


def test_a_cut_real_model_is_named(shared_dir: Path, tmp_path: Path) -> None:
    """Wherever a file of ShapeNetCore v2 is cut, its own comments tell."""
    source = next(
        iter(sorted((shared_dir / "realdata/scene0470_00/shapenet/04379243").glob("*/models/*.obj")))
    )
    whole = source.read_bytes()
    for share in np.linspace(0.01, 0.99, 25):
        put_v2(tmp_path / f"{share:.2f}").write_bytes(whole[: int(share * len(whole))])
        with pytest.raises(DataError, match=r"model_normalized\.obj"):
            read_mesh(tmp_path / f"{share:.2f}", *MODEL)


@pytest.mark.parametrize(
    "text", ['{"min": [' + " " * 2**20 + "]}", "[" * 100_000, "{}", '{"min": [0]}', '{"min": [1e300, 0, 0]}']
)
def test_hostile_and_damaged_facts_are_named(tmp_path: Path, text: str) -> None:
    put_v2(tmp_path).with_suffix(".json").write_text(text)
    with pytest.raises(DataError, match=r"model_normalized\.json .*(mend it|again|check the path)$"):
        read_facts(tmp_path, *MODEL)
