# SPDX-License-Identifier: Apache-2.0
"""The recording is read back by Rerun's own reader; CI's job ``rerun`` has it, ``make install`` does not."""

from __future__ import annotations

import importlib.util

import numpy as np
import pytest
import torch
import trimesh

from raytran.classes import PAPER_CLASSES
from raytran.errors import ConfigError
from raytran.export.rerun_file import check_rerun, write_rerun
from raytran.geometry.rotation import rotation_from_yaw
from raytran.run.entry import compose
from raytran.run.predict.predict import predict
from raytran.run.predict.write_scene import PredictedScene, write_scene
from raytran.structs import ObjectSet, ScenePrediction, Views


@pytest.fixture
def prediction():
    objects = ObjectSet(
        label=torch.tensor([PAPER_CLASSES.index("chair"), PAPER_CLASSES.index("table")]),
        center=torch.tensor([[0.0, 2.0, 0.5], [1.0, 2.5, 0.4]]),
        size=torch.tensor([[0.5, 0.9, 0.6], [1.0, 0.8, 0.6]]),
        rotation=rotation_from_yaw(torch.tensor([0.5, 0.0])),
        symmetry=torch.ones(2, dtype=torch.int64),
        score=torch.tensor([0.9, 0.6]),
    )
    return ScenePrediction("room", objects, torch.zeros(3))


@pytest.fixture
def views():
    pose = torch.eye(4)[None, None].repeat(1, 2, 1, 1)
    pose[0, 1, 0, 3] = 0.25
    intrinsics = torch.tensor([[50.0, 0, 30], [0, 60, 24], [0, 0, 1]]).expand(1, 2, 3, 3)
    return Views(torch.full((1, 2, 3, 48, 64), 200, dtype=torch.uint8), intrinsics, pose)


def columns(path):
    """Return what a recording holds: (entity, component) → its values in the order of time."""
    reader = pytest.importorskip("rerun.chunk").RrdReader(path)
    found = {}
    for chunk in reader.stream():
        batch = chunk.to_record_batch()
        for field, values in zip(batch.schema, batch.columns, strict=True):
            if (component := (field.metadata or {}).get(b"rerun:component")) is not None:
                found.setdefault((chunk.entity_path, component.decode()), []).extend(values.to_pylist())
    return found


def test_boxes_meshes_and_cameras_come_back_in_the_world(tmp_path, prediction, views):
    pytest.importorskip("rerun")
    mesh = trimesh.creation.box((0.5, 0.6, 0.9)).apply_translation((0.0, 2.0, 0.5))
    found = columns(write_rerun(tmp_path / "scene.rrd", prediction, [mesh, None], views, ["0", "5"]))

    ((axes,),) = found["/world", "ViewCoordinates:xyz"]
    assert axes == [3, 5, 1]  # right, forward, up
    chair = "/world/objects/00_chair"
    ((center,),) = found[f"{chair}/box", "Boxes3D:centers"]
    ((half,),) = found[f"{chair}/box", "Boxes3D:half_sizes"]
    ((x, y, z, w),) = found[f"{chair}/box", "Boxes3D:quaternions"][0]
    assert center == pytest.approx([0.0, 2.0, 0.5])
    assert half == pytest.approx([0.25, 0.45, 0.3])
    turn = trimesh.transformations.quaternion_matrix([w, x, y, z])[:3, :3]
    np.testing.assert_allclose(turn, prediction.objects.rotation[0].numpy(), atol=1e-6)
    (vertices,) = found[f"{chair}/mesh", "Mesh3D:vertex_positions"]
    np.testing.assert_allclose(np.asarray(vertices), mesh.vertices, atol=1e-6)
    assert ("/world/objects/01_table/mesh", "Mesh3D:vertex_positions") not in found

    places = [place for (place,) in found["/world/camera", "Transform3D:translation"]]
    assert places == [[0.0, 0.0, 0.0], [0.25, 0.0, 0.0]]
    ((lens,), _) = found["/world/camera/image", "Pinhole:image_from_camera"]
    assert lens == [50, 0, 0, 0, 60, 0, 30, 24, 1]  # column by column
    assert len(found["/world/camera/image", "EncodedImage:blob"]) == 2


def test_without_views_there_are_no_cameras(tmp_path, prediction):
    pytest.importorskip("rerun")
    found = columns(write_rerun(tmp_path / "scene.rrd", prediction, [None, None]))
    assert not [name for name, _ in found if name.startswith("/world/camera")]


def test_without_the_extra_a_sentence_names_it(tmp_path, prediction, monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ConfigError, match=r"pip install 'raytran\[rerun\]'"):
        check_rerun()
    with pytest.raises(ConfigError, match=r"pip install 'raytran\[rerun\]'"):
        write_rerun(tmp_path / "scene.rrd", prediction, [None, None])
    assert not (tmp_path / "scene.rrd").exists()
    settings = ["scene=walk", f"output={tmp_path / 'prediction'}", "rerun=true"]
    with pytest.raises(ConfigError, match="rerun-sdk"):  # before the scene is looked for
        predict(compose("predict", settings))


def test_the_switch_writes_it_into_the_result(tmp_path, prediction, views):
    pytest.importorskip("rerun")
    write_scene(tmp_path / "room", PredictedScene.of(prediction), views, ["0", "5"], turntable=0, rerun=True)
    assert ("/world/objects/00_chair/box", "Boxes3D:centers") in columns(tmp_path / "room" / "scene.rrd")
