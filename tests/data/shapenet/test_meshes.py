# SPDX-License-Identifier: Apache-2.0
"""The files of a CAD model: OBJ, MTL and binvox; damage and hostile sizes."""

from __future__ import annotations

import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from raytran.data.shapenet import meshes
from raytran.data.shapenet.meshes import read_binvox, read_face_colors, read_obj, replaced_obj, write_binvox
from raytran.data.shapenet.models import read_mesh
from raytran.errors import DataError
from raytran.rooms.cad import sample_model
from raytran.rooms.shapenet_files import write_model

TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"

MANY_FORMS = """# made by hand
mtllib model_normalized.mtl
v 0 0 0
v 1 0 0 0.5 0.5 0.5
  v\t1 1 0
v 0 1 \\
0
v 9 9 9
vn 0 0 1
vt 0 0
g first
usemtl a
f 1//1 2//1 3//1
l 1 2
p 1
f 1 2
f 1/1/1 3/1/1 4/1/1
g second
s off
f 1 2 3 4
f -5 -4 -3
"""


def put(folder: Path, text: str) -> Path:
    path = folder / "model.obj"
    path.write_text(text)
    return path


@pytest.mark.parametrize("newline", ["\n", "\r\n"])
def test_all_forms_of_elements(tmp_path: Path, newline: str) -> None:
    (tmp_path / "a.obj").write_bytes(MANY_FORMS.replace("\n", newline).encode())
    vertices, faces = read_obj(tmp_path / "a.obj")
    assert vertices.tolist() == [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [9, 9, 9]]
    assert faces.tolist() == [[0, 1, 2], [0, 2, 3], [0, 1, 2], [0, 2, 3], [0, 1, 2]]


def test_negative_numbers_count_from_the_newest_vertex_so_far(tmp_path: Path) -> None:
    _, faces = read_obj(put(tmp_path, TRIANGLE + "f -3 -2 -1\nv 5 5 5\nf -4 -3 -1\n"))
    assert faces.tolist() == [[0, 1, 2], [0, 1, 3]]


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (TRIANGLE, "has no faces"),
        ("v 0 0 0\nv 1 0 0\nf 1 2 3\n", "misses vertices"),
        (TRIANGLE + "f 0 1 2\n", "misses vertices"),
        (TRIANGLE + "f -4 1 2\n", "misses vertices"),
        ("v 0 0 zero\nf 1 1 1\n", "damaged"),
        ("v 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "damaged"),
        ("v 0 0 0\nf 1 x 3\n", "damaged"),
        (TRIANGLE + "f\n", "damaged"),
        (TRIANGLE + f"f 1 2 {'9' * 40}\n", "damaged"),
        (TRIANGLE + "v nan 0 0\nf 1 2 3\n", "not finite"),
        (TRIANGLE + "v 0 inf 0\nf 1 2 3\n", "not finite"),
        (TRIANGLE + "v 1e308 0 0\nv -1e308 0 0\nf 1 2 3\n", "not finite"),
        ("# 4 vertex positions\n" + TRIANGLE + "f 1 2 3\n", "ends early: 3 of 4 vertex positions"),
        (
            TRIANGLE + "# Mesh 'a with 7 faces' with 100000000 faces\nf 1 2 3\n",
            "ends early: 1 of 100,000,000",
        ),
    ],
)
def test_damaged_files_are_named(tmp_path: Path, text: str, reason: str) -> None:
    with pytest.raises(DataError, match=rf"model\.obj .*{reason}"):
        read_obj(put(tmp_path, text))


def test_binary_rubbish_and_folders_are_named(tmp_path: Path) -> None:
    path = tmp_path / "model.obj"
    path.write_bytes(np.random.default_rng(0).bytes(100_000))
    with pytest.raises(DataError, match=r"model\.obj"):
        read_obj(path)
    (tmp_path / "folder.obj").mkdir()
    with pytest.raises(DataError, match=r"cannot read the CAD model .*folder\.obj"):
        read_obj(tmp_path / "folder.obj")


def test_lines_and_points_count_as_announced_faces(tmp_path: Path) -> None:
    meshes = "# Mesh 'a' with 2 faces\nf 1 2 3\nl 1 2\n# Mesh 'b' with 1 faces\np 1\n"
    text = f"# 3 vertex positions\n{TRIANGLE}{meshes}"
    assert len(read_obj(put(tmp_path, text))[1]) == 1


@pytest.mark.parametrize("ending", ["v 0 0 0\n" * 2000, "f 1 2 3\n" * 2000, "f" + " 1" * 2000 + "\n"])
def test_models_beyond_any_use_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, ending: str
) -> None:
    monkeypatch.setattr(meshes, "MAX_VERTICES", 1000)
    with pytest.raises(DataError, match=r"model\.obj has more than 1,000 vertices or triangles: simplify it"):
        read_obj(put(tmp_path, TRIANGLE + ending))


@pytest.mark.parametrize("piece", ["1 ", "\\\n"])
def test_a_line_without_end_takes_little_memory(tmp_path: Path, piece: str) -> None:
    path = put(tmp_path, TRIANGLE + "f " + piece * (20_000_000 // len(piece)))
    tracemalloc.start()
    try:
        with pytest.raises(DataError, match="a line of more than a million bytes"):
            read_obj(path)
        assert tracemalloc.get_traced_memory()[1] < 10e6
    finally:
        tracemalloc.stop()


def test_replaced_positions_leave_the_rest(tmp_path: Path) -> None:
    path = put(tmp_path, MANY_FORMS)
    quarter = np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])
    vertices, faces = read_obj(path)
    (tmp_path / "b.obj").write_bytes(b"".join(replaced_obj(path, vertices @ quarter.T, quarter)))
    turned, same = read_obj(tmp_path / "b.obj")
    np.testing.assert_allclose(turned, vertices @ quarter.T, atol=1e-7)
    assert same.tolist() == faces.tolist()
    lines = (tmp_path / "b.obj").read_text().splitlines()
    assert "vn 1.0000 0.0000 0.0000" in lines
    kept = [line for line in MANY_FORMS.splitlines() if line and line.split()[0] not in ("v", "vn", "0")]
    assert [line for line in lines if line.split()[0] not in ("v", "vn")] == kept


COLORED = """mtllib model_normalized.mtl
v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0
f 1 2 3
usemtl red one
f 1 2 3 4
l 1 2
usemtl picture
f 1 2 \\
 3
usemtl unheard
f 1 2 4
"""


@pytest.fixture
def model(tmp_path):
    folder = tmp_path / "04379243" / "abc" / "models"
    folder.mkdir(parents=True)
    (folder / "model_normalized.obj").write_text(COLORED)
    return folder / "model_normalized.obj"


def colors_of(path, num_faces):
    group, colors = read_face_colors(path, num_faces)
    return colors[group]


def test_faces_have_the_colour_of_their_material_or_the_mean_of_its_texture(model):
    images = model.parents[1] / "images"
    images.mkdir()
    pixels = np.zeros((8, 8, 3), dtype=np.uint8)
    pixels[:4] = 255
    Image.fromarray(pixels).save(images / "half.png")
    model.with_suffix(".mtl").write_text(
        "newmtl red one\nKd 1 0 0\n\nnewmtl picture\nmap_Kd ../images/half.png\nKd 0 1 0\n"
    )
    found = colors_of(model, 5)
    np.testing.assert_allclose(found[1:4], [[1, 0, 0], [1, 0, 0], [0.5, 0.5, 0.5]], atol=0.01)
    grey = np.round(0.7 * 255) / 255
    np.testing.assert_allclose(found[[0, 4]], grey)


@pytest.mark.parametrize(
    "mtl",
    [
        None,
        "newmtl red one\nKd red\n",
        "newmtl red one\nmap_Kd ../images/missing.png\n",
        "newmtl red one\nmap_Kd ../../../../secret.png\n",
        "newmtl red one\nmap_Kd ../notes.txt\n",
        "newmtl red one\nmap_Kd ../postscript.png\n",
        "newmtl red one\nmap_Kd a\0b.png\n",
        "newmtl red one\nmap_Kd ../link.png\n",
        "newmtl red one\nmap_Kd\n",
    ],
)
def test_what_cannot_be_read_is_grey(model, mtl):
    secret = model.parents[3].parent / "secret.png"
    Image.new("RGB", (2, 2), "red").save(secret)
    (model.parents[1] / "link.png").symlink_to(secret)
    (model.parents[1] / "notes.txt").write_text("no picture")
    Image.new("RGB", (2, 2), "red").save(model.parents[1] / "postscript.png", "EPS")
    if mtl is not None:
        model.with_suffix(".mtl").write_text(mtl)
    np.testing.assert_allclose(colors_of(model, 5), np.round(0.7 * 255) / 255)


def test_textures_outside_are_told_once(model, caplog):
    paths = "newmtl a\nmap_Kd /etc/passwd\nnewmtl b\nmap_Kd ../../../../secret.png\n"
    model.with_suffix(".mtl").write_text(paths)
    colors_of(model, 5)
    (said,) = caplog.messages
    assert "model_normalized.mtl names 2 textures outside of the model's folder" in said
    assert "(/etc/passwd): move them there" in said


def test_a_material_file_of_hostile_size_is_not_read(model, caplog, monkeypatch):
    monkeypatch.setattr(meshes, "_MAX_MTL_BYTES", 2**20)
    model.with_suffix(".mtl").write_text("newmtl red one\nKd 1 0 0\n" * 50_000)
    np.testing.assert_allclose(colors_of(model, 5), np.round(0.7 * 255) / 255)
    assert "larger than 1 MB and not read" in caplog.text


def test_materials_without_faces_take_no_memory(model):
    model.write_text("usemtl a\nusemtl b\n" * 20_000 + COLORED)
    tracemalloc.start()
    try:
        found = colors_of(model, 5)
        assert tracemalloc.get_traced_memory()[1] < 1e6
    finally:
        tracemalloc.stop()
    assert len(found) == 5


def test_another_number_of_faces_than_was_read_is_grey(model):
    model.with_suffix(".mtl").write_text("newmtl red one\nKd 1 0 0\n")
    np.testing.assert_allclose(colors_of(model, 7), np.full((7, 3), np.round(0.7 * 255) / 255))


def test_a_written_model_keeps_its_colours(tmp_path):
    model = sample_model("chair", np.random.default_rng(1))
    path = write_model(model, tmp_path) / "model_normalized.obj"
    mesh = read_mesh(tmp_path, model.catid, model.model_id)
    # The file groups faces by material.
    expected = model.face_color[np.argsort(model.face_group, kind="stable")]
    np.testing.assert_allclose(colors_of(path, len(mesh.faces)), expected, atol=1 / 400)


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
    write_binvox(tmp_path / "a.binvox", cells, (0.1, -0.2, 1 / 3), np.float64(0.7))
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


@pytest.mark.parametrize("size", ["2 2 3", "3 3 3", "100000 100000 100000", "0 0 0", "-1 -1 -1", "2 2"])
def test_sizes_that_the_runs_do_not_fill_make_no_cells(tmp_path: Path, size: str) -> None:
    path = tmp_path / "a.binvox"
    header = f"#binvox 1\ndim {size}\ntranslate 0 0 0\nscale 1\ndata\n"
    path.write_bytes(header.encode() + bytes([1, 255]) * 2)
    with pytest.raises(DataError, match=r"a\.binvox is damaged \(its runs do not fill"):
        read_binvox(path)


def test_files_of_hostile_size_are_not_read(tmp_path: Path) -> None:
    path = tmp_path / "a.binvox"
    with path.open("wb") as file:  # a sparse file: it takes no room
        file.truncate(65 * 2**20)
    with pytest.raises(DataError, match=r"a\.binvox is damaged \(it is larger than 64 MB\)"):
        read_binvox(path)
