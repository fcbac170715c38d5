# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import csv
import io
import json
from collections import Counter

import numpy as np
import pytest
from PIL import Image

from raytran.classes import PAPER_CLASSES, SCAN2CAD_CLASS_BY_CATID
from raytran.data.shapenet.models import model_folder, read_mesh
from raytran.errors import DataError
from raytran.rooms.kinds import KINDS
from raytran.rooms.sweethome3d import import_furniture
from raytran.rooms.sweethome3d.furniture import HELD_OUT, read_table

from ...factories import digests

QUIET = {"processes": 1, "progress": False}


def facts_of(root, credit):
    return json.loads((model_folder(root, *credit.model.split("/")) / "model_normalized.json").read_text())


@pytest.fixture(scope="module")
def imported(library, tmp_path_factory):
    root = tmp_path_factory.mktemp("imported")
    return root, import_furniture(library, root, **QUIET)


def test_only_listed_furniture_is_written(imported):
    root, report = imported
    assert (report.made, report.left_out) == (1, {})
    assert [credit.piece for credit in report.credits] == ["Scopia#chair"]
    assert len(list(root.glob("*/*/models/model_normalized.obj"))) == 1


def test_models_are_normalised_as_shapenet_does(imported):
    root, report = imported
    mesh = read_mesh(root, *report.credits[0].model.split("/"))
    np.testing.assert_allclose(mesh.vertices.mean(axis=0), 0, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(np.ptp(mesh.vertices, axis=0)), 1, atol=1e-6)


def test_real_size_is_the_catalogues(imported):
    root, report = imported
    facts = facts_of(root, report.credits[0])
    assert facts["unit"] == "m"
    np.testing.assert_allclose(np.subtract(facts["max"], facts["min"]), [0.5, 0.9, 0.6], atol=1e-6)


def test_front_is_turned_to_shapenets_and_nothing_is_mirrored(imported):
    """In the file the chair faces +Z and its post stands at its right front corner, at +X and +Z."""
    root, report = imported
    mesh = read_mesh(root, *report.credits[0].model.split("/"))
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    place = (mesh.vertices - low) / (high - low)
    top = place[place[:, 1] > 0.99]
    assert top[:, 2].min() > 0.7, "the back of the chair must lie at +Z, its front at -Z"
    post = place[(abs(place[:, 1] - 0.75) < 0.01)]
    assert (post[:, 0] < 0.2).all()
    assert (post[:, 2] < 0.2).all()


def test_each_material_has_the_mean_colour_that_its_faces_show(imported):
    root, report = imported
    text = (model_folder(root, *report.credits[0].model.split("/")) / "model_normalized.mtl").read_text()
    colors = [tuple(map(float, line.split()[1:])) for line in text.splitlines() if line.startswith("Kd")]
    assert sorted(colors) == [(0, 0, 1), (1, 0, 0)]


def test_catalogue_turns_are_applied(tmp_path, write_library, entry):
    turned = entry(1, "Scopia#chair", modelRotation="0 0 1 0 1 0 -1 0 0", width="60", depth="50")
    root = tmp_path / "out"
    report = import_furniture(write_library(tmp_path / "a.sh3f", turned), root, **QUIET)
    mesh = read_mesh(root, *report.credits[0].model.split("/"))
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    place = (mesh.vertices - low) / (high - low)
    # (x, y, z) → (z, y, -x): the back goes from -Z to -X, and then with half a turn to +X.
    assert place[place[:, 1] > 0.99][:, 0].min() > 0.7
    facts = facts_of(root, report.credits[0])
    np.testing.assert_allclose(np.subtract(facts["max"], facts["min"]), [0.6, 0.9, 0.5], atol=1e-6)


def test_measured_facts_and_split_are_in_the_json(imported, tmp_path, write_library, entry):
    root, report = imported
    facts = facts_of(root, report.credits[0])
    assert (facts["kind"], facts["symmetry"], facts["split"]) == ("dining chair", 1, "train")
    assert facts["source"]["creator"] == "Ann Author"
    path = write_library(
        tmp_path / "b.sh3f", entry(1, "Kator Legaz#dining-chair"), head=f"name={HELD_OUT[1]}\n"
    )
    held_out = import_furniture(path, tmp_path / "out", **QUIET)
    assert facts_of(tmp_path / "out", held_out.credits[0])["split"] == "val"


def test_a_held_out_maker_is_held_out_everywhere(tmp_path, write_library, entry):
    write_library(tmp_path / "a.sh3f", entry(1, "Scopia#chair"))
    write_library(tmp_path / "b.sh3f", entry(1, "Kator Legaz#dining-chair"), head=f"name={HELD_OUT[1]}\n")
    report = import_furniture(tmp_path, tmp_path / "out", **QUIET)
    assert [facts_of(tmp_path / "out", credit)["split"] for credit in report.credits] == ["val", "val"]


def test_credits_name_everybody(imported):
    root, report = imported
    with (root / "credits.csv").open(newline="") as file:
        (row,) = csv.DictReader(file)
    assert row["model"] == report.credits[0].model
    assert (row["name"], row["creator"]) == ("Chair, with post", "Ann Author")
    assert row["licence"] == "Creative Commons © Test"
    assert "Models are by Ann Author.\n" in (root / "LICENCES.txt").read_text()


def test_again_changes_nothing_and_a_broken_off_import_is_finished(imported, library, tmp_path):
    root, report = imported
    before = digests(root)
    assert import_furniture(library, root, **QUIET).made == 0
    assert digests(root) == before
    (tmp_path / ".unfinished-x" / "models").mkdir(parents=True)
    assert import_furniture(library, tmp_path, **QUIET).made == 1
    assert digests(tmp_path) == before
    assert report.root == root


BROKEN = {
    "a name outside": ({"model": "/../../../etc/passwd"}, "has no"),
    "no file": ({"model": "/scopia/none.obj"}, "has no"),
    "no model": ({"model": None}, "damaged"),
    "not a number": ({"width": "nan"}, "damaged"),
    "as large as a town": ({"height": "1e9"}, "damaged"),
    "no rotation": ({"modelRotation": "1 0 0 0 2 0 0 0 1"}, "damaged"),
    "no mesh": ({"model": "/LICENSE.TXT"}, "triangles"),
}


@pytest.mark.parametrize(("fields", "why"), BROKEN.values(), ids=BROKEN)
def test_a_broken_piece_is_left_out_and_named(fields, why, tmp_path, write_library, entry):
    good = entry(1, "Scopia#chair")
    path = write_library(tmp_path / "a.sh3f", good, entry(2, "Scopia#chair3", **fields))
    report = import_furniture(path, tmp_path / "out", **QUIET)
    assert [credit.piece for credit in report.credits] == ["Scopia#chair"]
    assert list(report.left_out) == ["Scopia#chair3"]
    assert why in report.left_out["Scopia#chair3"]
    assert sorted(item.name for item in tmp_path.iterdir()) == ["a.sh3f", "out"]


ODD_MESHES = {
    "flat": ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "flat"),
    "not finite": ("v 0 0 0\nv 1 0 nan\nv 0 1 1\nf 1 2 3\n", "triangles"),
    "vertices of two numbers": ("v 0 0\nv 1 0\nv 0 1\nv 1 1\nf 1 2 3\nf 1 2 4\n", ""),
    "a corner that is not there": ("v 0 0 0\nv 1 0 0\nv 0 1 1\nf 1 2 9\n", "damaged"),
}


@pytest.mark.parametrize(("obj", "why"), ODD_MESHES.values(), ids=ODD_MESHES)
def test_a_mesh_that_is_none_is_left_out(obj, why, tmp_path, write_library, entry):
    files = {"scopia/odd.obj": obj}
    path = write_library(tmp_path / "a.sh3f", entry(1, "Scopia#chair", model="/scopia/odd.obj"), **files)
    report = import_furniture(path, tmp_path / "out", **QUIET)
    assert why in report.left_out["Scopia#chair"]


def test_a_mesh_of_too_many_triangles_is_left_out(library, tmp_path, monkeypatch):
    monkeypatch.setattr("raytran.rooms.sweethome3d.mesh.MOST_FACES", 35)
    assert "36 triangles" in import_furniture(library, tmp_path, **QUIET).left_out["Scopia#chair"]


def test_a_mesh_that_is_packed_as_none_is_is_not_unpacked(tmp_path, write_library, entry):
    path = write_library(
        tmp_path / "a.sh3f",
        entry(1, "Scopia#chair", model="/scopia/odd.obj"),
        **{"scopia/odd.obj": "\n" * 40_000_000},
    )
    report = import_furniture(path, tmp_path / "out", **QUIET)
    assert "is packed as no model is" in report.left_out["Scopia#chair"]


def test_a_mesh_of_hostile_size_is_not_parsed(tmp_path, write_library, entry, monkeypatch):
    monkeypatch.setattr("raytran.rooms.sweethome3d.mesh.trimesh.load_scene", None)
    corners = "v 0 0 0\nv 1 0 0\nv 0 1 1\n" + "f 1 2 3\n" * 300_000
    for number, obj in enumerate((corners, corners[:24] + "f" + " 1 2 3" * 300_000)):
        path = write_library(
            tmp_path / f"{number}.sh3f",
            entry(1, "Scopia#chair", model="/scopia/odd.obj"),
            **{"scopia/odd.obj": obj},
        )
        report = import_furniture(path, tmp_path / f"out{number}", **QUIET)
        assert "has faces of 900,000 corners" in report.left_out["Scopia#chair"]


@pytest.mark.parametrize("mtllib", ["none.mtl", "../../../../etc/passwd", "LICENSE.TXT"])
def test_materials_that_are_not_there_are_grey(mtllib, tmp_path, write_library, entry):
    files = {
        "scopia/odd.obj": f"mtllib {mtllib}\nv 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nusemtl x\nf 1 2 3\nf 1 2 4\n"
    }
    path = write_library(tmp_path / "a.sh3f", entry(1, "Scopia#chair", model="/scopia/odd.obj"), **files)
    report = import_furniture(path, tmp_path / "out", **QUIET)
    folder = model_folder(tmp_path / "out", *report.credits[0].model.split("/"))
    (line,) = [line for line in (folder / "model_normalized.mtl").read_text().splitlines() if "Kd" in line]
    red, green, blue = map(float, line.split()[1:])
    assert red == green == blue


def test_a_piece_of_hostile_size_is_not_read(tmp_path, write_library, entry, monkeypatch):
    monkeypatch.setattr("raytran.rooms.sweethome3d.catalogue.LARGEST_ENTRY", 2**20)
    huge = {"scopia/huge.obj": "v 0 0 0\n" * 200_000}
    path = write_library(tmp_path / "a.sh3f", entry(1, "Scopia#chair", model="/scopia/huge.obj"), **huge)
    report = import_furniture(path, tmp_path / "out", **QUIET)
    assert report.made == 0
    assert "claims" in report.left_out["Scopia#chair"]


def test_what_is_no_library_is_refused(tmp_path, write_library, entry):
    with pytest.raises(DataError, match=r"no furniture library \(\*\.sh3f\)"):
        import_furniture(tmp_path, tmp_path / "out", **QUIET)
    (tmp_path / "text.sh3f").write_text("no zip")
    with pytest.raises(DataError, match=r"text\.sh3f is no furniture library"):
        import_furniture(tmp_path / "text.sh3f", tmp_path / "out", **QUIET)
    strange = write_library(tmp_path / "strange.sh3f", entry(1, "Unknown#chair"))
    with pytest.raises(DataError, match="holds listed furniture"):
        import_furniture(strange, tmp_path / "out", **QUIET)


def test_table_agrees_with_the_kinds():
    table = read_table()
    assert len(table) >= 230
    assert {row.category for row in table.values()} == set(PAPER_CLASSES.names)
    for row in table.values():
        kind = KINDS[row.kind]
        assert kind.category == row.category, row.piece
        assert SCAN2CAD_CLASS_BY_CATID.get(kind.catid, "other") == row.category
        assert row.turn_deg in (0, 90, 180, 270)


def test_wrong_hits_of_a_search_by_name_are_not_in_the_table():
    names = {piece.split("#")[1] for piece in read_table()}
    wrong = {
        "tableFan",
        "toiletsUnit",
        "table_tennis",
        "tablet",
        "tv-remote-control",
        "wheelchair",
        "screen-door",
    }
    assert not names & wrong


def test_both_splits_hold_every_class():
    rows = Counter(
        (row.piece.startswith(("Blend Swap CC-BY#", "Kator Legaz#")), row.category)
        for row in read_table().values()
    )
    assert {(held_out, name) for held_out in (False, True) for name in PAPER_CLASSES.names} <= set(rows)


@pytest.mark.filterwarnings("ignore:Duplicate name")
def test_a_texture_of_another_kind_reaches_no_decoder(tmp_path, write_library, entry, monkeypatch):
    picture = io.BytesIO()
    Image.new("RGB", (2, 2), "red").save(picture, "EPS")
    monkeypatch.setattr("PIL.EpsImagePlugin.Ghostscript", lambda *_, **__: pytest.fail("it was started"))
    path = tmp_path / "Scopia.sh3f"
    write_library(path, entry(1, "Scopia#chair"), **{"scopia/chair/cloth.png": picture.getvalue()})
    report = import_furniture(path, tmp_path / "out", **QUIET)
    text = (
        model_folder(tmp_path / "out", *report.credits[0].model.split("/")) / "model_normalized.mtl"
    ).read_text()
    colors = [tuple(map(float, line.split()[1:])) for line in text.splitlines() if line.startswith("Kd")]
    assert sorted(colors) == [(1, 0, 0), (1, 1, 1)]
