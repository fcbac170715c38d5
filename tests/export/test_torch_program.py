# SPDX-License-Identifier: Apache-2.0
"""Programs of ``torch.export`` compute what the network computes."""

from __future__ import annotations

import subprocess
import sys

import pytest
import torch

from raytran.errors import ConfigError
from raytran.export.torch_program import example_inputs, export_network, export_shapes
from raytran.geometry.camera import Cameras
from raytran.model import TASKS, RayTran
from raytran.run.entry import compose
from raytran.run.plan.camera_paths import walk
from raytran.run.train.build import build_model
from raytran.structs import Views

IMAGE_SIZE = (32, 48)


def network(*settings) -> RayTran:
    torch.manual_seed(0)
    small = ["preset=tiny", "model.grid_resolution=[8,8,4]", "model.backbone.num_blocks=1", "output_dir=x"]
    few = ["model.heads.objects.num_layers=1", "model.heads.objects.num_queries=5"]
    return build_model(compose("train", [*small, *few, *settings]), pretrained=False).eval()


def cameras(views) -> Cameras:
    return walk(views).scaled_to(IMAGE_SIZE)


@pytest.fixture(scope="module")
def model():
    return network()


@pytest.fixture(scope="module")
def file(model, tmp_path_factory):
    """The network as a program of torch's own operators, written to a file."""
    path = tmp_path_factory.mktemp("programs") / "network.pt2"
    torch.export.save(export_network(model, cameras(3), tasks=TASKS), path)
    return path


@pytest.fixture(scope="module")
def program(file):
    return torch.export.load(file).module()


@torch.no_grad()
def expected(model, inputs):
    """Return what ``RayTran.forward``, which traces the rays itself, gives for the same scene."""
    images, intrinsics, poses, center, *_ = inputs
    raw = model(Views(images[None], intrinsics[None], poses[None]), grid_center=center[None])
    last = raw.objects[-1]
    names = ("class_logits", "center", "log_size", "yaw_vector", "embedding")
    return {
        "occupancy": raw.occupancy[0],
        "foreground": raw.foreground[0],
        **{name: getattr(last, name)[0] for name in names},
    }


def assert_same(found, wanted, **tolerance):
    assert found.keys() == wanted.keys()
    for name, value in wanted.items():
        torch.testing.assert_close(
            found[name], value, msg=lambda text, name=name: f"{name}: {text}", **tolerance
        )


def test_a_program_equals_the_network_for_any_number_of_views(model, program):
    for views in (3, 2, 5):
        inputs = example_inputs(model, cameras(views), seed=views)
        with torch.no_grad():
            found = program(*inputs)
        assert_same(found, expected(model, inputs), rtol=1e-4, atol=2e-5)
        assert found["foreground"].shape == (views, *IMAGE_SIZE)


def test_the_pairs_are_an_input(model, program):
    """Fewer pairs than the rays give are taken as they are, also where a voxel or a pixel has none."""
    *others, pixel, voxel = example_inputs(model, cameras(3))
    with torch.no_grad():
        whole, few = program(*others, pixel, voxel), program(*others, pixel[:2], voxel[:2])
    assert all(value.isfinite().all() for value in few.values())
    assert not torch.allclose(whole["occupancy"], few["occupancy"], atol=1e-3)


RUN = """
import sys, torch
sys.modules["raytran"] = None  # an import fails
program = torch.export.load(sys.argv[1]).module()
with torch.no_grad():
    torch.save(program(*torch.load(sys.argv[2])), sys.argv[3])
"""


def test_it_runs_without_raytran(model, file, tmp_path):
    inputs = example_inputs(model, cameras(4))
    torch.save(inputs, tmp_path / "inputs.pt")
    words = [sys.executable, "-c", RUN, file, tmp_path / "inputs.pt", tmp_path / "outputs.pt"]
    done = subprocess.run(words, capture_output=True, text=True, check=False, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert_same(torch.load(tmp_path / "outputs.pt"), expected(model, inputs), rtol=1e-4, atol=2e-5)


def test_with_raytrans_operators_it_gives_the_same_bits():
    """Also for proposed queries, whose order rounding may change, and for some of the heads alone."""
    model = network("model/extensions=[proposal_queries]")
    program = export_network(model, cameras(3), tasks=["objects"], operators="raytran").module()
    inputs = example_inputs(model, cameras(2))
    with torch.no_grad():
        found = program(*inputs)
    wanted = expected(model, inputs)
    of_objects = {name: wanted[name] for name in wanted if name not in ("occupancy", "foreground")}
    assert_same(found, of_objects, rtol=0, atol=0)


def test_shapes_of_any_number_of_objects(model):
    program = export_shapes(model).module()
    for count in (1, 2, 7):
        embedding = torch.randn(count, model.backbone.channels)
        with torch.no_grad():
            torch.testing.assert_close(program(embedding), model.decode_shapes(embedding), rtol=0, atol=1e-5)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"tasks": ["shape"]}, r"unknown tasks=\['shape'\]: choose some of occupancy, foreground, objects"),
        ({"tasks": []}, r"unknown tasks=\[\]"),
        ({"tasks": ["objects"], "operators": "onnx"}, "unknown operators=onnx: choose one of aten, raytran"),
    ],
)
def test_mistakes_are_one_sentence(model, settings, message):
    with pytest.raises(ConfigError, match=message):
        export_network(model, cameras(3), **settings)


def test_a_network_without_a_head(model):
    headless = RayTran(backbone=model.backbone, heads={"occupancy": model.heads["occupancy"]})
    with pytest.raises(ConfigError, match=r"unknown tasks.*choose some of occupancy"):
        export_network(headless, cameras(3), tasks=["objects"])
    with pytest.raises(ConfigError, match="no shape head"):
        export_shapes(headless)
