# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
from PIL import Image

from raytran.data.shapenet import colors as shapenet_colors
from raytran.data.shapenet.colors import read_face_colors
from raytran.data.shapenet.models import read_mesh
from raytran.rooms.cad import sample_model
from raytran.rooms.shapenet_files import write_model

OBJ = """mtllib model_normalized.mtl
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
    (folder / "model_normalized.obj").write_text(OBJ)
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
    monkeypatch.setattr(shapenet_colors, "_LARGEST_MTL", 2**20)
    model.with_suffix(".mtl").write_text("newmtl red one\nKd 1 0 0\n" * 50_000)
    np.testing.assert_allclose(colors_of(model, 5), np.round(0.7 * 255) / 255)
    assert "larger than 1 MB and not read" in caplog.text


def test_materials_without_faces_take_no_memory(model):
    model.write_text("usemtl a\nusemtl b\n" * 20_000 + OBJ)
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
