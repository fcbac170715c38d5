# SPDX-License-Identifier: Apache-2.0
"""Checkpoints that describe networks which their weights are not of, in both kinds of files."""

from __future__ import annotations

import copy
import math
import time

import pytest
import torch

from raytran.checkpoints.file import PREFIX, read_checkpoint, write_checkpoint, write_weights
from raytran.checkpoints.load import load_model, prediction_settings
from raytran.checkpoints.metadata import checkpoint_metadata
from raytran.errors import CheckpointError, RaytranError
from raytran.run.entry import compose
from raytran.run.train.build import build_model, plain


@pytest.fixture(scope="module")
def whole():
    """What a checkpoint of a tiny network holds."""
    config = compose("train", ["preset=tiny", "model.grid_resolution=[8,8,4]", "output_dir=unused"])
    metadata = checkpoint_metadata(stage="stage2", preset="tiny", config=plain(config), parent=None)
    state = {f"{PREFIX}{name}": value for name, value in build_model(config).state_dict().items()}
    return {**metadata, "state_dict": state}


@pytest.fixture(params=["ckpt", "safetensors"])
def write(request, tmp_path, whole):
    """Return a function that writes the checkpoint with one value changed, and returns its path."""

    def write(place, value):
        content = {**copy.deepcopy({**whole, "state_dict": None}), "state_dict": dict(whole["state_dict"])}
        *places, last = place.split("/")
        node = content
        for name in places:
            node = node[name]
        node[last] = value
        path = tmp_path / f"weights.{request.param}"
        if request.param == "ckpt":
            write_checkpoint(path, content)
        else:
            state = content.pop("state_dict")
            write_weights(path, content, {name.removeprefix(PREFIX): w for name, w in state.items()})
        return path

    return write


def refusal(path):
    """Return the sentence in which reading ends, after a moment."""
    began = time.monotonic()
    with pytest.raises(RaytranError) as error:
        _ = prediction_settings(path), load_model(path)
    assert time.monotonic() - began < 10  # a second, on a machine with nothing else to do
    said = str(error.value)
    assert "\n" not in said
    assert len(said.replace(str(path), "PATH")) <= 300
    return said


def test_the_unchanged_one_is_read(write):
    path = write("warnings", ["a warning"])
    assert prediction_settings(path).preset == "tiny"
    assert not load_model(path).training


def nested(depth):
    node = {"_target_": "Stream"}
    for _ in range(depth):
        node = {"_target_": "Stream", "x": [node] * 10}
    return node


@pytest.mark.parametrize(
    ("place", "value"),
    [
        ("model/backbone/num_blocks", 10**9),
        ("model/backbone/num_blocks", 10**6),
        ("model/backbone/num_blocks", 3),
        ("model/backbone/num_blocks", -1),
        ("model/backbone/num_blocks", math.inf),
        ("model/backbone/num_blocks", "9" * 10**5),
        ("model/backbone/channels", 10**6),
        ("model/backbone/channels", 16.5),
        ("model/heads/objects/num_layers", 10**7),
        ("model/heads/objects/num_layers", 999_999),
        ("model/heads/objects/num_queries", 10**6),
        ("model/heads/foreground/widths", [4] * 10**6),
        ("model/heads/foreground/widths", [4] * 9_000),
        ("model/heads/foreground/widths", []),
        ("model/heads/foreground/widths", None),
        ("model/heads/objects/queries", "a\nb\x1b[2J" * 100),
        ("model/heads", [{}]),
        ("model/heads", {}),
        ("model/backbone", nested(5)),
        ("model/backbone/encoder", {"_target_": ["Stream"] * 10**4}),
        ("model/_target_", "x" * 10**5),
        ("model/_target_", "os.system"),
        ("model", {}),
        ("model/grid_resolution", [-1, 0, 3]),
        ("model/grid_resolution", [10**6, 10**6, 10**6]),
        ("model/grid_resolution", [8, 8]),
        ("model/grid_extent", [math.nan, 1, 1]),
        ("model/grid_extent", [1e300, 1, 1]),
        ("model/rays_per_cell", 10**6),
        ("model/rays_per_cell", 0),
        ("views/image_size", [0, 64]),
        ("views/image_size", [10**9, 64]),
        ("views/image_size", ["64", "64"]),
        ("views/predict_views", 10**12),
        ("views/predict_views", -1),
        ("views", {}),
        ("stage", "stage2 output=/"),
        ("preset", "../../x"),
        ("preset", "a,b"),
        ("preset", "x" * 10**5),
        ("format", "x" * 10**5),
        ("global_step", -1),
        ("global_step", 10**30),
        ("scores", {"a": "[/x]"}),
        ("parent", {"stage": 5}),
        ("warnings", 5),
        ("data", []),
    ],
)
def test_nonsense_ends_in_one_sentence_before_anything_is_built(write, place, value):
    refusal(write(place, value))


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_weights_that_are_not_finite_are_named(write, whole, value):
    name = next(iter(whole["state_dict"]))
    weight = whole["state_dict"][name].clone()
    weight.view(-1)[-1] = value
    said = refusal(write(f"state_dict/{name}", weight))
    assert said.startswith(f"{name} in ")
    assert "is not finite" in said


def test_weights_that_become_infinite_in_float32_are_named(write, whole):
    name = next(iter(whole["state_dict"]))
    weight = whole["state_dict"][name].double() * 1e300 + 1e300
    assert "is not finite" in refusal(write(f"state_dict/{name}", weight))


@pytest.mark.parametrize("name", ["x" * 10**5, "a\nb", ""])
def test_names_of_weights_are_short_and_printable(write, whole, name):
    assert "state_dict" in refusal(write(f"state_dict/{PREFIX}{name or chr(27)}", torch.zeros(1)))


def test_complex_weights_are_none(write, whole):
    name = next(iter(whole["state_dict"]))
    assert "tensors" in refusal(write(f"state_dict/{name}", whole["state_dict"][name].to(torch.complex64)))


def test_references_that_multiply_are_refused(tmp_path, whole):
    """A pickle names one list many times: two hundred bytes for ten to the twentieth values."""
    for place in ("model", "config", "scores"):
        node = {"a": 1.0}
        for _ in range(20):
            node = {str(index): node for index in range(10)}
        path = tmp_path / "weights.ckpt"
        write_checkpoint(path, {**whole, place: node})
        assert "damaged" in refusal(path)


def test_tensors_of_more_bytes_than_the_file_are_refused(tmp_path, whole):
    state = {
        name: torch.zeros((), dtype=value.dtype).expand(value.shape)
        for name, value in whole["state_dict"].items()
    }
    path = tmp_path / "weights.ckpt"
    write_checkpoint(path, {**whole, "state_dict": state})
    assert path.stat().st_size < 500_000
    assert "damaged" in refusal(path)


def test_optimiser_states_of_more_bytes_than_the_file_are_refused_too(tmp_path, whole):
    path = tmp_path / "weights.ckpt"
    write_checkpoint(path, {**whole, "optimizer_states": [torch.zeros(1).expand(10**9)]})
    with pytest.raises(CheckpointError, match="damaged"):
        read_checkpoint(path)
