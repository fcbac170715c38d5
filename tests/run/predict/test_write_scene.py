# SPDX-License-Identifier: Apache-2.0
"""The folder of a prediction: which files there are, and that the next program reads them."""

from __future__ import annotations

import json
import resource
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from matplotlib.figure import Figure
from matplotlib.text import Text
from PIL import ImageDraw

from raytran.classes import PAPER_CLASSES, Classes
from raytran.data.files import disk_full
from raytran.data.shapenet.voxelize import voxelize_solid
from raytran.errors import ConfigError, DataError, ShapeError
from raytran.export.read import read_alignments_csv, read_predictions
from raytran.geometry.rotation import rotation_from_yaw
from raytran.rooms.cad import CadModel, sample_model
from raytran.rooms.shapenet_files import write_model
from raytran.run.predict.write_scene import PredictedScene, write_scene
from raytran.structs import ObjectSet, ScenePrediction, Views
from raytran.viewer import has_viser
from raytran.viewer.data import read_viewer_scene

from ...factories import digests

FILES = {"scene.json", "scene.glb", "meshes", "occupancy.ply", "topdown.png", "overlays"}


@pytest.fixture(scope="module")
def chair() -> CadModel:
    return sample_model("chair", np.random.default_rng(3))


@pytest.fixture
def found(chair) -> PredictedScene:
    """A chair, and a table whose shape is empty."""
    shape = torch.from_numpy(voxelize_solid(chair.vertices, chair.faces, size=15)).float()
    objects = ObjectSet(
        label=torch.tensor([PAPER_CLASSES.index("chair"), PAPER_CLASSES.index("table")]),
        center=torch.tensor([[0.0, 2.0, 0.5], [1.0, 2.5, 0.4]]),
        size=torch.tensor([chair.size_m.tolist(), [1.0, 0.8, 0.6]]).float(),
        rotation=rotation_from_yaw(torch.tensor([0.5, 0.0])),
        symmetry=torch.ones(2, dtype=torch.int64),
        score=torch.tensor([0.9, 0.6]),
        shape=torch.stack([shape, torch.zeros_like(shape)]),
    )
    prediction = ScenePrediction(
        "room", objects, torch.zeros(3), occupancy=torch.full((4, 4, 2), 0.7), grid_extent=(4.0, 4.0, 2.0)
    )
    return PredictedScene.of(prediction)


@pytest.fixture
def views() -> Views:
    pose = torch.eye(4)[None, None].repeat(1, 2, 1, 1)
    pose[..., :3, :3] = torch.tensor([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    pose[0, :, 0, 3] = torch.tensor([0.0, 0.2])
    intrinsics = torch.tensor([[50.0, 0, 32], [0, 50, 24], [0, 0, 1]]).expand(1, 2, 3, 3)
    return Views(torch.full((1, 2, 3, 48, 64), 200, dtype=torch.uint8), intrinsics, pose)


def write(output: Path, found: PredictedScene, views: Views, turntable: int = 0) -> set[str]:
    write_scene(
        output,
        found,
        views,
        ["0", "5"],
        num_overlays=0,
        turntable=turntable,
    )
    return {path.name for path in output.iterdir()}


def test_on_a_full_disk_the_folder_is_whole_or_as_it_was(tmp_path, found, views):
    """Every file is cut short once, by a limit on its size, which is a full disk of its own kind."""
    write(tmp_path / "room", found, views, turntable=1)
    sizes = {path.stat().st_size for path in (tmp_path / "room").rglob("*") if path.is_file()}
    _, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    before = digests(tmp_path)
    for size in sorted(sizes):
        resource.setrlimit(resource.RLIMIT_FSIZE, (size - 1, hard))
        try:
            with pytest.raises(OSError, match=r"File too large|encoder error") as raised:
                write(tmp_path / "room", found, views, turntable=1)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (hard, hard))
        assert disk_full(raised.value) is not None, raised.value
        assert digests(tmp_path) == before


def test_the_turntable_is_there_if_wanted(tmp_path, found, views):
    assert write(tmp_path / "still", found, views) == FILES
    assert write(tmp_path / "turning", found, views, turntable=1) == FILES | {"turntable.gif"}


def test_every_file_has_the_names_and_colours_of_own_classes(tmp_path, found, views, monkeypatch):
    classes = Classes(("drill press", "Säge", "bench"), colors=((10, 200, 30), (1, 2, 3), (4, 5, 6)))
    label = torch.tensor([0, 2])
    truth = replace(found.prediction.objects, label=label, classes=classes, shape=None)
    prediction = replace(
        found.prediction, objects=replace(found.prediction.objects, label=label, classes=classes)
    )
    written = []
    draw = ImageDraw.ImageDraw.text
    monkeypatch.setattr(ImageDraw.ImageDraw, "text", lambda *a, **k: (written.append(a[2]), draw(*a, **k))[1])
    save = Figure.savefig
    monkeypatch.setattr(
        Figure,
        "savefig",
        lambda figure, *a, **k: (
            written.extend(text.get_text() for text in figure.findobj(Text)),
            save(figure, *a, **k),
        ),
    )
    output = tmp_path / "room"
    write_scene(
        output,
        PredictedScene(prediction, found.meshes, volumes=[]),
        views,
        ["0", "5"],
        num_overlays=1,
        turntable=1,
        obj=True,
        truth=truth,
    )
    # Over a frame, in the plan, and in its legend.
    assert {"drill press 0.90", "00 drill press 0.90", "01 bench 0.60", "bench"} <= set(written)
    content = json.loads((output / "scene.json").read_text())
    assert [entry["category"] for entry in content["objects"]] == ["drill press", "bench"]
    assert content["classes"] == classes.settings()
    drawn = trimesh.load(output / "scene.glb")
    assert set(drawn.graph.nodes_geometry) == {"00_drill press", "00_drill press_box", "01_bench_box"}
    assert drawn.geometry["00_drill press"].visual.material.name == "drill press"
    mesh = trimesh.load_mesh(output / "meshes/00.ply", process=False)
    assert mesh.visual.vertex_colors[0].tolist() == [10, 200, 30, 255]
    assert "newmtl drill press" in (output / "meshes/00.mtl").read_text()
    shown = read_viewer_scene(output)
    assert shown.objects.category == shown.truth.category == ("drill press", "bench")
    assert shown.objects.classes == shown.truth.classes == classes
    # Read for classes that it does not have, it says which object is of none of them.
    with pytest.raises(DataError, match="category 'drill press': choose one of bathtub"):
        read_predictions(output, ["room"], {})
    read = read_predictions(output, ["room"], {}, classes)
    assert read.scenes["room"].objects.category == ("drill press", "bench")


def test_cad_models_are_named_placed_and_drawn(tmp_path, found, views, chair, caplog):
    write_model(chair, tmp_path / "cads")
    output = tmp_path / "room"
    assert write(output, found.with_cads(tmp_path / "cads"), views) == FILES | {"scan2cad.csv", "cads.glb"}
    first, second = json.loads((output / "scene.json").read_text())["objects"]
    assert (first["catid_cad"], first["id_cad"]) == (chair.catid, chair.model_id)
    assert "id_cad" not in second
    alignments = read_alignments_csv(output / "scan2cad.csv")
    assert alignments.model_id == (f"{chair.catid}/{chair.model_id}",)
    # The chair is as large as it was made, so that one scale does for all axes: the diagonal of its box.
    diagonal = float(np.linalg.norm(chair.size_m))
    torch.testing.assert_close(alignments.scale, torch.full((1, 3), diagonal).double(), rtol=1e-5, atol=0)
    drawn = trimesh.load(output / "cads.glb")
    assert {"00_chair", "00_chair_box", "01_table_box"} == set(drawn.graph.nodes_geometry)
    # `evaluate predictions=` reads the folder as one scene, once.
    read = read_predictions(output, ["room"], {})
    assert (list(read.scenes), read.ignored) == (["room"], ())


def test_a_prediction_saves_itself_as_the_command_does(tmp_path, found, views):
    prediction = found.prediction
    assert prediction.save(tmp_path / "bare") == tmp_path / "bare"
    names = {path.name for path in (tmp_path / "bare").iterdir()}
    assert names == FILES - {"overlays"} | {"turntable.gif"}
    seen = replace(prediction, scene_id="").save(
        str(tmp_path / "seen"), views, frame_ids=["a", "b"], obj=True
    )
    names = {path.name for path in seen.iterdir()}
    html = {"prediction.html"} if has_viser() else set()
    assert names == FILES | {"turntable.gif", "viewer.npz"} | html
    assert {path.name for path in (seen / "overlays").iterdir()} == {"a.jpg", "b.jpg"}
    assert (seen / "meshes/00.obj").is_file()
    shown = read_viewer_scene(seen)
    assert (shown.scene_id, shown.frame_ids) == ("seen", ["a", "b"])
    assert shown.occupancy.shape == (4, 4, 2)
    with pytest.raises(ShapeError, match="got 1 for 2 views"):
        prediction.save(tmp_path / "none", views, frame_ids=["a"])
    assert not (tmp_path / "none").exists()
    whole = trimesh.load_mesh(prediction.save(tmp_path / "whole", mesh_error=0) / "meshes/00.ply")
    assert len(whole.faces) > 2 * len(trimesh.load_mesh(tmp_path / "bare/meshes/00.ply").faces)


def test_a_prediction_shows_itself(found, views, monkeypatch):
    shown = []
    monkeypatch.setattr(
        "raytran.viewer.show", lambda folder, height: shown.append((read_viewer_scene(folder), height))
    )
    monkeypatch.setattr("raytran.run.predict.write_scene.has_viser", lambda: True)
    found.prediction.show()
    found.prediction.show(views, height=200)
    (bare, _), (seen, height) = shown
    assert [mesh is not None for mesh in bare.meshes] == [True, False]
    assert (len(bare.images), len(seen.images), height) == (0, 2, 200)
    monkeypatch.setattr("raytran.run.predict.write_scene.has_viser", lambda: False)
    with pytest.raises(ConfigError, match=r"raytran\[viewer\]"):
        found.prediction.show()
