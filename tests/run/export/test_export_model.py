# SPDX-License-Identifier: Apache-2.0
"""From a checkpoint to a file to give away and back."""

from __future__ import annotations

import json
import re

import pytest
import torch
from rich.console import Console
from safetensors import safe_open

import raytran
from raytran.checkpoints.file import file_digest, read_checkpoint, write_checkpoint, write_weights
from raytran.checkpoints.load import prediction_settings
from raytran.errors import CheckpointError, ConfigError
from raytran.export.torch_program import example_inputs
from raytran.heads.score_scaling import ScoreScaling
from raytran.run.entry import compose
from raytran.run.export.export_model import described, export_model
from raytran.run.plan.camera_paths import walk
from raytran.structs import Views
from raytran.training.callbacks.stage import Parent

from ...factories import Trained


def exported(trained, folder, *settings):
    output = folder / "out" / "rooms.safetensors"
    return export_model(
        compose("export_model", [f"checkpoint={trained.path}", f"output={output}", *settings])
    )


def test_the_network_comes_back_bit_by_bit(trained, tmp_path):
    path, model = exported(trained, tmp_path), trained.model
    loaded = raytran.load(path)
    assert not loaded.training
    assert loaded.grid_resolution == (8, 8, 4)
    state = loaded.state_dict()
    assert all(torch.equal(value, state[name]) for name, value in model.state_dict().items())
    assert prediction_settings(path) == prediction_settings(trained.path)
    of_both = [Parent.of(file, read_checkpoint(file)) for file in (path, trained.path)]
    assert (of_both[0].stage, of_both[0].step) == ("stage3", 40)
    assert of_both[0].scores["val/objects/f1_0.25"] == 0.5
    assert of_both[0].scores == of_both[1].scores


def test_the_header_says_what_is_inside_and_nothing_of_the_machine(trained, tmp_path):
    with safe_open(exported(trained, tmp_path), framework="pt") as file:
        text, names = file.metadata()["raytran"], set(file.keys())
    assert names == set(trained.model.state_dict())
    metadata = json.loads(text)
    assert (metadata["stage"], metadata["preset"], metadata["global_step"]) == ("stage3", "tiny", 40)
    assert metadata["parent"] == {"stage": "stage2", "step": 3}
    assert metadata["versions"]["torch"] == torch.__version__
    assert metadata["model"]["grid_resolution"] == [8, 8, 4]
    assert "/home/me" not in text
    assert str(tmp_path.parent) not in text


@pytest.mark.parametrize(("dtype", "bits"), [("float16", 11), ("bfloat16", 8)])
def test_half_the_size_rounds_the_weights(trained, tmp_path, dtype, bits):
    whole = exported(trained, tmp_path).stat().st_size
    half = exported(trained, tmp_path, f"dtype={dtype}")
    assert half.stat().st_size < 0.52 * whole
    state, exact = raytran.load(half).state_dict(), trained.model.state_dict()
    for name, value in exact.items():
        assert state[name].dtype == value.dtype
        torch.testing.assert_close(state[name], value, rtol=2.0**-bits, atol=1e-7)


def test_an_exported_file_is_exported_again(trained, tmp_path):
    first = exported(trained, tmp_path, "dtype=bfloat16")
    again = export_model(
        compose("export_model", [f"checkpoint={first}", f"output={tmp_path / 'b.safetensors'}"])
    )
    a, b = (raytran.load(path).state_dict() for path in (first, again))
    assert all(torch.equal(value, b[name]) for name, value in a.items())


@pytest.mark.parametrize(
    ("settings", "error", "message"),
    [
        (["dtype=int8"], ConfigError, "unknown dtype=int8: choose one of float32, float16, bfloat16"),
        (["output=weights.onnx"], ConfigError, r"weights\.onnx has an unknown ending: choose .* or \.pt2"),
        (["output=a.pt2", "dtype=float16"], ConfigError, r"dtype=float16 is for \.safetensors"),
        (
            ["output=a.pt2", "program.part=heads"],
            ConfigError,
            "unknown program.part=heads: choose one of network",
        ),
        (["checkpoint=none.ckpt"], CheckpointError, r"no checkpoint at none\.ckpt"),
    ],
)
def test_mistakes_are_one_sentence_and_leave_nothing(trained, tmp_path, settings, error, message):
    with pytest.raises(error, match=message):
        exported(trained, tmp_path, *settings)
    assert not (tmp_path / "out").exists()


def test_a_file_is_not_exported_onto_itself(trained, tmp_path):
    path = exported(trained, tmp_path)
    for place, message in ((path, "is the checkpoint itself"), (path.parent, "unknown ending")):
        with pytest.raises(ConfigError, match=message):
            export_model(compose("export_model", [f"checkpoint={path}", f"output={place}", "dtype=float16"]))
    (tmp_path / "folder.safetensors").mkdir()
    with pytest.raises(ConfigError, match="is a folder"):
        export_model(
            compose("export_model", [f"checkpoint={path}", f"output={tmp_path / 'folder.safetensors'}"])
        )


@pytest.mark.parametrize(
    ("value", "dtype", "message"),
    [
        (1e6, "float16", "beyond the range of float16: choose dtype=bfloat16"),
        (float("nan"), "float32", "is not finite"),
    ],
)
def test_weights_that_do_not_fit_are_named(trained, tmp_path, value, dtype, message):
    content = torch.load(trained.path, weights_only=True)
    content["state_dict"]["model.backbone.unseen"][0] = value
    write_checkpoint(tmp_path / "last.ckpt", content)
    with pytest.raises(CheckpointError, match=rf"model\.backbone\.unseen in .*last\.ckpt.*{message}"):
        exported(Trained(tmp_path / "last.ckpt", None), tmp_path, f"dtype={dtype}")


def put(path, content, **model):
    """Write a file whose metadata asks for another network than its weights are of."""
    metadata = {
        name: value for name, value in content.items() if name not in ("state_dict", "optimizer_states")
    }
    state = {name.removeprefix("model."): value for name, value in content["state_dict"].items()}
    write_weights(path, metadata | {"model": content["model"] | model}, state)


def test_a_file_cannot_run_foreign_code(trained, tmp_path):
    path = tmp_path / "bad.safetensors"
    put(path, torch.load(trained.path, weights_only=True), heads={"_target_": "os.system", "command": "true"})
    with pytest.raises(CheckpointError, match=r"bad\.safetensors asks to run 'os\.system'"):
        raytran.load(path)


def test_the_file_and_not_its_claim_decides_how_much_memory_is_taken(trained, tmp_path):
    """A network of a terabyte is described: it is refused before memory for it is asked for."""
    content = torch.load(trained.path, weights_only=True)
    shape = content["model"]["heads"]["shape"] | {"widths": [1 << 16, 1 << 15, 64, 32]}
    put(tmp_path / "huge.safetensors", content, heads=content["model"]["heads"] | {"shape": shape})
    with pytest.raises(CheckpointError, match=r"\(preset tiny\) do not fit"):
        raytran.load(tmp_path / "huge.safetensors")


def test_without_output_it_says_what_is_inside(trained, capsys):
    assert export_model(compose("export_model", [f"checkpoint={trained.path}"])) is None
    words = capsys.readouterr().out
    for said in ("stage2, 3 steps", "M, float32", "val/objects/f1_0.25", "0.5", torch.__version__):
        assert said in words, said
    assert "val/objects/f1_0.25/chair" not in words


def test_a_program_says_how_to_use_it(trained, tmp_path, caplog):
    caplog.set_level("INFO")
    words = [f"checkpoint={trained.path}", f"output={tmp_path / 'rooms.pt2'}", "program.tasks=occupancy"]
    path = export_model(compose("export_model", words))
    extra = {"raytran.json": ""}
    program = torch.export.load(path, extra_files=extra).module()
    about = json.loads(extra["raytran.json"])
    assert (about["format"], about["operators"], about["stage"]) == ("raytran.program/1", "aten", "stage3")
    size = prediction_settings(trained.path).image_size
    assert tuple(about["image_size"]) == size
    inputs = example_inputs(trained.model, walk(2).scaled_to(size))
    assert about["feature_size"] == [side // trained.model.backbone.stride for side in size]
    with torch.no_grad():
        assert program(*inputs)["occupancy"].shape == tuple(about["grid_resolution"])
    assert float(re.search(r"differ from the network's by at most (\S+)", caplog.text)[1]) < 1e-4
    with pytest.raises(CheckpointError, match=r"rooms\.pt2 is a program of torch\.export.*\.safetensors"):
        raytran.load(path)


def test_the_decoder_of_shapes_is_a_program_too(trained, tmp_path):
    words = [f"checkpoint={trained.path}", f"output={tmp_path / 'shapes.pt2'}", "program.part=shapes"]
    program = torch.export.load(export_model(compose("export_model", words))).module()
    embedding = torch.randn(1, trained.model.backbone.channels)
    with torch.no_grad():
        torch.testing.assert_close(program(embedding), trained.model.eval().decode_shapes(embedding))


def evaluation_of(path, folder, *, scale=0.5, offset=-0.4, **other):
    """Write what is read of an evaluation, and return its folder."""
    scaling = None if scale is None else {"scale": scale, "offset": offset}
    metrics = {"checkpoint_sha256": file_digest(path), "split": "val"}
    metrics |= {"strict": {"calibration": {"every_score": {"scaling": scaling}}}} | other
    folder.mkdir(exist_ok=True)
    (folder / "metrics.json").write_text(json.dumps(metrics))
    return folder


def test_scores_are_scaled_in_the_file_and_once_more_from_there(trained, tmp_path, caplog):
    assert raytran.load(exported(trained, tmp_path)).score_scaling is None
    results = evaluation_of(trained.path, tmp_path / "results")
    with caplog.at_level("INFO", "raytran"):
        once = exported(trained, tmp_path, f"calibration={results}")
    assert "scaled by 0.500 and shifted by -0.400" in caplog.text
    model = raytran.load(once)
    assert model.score_scaling == ScoreScaling(0.5, -0.4)
    raw = trained.model(walk_of(trained), tasks=("objects",))
    plain, scaled = (one.decode(raw, ["a"])[0].objects for one in (trained.model, model))
    torch.testing.assert_close(scaled.score, ScoreScaling(0.5, -0.4)(plain.score))
    assert torch.equal(scaled.center, plain.center)

    results = evaluation_of(once, tmp_path / "results", scale=2.0, offset=0.1)
    words = [f"checkpoint={once}", f"output={tmp_path / 'twice.safetensors'}", f"calibration={results}"]
    twice = export_model(compose("export_model", words))
    assert raytran.load(twice).score_scaling == ScoreScaling(1.0, 2.0 * -0.4 + 0.1)
    console = Console(record=True, width=120)
    console.print(described(read_checkpoint(once), once))
    assert "log odds × 0.500 -0.400" in console.export_text()


def walk_of(trained):
    cameras = walk(3).scaled_to(prediction_settings(trained.path).image_size)
    images = torch.zeros(1, 3, 3, *cameras.image_size)
    return Views(images, cameras.intrinsics[None].float(), cameras.world_from_camera[None].float())


def test_evaluations_of_something_else_are_refused(trained, tmp_path, caplog):
    results = tmp_path / "results"
    for write, message in (
        (lambda: None, "says nothing of scores"),
        (lambda: evaluation_of(trained.path, results, strict={}), "says nothing of scores"),
        (lambda: evaluation_of(trained.path, results, checkpoint_sha256="0"), "is of another file than"),
        (lambda: evaluation_of(trained.path, results, scale=None), "do not tell right from wrong"),
        (lambda: evaluation_of(trained.path, results, scale=-1), "no pair of a scale and an offset"),
    ):
        write()
        with pytest.raises(ConfigError, match=message):
            exported(trained, tmp_path, f"calibration={results}")
    assert not (tmp_path / "out").exists()
    evaluation_of(trained.path, results, split="test")
    exported(trained, tmp_path, f"calibration={results}")
    assert "no test any more" in caplog.text


@pytest.mark.slow
def test_what_evaluate_wrote_of_the_shipped_weights_leaves_nothing_to_scale_there(room, tmp_path, command):
    words = ["data=scan2cad", f"data.root={room}", "split=train", "num_views=4", "stage.targets=[objects]"]

    def calibration(checkpoint, name):
        done = command("evaluate", f"checkpoint={checkpoint}", *words, f"output={name}", folder=tmp_path)
        assert done.returncode == 0, done.stderr
        strict = json.loads((tmp_path / name / "metrics.json").read_text())["strict"]
        counted.append(strict["per_threshold"]["0.25"]["n_predicted"])
        return strict["calibration"]

    counted: list[int] = []
    before = calibration("default", "before")
    scaled = ["checkpoint=default", "output=scaled.safetensors", "calibration=before"]
    done = command("export_model", *scaled, folder=tmp_path)
    assert done.returncode == 0, done.stderr
    after = calibration("scaled.safetensors", "after")
    assert before["every_score"]["n_right"] > 0
    assert before["every_score"]["scaling"] != pytest.approx({"scale": 1.0, "offset": 0.0}, abs=0.1)
    assert after["every_score"]["scaling"] == pytest.approx({"scale": 1.0, "offset": 0.0}, abs=0.02)
    # What a score says has changed, not what counts as found.
    assert counted[0] == counted[1] > 0


def test_a_card_says_what_the_weights_are_and_how_to_load_them(trained, tmp_path):
    path = exported(trained, tmp_path, "card=true")
    text = (path.parent / "README.md").read_text()
    assert text.startswith("---\nlibrary_name: raytran\n")
    assert 'raytran.load("hf:OWNER/NAME/rooms.safetensors")' in text
    assert "| stage | stage3 |" in text
    assert "| val/objects/f1_0.25 | 0.5 |" in text
    assert "/home/me" not in text
    (path.parent / "README.md").write_text("mine")
    with pytest.raises(ConfigError, match="card=true would replace"):
        exported(trained, tmp_path, "card=true")
    assert (path.parent / "README.md").read_text() == "mine"
