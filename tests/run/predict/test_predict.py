# SPDX-License-Identifier: Apache-2.0
"""From a folder of posed frames to files, with a network that always finds the same things."""

from __future__ import annotations

import json
import re
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import trimesh
from omegaconf import DictConfig, OmegaConf
from PIL import Image
from torch import nn

from raytran.checkpoints.load import PredictionSettings
from raytran.classes import PAPER_CLASSES
from raytran.errors import CheckpointError, ConfigError, DataError
from raytran.run.entry import compose
from raytran.run.output import one_writer
from raytran.run.predict import predict as module
from raytran.run.predict import write_scene
from raytran.structs import ObjectSet, ScenePrediction, Views
from raytran.viewer import has_viser
from raytran.viewer.data import read_viewer_scene

from ...factories import digests
from ...scan_forms import encode_sens, write_form

IMAGE_SIZE = (48, 64)
UPRIGHT = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


class Oracle(nn.Module):
    """Finds two chairs in the same place, and a weak table; the first chair's shape is a full box."""

    grid_extent = (8.0, 8.0, 4.0)
    grid_resolution = (4, 4, 2)
    classes = PAPER_CLASSES
    score_threshold = 0.5

    def __init__(self) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.zeros(1))
        self.backbone = SimpleNamespace(encoder=SimpleNamespace(input_channels=3))
        self.seen: Views | None = None

    def predict(
        self,
        views: Views,
        *,
        scene_id: str,
        score_threshold: float,
        views_at_once: int | None,
        with_shapes: bool,
        grid_center: torch.Tensor | None,
    ) -> ScenePrediction:
        self.seen, self.views_at_once, self.grid_center = views, views_at_once, grid_center
        center = torch.tensor([[0.5, 3.0, 0.5], [0.55, 3.0, 0.5], [-1.0, 3.0, 0.4]])
        objects = ObjectSet(
            label=torch.tensor([3, 3, 6]),
            center=center,
            size=torch.tensor([[0.5, 1.0, 0.6]] * 3),
            rotation=UPRIGHT.expand(3, 3, 3),
            symmetry=torch.ones(3, dtype=torch.int64),
            score=torch.tensor([0.9, 0.8, 0.3]),
            shape=torch.stack([torch.ones(9, 9, 9), torch.ones(9, 9, 9), torch.zeros(9, 9, 9)])
            if with_shapes
            else None,
        )
        chosen = objects.select(objects.score >= score_threshold)
        counts = torch.full((4, 4, 2), views.images.shape[1], dtype=torch.int32)
        occupancy = torch.rand(4, 4, 2)
        return ScenePrediction(
            scene_id, chosen, torch.zeros(3), occupancy=occupancy, seen=counts, grid_extent=self.grid_extent
        )


@pytest.fixture
def scene(tmp_path):
    """Five frames of 60 × 80 along a straight walk, looking along +y; the third has no valid pose."""
    folder = tmp_path / "living_room"
    for name in ("color", "pose", "intrinsic"):
        (folder / name).mkdir(parents=True)
    for n in range(5):
        Image.new("RGB", (80, 60), (40 * n, 90, 90)).save(folder / "color" / f"{5 * n}.jpg")
        pose = np.eye(4)
        pose[:3, :3] = [[1, 0, 0], [0, 0, 1], [0, -1, 0]]
        pose[:3, 3] = [0.1 * n, 0, 1.4]
        np.savetxt(folder / "pose" / f"{5 * n}.txt", np.full((4, 4), -np.inf) if n == 2 else pose)
    intrinsic = np.eye(4)
    intrinsic[:2, :3] = [[70, 0, 40], [0, 70, 30]]
    np.savetxt(folder / "intrinsic" / "intrinsic_color.txt", intrinsic)
    return folder


@pytest.fixture
def oracle(monkeypatch) -> Oracle:
    model = Oracle()
    settings = PredictionSettings(preset="tiny", stage="stage3", image_size=IMAGE_SIZE, num_views=96)
    monkeypatch.setattr(module, "prediction_settings", lambda path: settings)
    monkeypatch.setattr(module, "load_model", lambda path, attention, trust: model)
    return model


@cache
def settings_of_the_command() -> DictConfig:
    return compose("predict", ["scene=unset", "output=unset"])


def config(folder, output, **changes) -> DictConfig:
    """The command's own settings, those that cost time made small, with ``changes``."""
    paths = {"checkpoint": "a.ckpt", "scene": str(folder), "output": str(output)}
    small = {"num_overlays": 2, "turntable": 2, "views_at_once": 4, "device": "cpu", "duplicate_iou": 0.5}
    return OmegaConf.merge(settings_of_the_command(), paths | small | changes)


def test_the_log_names_weights_device_steps_and_seconds(scene, oracle, tmp_path, caplog):
    caplog.set_level("INFO")
    module.predict(config(scene, tmp_path / "out"))
    threads = torch.get_num_threads()
    on = f"the CPU ({threads} thread{'s' if threads > 1 else ''})"
    assert caplog.messages[0] == f"a.ckpt (preset tiny, stage3) on {on}"
    said = [message for message in caplog.messages if message.endswith(" …")]
    assert said == [f"reading {scene} …", "predicting from 4 frames …", "writing meshes and pictures …"]
    (found,) = [message for message in caplog.messages if message.startswith("living_room: 1 objects")]
    assert re.search(rf"1 of them with a mesh, in \d+ s on {re.escape(on)}$", found)
    assert "generated rooms" not in caplog.text


def test_the_shipped_weights_say_what_they_do_not_know(scene, oracle, tmp_path, caplog):
    caplog.set_level("INFO")
    module.predict(config(scene, tmp_path / "out", checkpoint="default"))
    assert caplog.messages[0].startswith("raytran's own weights, rooms-laptop.safetensors (preset tiny")
    assert [record.message for record in caplog.records if record.levelname == "WARNING"].count(
        module.ONLY_ROOMS
    ) == 1


def test_results_have_a_place_of_their_own(scene, oracle, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    written = module.predict(OmegaConf.merge(config(scene, "x"), {"output": None}))
    assert written == Path("outputs/predictions/living_room")
    assert (tmp_path / written / "scene.json").is_file()


def test_a_scene_that_is_refused_leaves_no_folder(oracle, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "0.jpg").touch()
    for path in ("photos", "nowhere"):
        with pytest.raises(DataError):
            module.predict(OmegaConf.merge(config(path, "x"), {"output": None}))
    assert [path.name for path in tmp_path.iterdir()] == ["photos"]


def test_all_files_are_written(scene, oracle, tmp_path):
    output = module.predict(config(scene, tmp_path / "out" / "room"))
    content = json.loads((output / "scene.json").read_text())
    assert content["scene_id"] == "living_room"
    assert [(o["category"], o["mesh"]) for o in content["objects"]] == [("chair", "meshes/00.ply")]
    mesh = trimesh.load(output / "meshes" / "00.ply")
    # 0.5 m wide, 0.6 m deep, 1 m high round (0.5, 3, 0.5); marching cubes end half a cell in or out.
    assert np.allclose(mesh.bounds, [[0.25, 2.7, 0.0], [0.75, 3.3, 1.0]], atol=0.07)
    assert {path.name for path in output.iterdir()} == {
        "scene.json",
        "scene.glb",
        "occupancy.ply",
        "turntable.gif",
        "meshes",
        "topdown.png",
        "overlays",
        "viewer.npz",
        *(["prediction.html"] if has_viser() else []),
    }
    assert len(list((output / "overlays").iterdir())) == 2
    assert [path.name for path in output.parent.iterdir()] == ["room"]


@pytest.mark.parametrize(
    ("stage", "mesh", "said"),
    [
        ("stage2", None, "boxes but no meshes"),
        (
            "novel_view",
            "meshes/00.ply",
            "left the backbone alone",
        ),  # it may have begun from one that knows shapes
    ],
)
def test_meshes_of_other_stages(scene, oracle, tmp_path, monkeypatch, caplog, stage, mesh, said):
    settings = PredictionSettings(preset="tiny", stage=stage, image_size=IMAGE_SIZE, num_views=96)
    monkeypatch.setattr(module, "prediction_settings", lambda path: settings)
    output = module.predict(config(scene, tmp_path / "out"))
    content = json.loads((output / "scene.json").read_text())
    assert [(o["category"], o["mesh"]) for o in content["objects"]] == [("chair", mesh)]
    assert said in caplog.text


def test_the_viewer_gets_frames_voxels_and_errors(scene, oracle, tmp_path):
    truth = tmp_path / "truth.json"
    chair = {
        "category": "chair",
        "score": 1.0,
        "center": [0.5, 3.1, 0.5],
        "size": [0.5, 1.0, 0.6],
        "mesh": None,
    }
    chair["rotation"] = UPRIGHT.tolist()
    truth.write_text(json.dumps({"format": "raytran.scene/1", "scene_id": "any", "objects": [chair]}))
    output = module.predict(config(scene, tmp_path / "out", truth=str(truth)))
    shown = read_viewer_scene(output)
    assert shown.frame_ids == ["0", "5", "15", "20"]
    assert shown.occupancy.shape == (4, 4, 2)
    assert shown.errors[0].found
    assert shown.errors[0].translation == pytest.approx(0.1, abs=1e-6)
    assert len(shown.meshes[0].faces) > 100
    output = module.predict(config(scene, tmp_path / "out", viewer=False))
    assert not {path.name for path in output.iterdir()} & {"viewer.npz", "prediction.html"}
    with pytest.raises(DataError, match=r"cannot read truth=.*nothing\.json"):
        module.predict(config(scene, tmp_path / "none", truth=str(tmp_path / "nothing.json")))
    assert not (tmp_path / "none").exists()


def test_without_viser_there_is_no_page_and_that_is_said_once(scene, oracle, tmp_path, monkeypatch, caplog):
    caplog.set_level("INFO")
    for place in (module, write_scene):
        monkeypatch.setattr(place, "has_viser", lambda: False)
    output = module.predict(config(scene, tmp_path / "out"))
    assert (output / "viewer.npz").is_file()
    assert not (output / "prediction.html").exists()
    assert caplog.text.count("pip install 'raytran[viewer]'") == 1


def test_views_follow_the_checkpoint_and_come_once(scene, oracle, tmp_path):
    module.predict(config(scene, tmp_path / "out"))
    # 96 views are asked for, four have a pose; frames shrink to the network's size, intrinsics with them.
    assert oracle.seen.images.shape == (1, 4, 3, *IMAGE_SIZE)
    assert oracle.views_at_once == 4
    assert oracle.seen.intrinsics[0, 0, 0].tolist() == pytest.approx([70 * 0.8, 0, 32])
    assert oracle.seen.world_from_camera[0, :, 0, 3].tolist() == pytest.approx([0.0, 0.1, 0.3, 0.4])
    assert oracle.grid_center is None
    module.predict(config(scene, tmp_path / "out", num_views=2))
    assert oracle.seen.images.shape[1] == 2


def test_frames_are_chosen_by_coverage_unless_told(scene, oracle, tmp_path, caplog):
    caplog.set_level("INFO")
    # A sixth frame stands where the last one does: as many as are asked for, but nothing new.
    for part, ending in (("color", "jpg"), ("pose", "txt")):
        (scene / part / f"25.{ending}").write_bytes((scene / part / f"20.{ending}").read_bytes())
    module.predict(config(scene, tmp_path / "out"))
    assert oracle.seen.world_from_camera[0, :, 0, 3].tolist() == pytest.approx([0.0, 0.1, 0.3, 0.4])
    assert "chose 4 of 5 frames" in caplog.text
    assert "left out 1 near-duplicates and 0 that are blurred" in caplog.text
    module.predict(config(scene, tmp_path / "out", frames="even"))
    assert oracle.seen.world_from_camera[0, :, 0, 3].tolist() == pytest.approx([0.0, 0.1, 0.3, 0.4, 0.4])


@pytest.mark.parametrize("form", ["cpp", "odam", "mmdetection3d", "frames_25k", "sens"])
def test_every_form_of_a_scan_gives_the_same_views(scene, oracle, tmp_path, form):
    module.predict(config(scene, tmp_path / "expected"))
    expected = oracle.seen
    other = tmp_path / "other" / "living_room"
    if form == "sens":
        other = other.with_suffix(".sens")
        other.parent.mkdir()
        color = [(scene / "color" / f"{5 * n}.jpg").read_bytes() for n in range(5)]
        poses = np.stack([np.loadtxt(scene / "pose" / f"{5 * n}.txt") for n in range(5)])
        matrix = np.loadtxt(scene / "intrinsic" / "intrinsic_color.txt")
        other.write_bytes(encode_sens(color, [b""] * 5, poses, color_size=(60, 80), intrinsics=matrix))
    else:
        write_form(form, scene, other)
    output = module.predict(config(other, tmp_path / "out"))
    assert json.loads((output / "scene.json").read_text())["scene_id"] == "living_room"
    assert torch.equal(oracle.seen.images, expected.images)
    assert torch.equal(oracle.seen.intrinsics, expected.intrinsics)
    torch.testing.assert_close(oracle.seen.world_from_camera, expected.world_from_camera, rtol=0, atol=1e-6)


def test_two_predictions_into_one_folder(scene, oracle, tmp_path):
    output = module.predict(config(scene, tmp_path / "out"))
    before = digests(output)
    with (
        one_writer(output, marker="scene.json"),
        pytest.raises(ConfigError, match=r"another process writes .*out \(number \d+ on ") as raised,
    ):
        module.predict(config(scene, tmp_path / "out", score_threshold=0.2))
    assert len(str(raised.value)) - len(str(output)) < 250
    assert digests(output) == before
    module.predict(config(scene, tmp_path / "out", score_threshold=0.2))
    assert digests(output) != before
    assert [path.name for path in tmp_path.iterdir() if path.name.startswith(".")] == []


def test_thresholds(scene, oracle, tmp_path):
    output = module.predict(config(scene, tmp_path / "out", score_threshold=0.2, duplicate_iou=None))
    objects = json.loads((output / "scene.json").read_text())["objects"]
    assert [(o["category"], o["mesh"]) for o in objects] == [
        ("chair", "meshes/00.ply"),
        ("chair", "meshes/01.ply"),
        ("table", None),
    ]


def test_nothing_found_is_a_result_and_is_said(scene, oracle, tmp_path, caplog):
    caplog.set_level("INFO")
    output = module.predict(config(scene, tmp_path / "out", score_threshold=0.95))
    assert json.loads((output / "scene.json").read_text())["objects"] == []
    assert (output / "topdown.png").is_file()
    assert (output / "scene.glb").is_file()
    assert len(list((output / "overlays").iterdir())) == 2
    assert "no object has a score above the threshold" in caplog.text


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"format": "kitti"}, ConfigError, "unknown format=kitti: choose one of auto, scannet"),
        ({"frames": "sharp"}, ConfigError, "unknown frames=sharp: choose one of coverage, even"),
        ({"num_views": 0}, ConfigError, "num_views=0 leaves no frame: give 1 or more"),
        ({"turntable": -1}, ConfigError, "turntable=-1 is no number of pictures: give 0 or more"),
        ({"num_overlays": "all"}, ConfigError, "num_overlays=all is no number of pictures"),
        ({"cads": "nowhere"}, DataError, "no CAD model of ShapeNetCore v1 or v2 lies in nowhere"),
        ({"device": "abacus"}, ConfigError, "cannot use device=abacus"),
        ({"scene": "nowhere"}, DataError, "nowhere"),
    ],
)
def test_mistakes_are_one_sentence_and_leave_nothing(scene, oracle, tmp_path, changes, error, message):
    with pytest.raises(error, match=message):
        module.predict(config(scene, tmp_path / "out", **changes))
    assert not (tmp_path / "out").exists()


def test_a_network_that_wants_masks_is_for_evaluate(scene, oracle, tmp_path):
    oracle.backbone.encoder.input_channels = 4
    with pytest.raises(ConfigError, match=r"a\.ckpt was trained with the true masks .* raytran evaluate"):
        module.predict(config(scene, tmp_path / "out"))
    assert not (tmp_path / "out").exists()


def test_a_missing_checkpoint(scene, tmp_path):
    with pytest.raises(CheckpointError, match=r"a\.ckpt"):
        module.predict(config(scene, tmp_path / "out"))
    assert not (tmp_path / "out").exists()
