# SPDX-License-Identifier: Apache-2.0
"""OBJ files: every form of face, what is left out, damage and hostile sizes."""

from __future__ import annotations

import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from raytran.data.shapenet import obj as shapenet_obj
from raytran.data.shapenet.obj import read_obj, replaced_obj
from raytran.errors import DataError

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
    monkeypatch.setattr(shapenet_obj, "_MAX_COUNT", 1000)
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
