# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import gzip
import json

import numpy as np
import pytest
import torch
from PIL import Image

from raytran.geometry.grid import VoxelGrid
from raytran.ops.pairs import PairList
from raytran.structs import ObjectSet, ScenePrediction, Views
from raytran.viewer.view_data import ViewedVolume, write_view_data
from raytran.viewer.view_reads import VoxelReads

UPRIGHT = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


def chairs(count):
    return ObjectSet(
        label=torch.full((count,), 3),
        center=torch.arange(3.0 * count).reshape(count, 3),
        size=torch.ones(count, 3),
        rotation=UPRIGHT.expand(count, 3, 3),
        symmetry=torch.ones(count, dtype=torch.int64),
        score=torch.full((count,), 0.9),
    )


@pytest.fixture
def views(generator):
    images = torch.rand(1, 2, 4, 600, 800, generator=generator)
    images[0, 1] = 1.0
    pose = torch.eye(4).repeat(1, 2, 1, 1)
    pose[0, 1, 0, 3] = 2.5
    intrinsics = torch.tensor([[500.0, 0, 400], [0, 510, 300], [0, 0, 1]]).expand(1, 2, 3, 3)
    return Views(images, intrinsics, pose)


def read_array(folder, file, dtype):
    return np.frombuffer(gzip.decompress((folder / "view" / file).read_bytes()), dtype=dtype)


def test_everything_a_page_needs_is_there(views, tmp_path):
    prediction = ScenePrediction("a room", chairs(2), torch.zeros(3))
    pairs = PairList(torch.tensor([1, 7, 7]), torch.tensor([0, 0, 3]), 8, 4)
    volume = ViewedVolume(
        grid=VoxelGrid((2, 2, 1), (4.0, 4.0, 2.0), torch.tensor([1.0, 2.0, 3.0])),
        frames=[0, 1],
        occupancy=torch.tensor([0.0, 0.25, 0.5, 1.0]).view(2, 2, 1),
        seen=torch.tensor([2, 0, 0, 1]).view(2, 2, 1),
        reads=VoxelReads(pairs, torch.tensor([0.2, 0.8, 1.0]), (2, 2)),
    )
    path = write_view_data(tmp_path, prediction, views, ["first", "a/b"], volumes=[volume], truth=chairs(1))
    content = json.loads(path.read_text())
    assert path == tmp_path / "view" / "view.json"
    assert (content["format"], content["scene_id"], content["image_size"]) == (
        "raytran.view/1",
        "a room",
        [600, 800],
    )
    assert [frame["name"] for frame in content["frames"]] == ["first", "a/b"]
    assert content["frames"][1]["world_from_camera"][0] == [1.0, 0.0, 0.0, 2.5]
    assert content["frames"][0]["intrinsics"][1] == [0.0, 510.0, 300.0]
    with Image.open(tmp_path / "view" / content["frames"][1]["image"]) as image:
        assert image.size == (480, 360)
        assert np.asarray(image).min() > 250
    entry = content["volumes"][0]
    assert (entry["resolution"], entry["extent"], entry["center"]) == (
        [2, 2, 1],
        [4.0, 4.0, 2.0],
        [1.0, 2.0, 3.0],
    )
    assert read_array(tmp_path, entry["occupancy"], "u1").tolist() == [0, 64, 128, 255]
    assert read_array(tmp_path, entry["seen"], "<i2").tolist() == [2, 0, 0, 1]
    reads = entry["reads"]
    assert (reads["feature_size"], reads["cut"]) == ([2, 2], pytest.approx(1 / 255))
    assert read_array(tmp_path, reads["offsets"], "<i4").tolist() == [0, 2, 2, 2, 3]
    assert read_array(tmp_path, reads["steps"], "<i4").tolist() == [1, 6, 7]
    assert read_array(tmp_path, reads["weights"], "u1").tolist() == [64, 255, 255]
    assert content["truth"][0]["category"] == "chair"
    assert [entry["found"] for entry in content["errors"]] == [True, False]


def test_little_is_known(views, tmp_path):
    prediction = ScenePrediction("room", ObjectSet.empty(), torch.zeros(3))
    volume = ViewedVolume(grid=VoxelGrid((2, 2, 1), (4.0, 4.0, 2.0), torch.zeros(3)), frames=[0])
    content = json.loads(
        write_view_data(tmp_path, prediction, views, ["a", "b"], volumes=[volume]).read_text()
    )
    assert content["truth"] is content["errors"] is content["volumes"][0]["reads"] is None
    assert {path.name for path in (tmp_path / "view").iterdir()} == {"view.json", "frames"}


def test_the_same_input_gives_the_same_bytes(views, tmp_path):
    prediction = ScenePrediction("room", chairs(1), torch.zeros(3))
    grid = VoxelGrid((2, 2, 1), (4.0, 4.0, 2.0), torch.zeros(3))
    written = []
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
        volume = ViewedVolume(
            grid=grid, frames=[0, 1], occupancy=torch.rand(2, 2, 1, generator=torch.manual_seed(0))
        )
        write_view_data(tmp_path / name, prediction, views, ["a", "b"], volumes=[volume])
        written.append({p.name: p.read_bytes() for p in (tmp_path / name).rglob("*") if p.is_file()})
    assert written[0] == written[1]
