# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import errno
import os
import re
import subprocess
import sys

import pytest
from hydra.errors import InstantiationException
from omegaconf import OmegaConf

from raytran.checkpoints.runs import one_at_a_time
from raytran.errors import ConfigError, DataError
from raytran.run.entry import compose, run_or_exit, with_keys, with_number_lists
from raytran.run.refused_run import remove_refused_run


def raise_error(error):
    def function(cfg):
        raise error

    return function


def test_a_mistake_is_one_sentence_and_exit_code_1(capsys):
    with pytest.raises(SystemExit) as stop:
        run_or_exit(raise_error(DataError("no scan at scans/a: check the path")), OmegaConf.create())
    assert stop.value.code == 1
    assert capsys.readouterr().err == "raytran: no scan at scans/a: check the path\n"


def test_a_mistake_inside_a_constructor_is_one_sentence(capsys):
    wrapped = InstantiationException("Error in call to target")
    wrapped.__cause__ = DataError("no file x")
    with pytest.raises(SystemExit):
        run_or_exit(raise_error(wrapped), OmegaConf.create())
    assert capsys.readouterr().err == "raytran: no file x\n"


def test_a_missing_setting_is_one_sentence(capsys):
    with pytest.raises(SystemExit):
        run_or_exit(lambda cfg: cfg.checkpoint, OmegaConf.create({"checkpoint": "???"}))
    assert "checkpoint" in capsys.readouterr().err


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EFBIG])
def test_a_full_disk_is_one_sentence(capsys, number):
    wrapped = ValueError("cannot encode")
    wrapped.__cause__ = OSError(number, os.strerror(number), "out/a.png")
    for error in (wrapped, wrapped.__cause__):
        with pytest.raises(SystemExit) as stop:
            run_or_exit(raise_error(error), OmegaConf.create())
        assert stop.value.code == 1
        (sentence,) = capsys.readouterr().err.splitlines()
        assert sentence.startswith(f"raytran: cannot write out/a.png ({os.strerror(number)}): make room")


@pytest.mark.parametrize(
    ("command_name", "typed"),
    [
        ("predict", ["scene={}", "output=x"]),
        ("predict", ["scene=.", "output={}"]),
        ("predict", ["scene=.", "output=x", "checkpoint={}"]),
        ("prepare", ["check={}"]),
        ("train", ["output_dir={}", "preset=tiny"]),
        ("curriculum", ["outputs={}", "preset=tiny"]),
        ("view", ["folder={}"]),
    ],
)
@pytest.mark.parametrize("path", ["a" * 5000, "b" * 300], ids=["path", "name"])
def test_a_path_that_the_system_refuses_is_one_sentence(command_name, typed, path, tmp_path, command):
    done = command(command_name, *[word.format(path) for word in typed], folder=tmp_path)
    (sentence,) = done.stderr.splitlines()
    assert done.returncode == 1
    # From Python 3.14 on pathlib says of such a path that nothing is there.
    assert "(File name too long): " in sentence or sys.version_info >= (3, 14)
    assert len(sentence) <= 300


def test_a_file_in_the_place_of_a_folder_is_one_sentence(tmp_path, command):
    (tmp_path / "file").touch()
    done = command("train", "preset=tiny", "output_dir=file/x", folder=tmp_path)
    assert done.returncode == 1
    assert (
        done.stderr == "raytran: cannot use file/x (Not a directory): choose another path, or mend this one\n"
    )


def test_an_interrupt_is_one_line_and_exit_code_130(capsys):
    with pytest.raises(SystemExit) as stop:
        run_or_exit(raise_error(KeyboardInterrupt()), OmegaConf.create())
    assert stop.value.code == 130
    assert capsys.readouterr().err.startswith("raytran: interrupted")


def test_a_defect_keeps_its_traceback():
    with pytest.raises(ZeroDivisionError):
        run_or_exit(lambda cfg: 1 / 0, OmegaConf.create())


@pytest.mark.parametrize(
    ("typed", "said"),
    [
        ("learning_speed=3", "learning_speed"),
        (
            "model=tinny",
            "there is no model=tinny: is model=tiny meant? choose one of laptop, raytran, small, tiny",
        ),
        ("cache_dir=x", "there is no setting cache_dir: is data.dataset.cache_dir meant?"),
        ("data.cache_dir=x", "is data.dataset.cache_dir meant?"),
        ("trainer.maxsteps=3", "is trainer.max_steps meant?"),
        ("nothing.like.it=3", "there is no setting nothing.like.it: --help lists all"),
        ("seed", "key=value"),
        ("lr=0.1", "there is no setting lr: is optimizer.learning_rate meant?"),
        ("expriment=stage1", "is experiment meant?"),
        ("--seed=3", "there is no option --seed: settings are written without dashes, as seed=VALUE"),
        ("seed=abc", "seed=abc is no number: give one, as in seed=0"),
        ("views.num_views=abc", "views.num_views=abc is no number: give one, as in views.num_views=20"),
        ("lr_find=perhaps", "lr_find=perhaps is neither true nor false"),
        ("progress_bar=fancy", "unknown progress_bar=fancy"),
        ("experiment=stage2", "no finished run of stage1"),
        ("trainer=gpu", "trainer.accelerator=gpu trainer.devices=1 asks for a GPU, and torch"),
        ("resume=elsewhere.ckpt", "give resume=auto"),
        ("schedule.joint.steps=3", "schedule.joint.steps=3 is called schedule.stage2.steps=3 now"),
        ("model.backbone.resnet.width=8", "is called model.backbone.encoder.width=8 now"),
        ("model.heads.objects.windowed=true", "is called model/extensions=[windowed_attention] now"),
    ],
)
def test_a_wrong_setting_is_one_sentence(tmp_path, typed, said, command):
    done = command("train", typed, folder=tmp_path)
    assert done.returncode == 1
    (sentence,) = done.stderr.splitlines()
    assert sentence.startswith("raytran: ")
    assert said in sentence
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["train", "curriculum", "evaluate", "prepare"])
def test_help_names_the_settings_without_loading_torch(name, tmp_path):
    code = (
        "import atexit, os, runpy, sys; sys.argv = ['x', '--help'];"
        "atexit.register(lambda: 'torch' in sys.modules and os._exit(9));"
        f"runpy.run_module('raytran.{name}', run_name='__main__')"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert re.search(rf"raytran[ .]{name}\b", done.stdout)
    assert "preset" in done.stdout
    assert "_target_" not in done.stdout


def test_compose_is_what_the_command_line_would_compose():
    cfg = compose("train", ["preset=tiny", "experiment=stage2", "output_dir=x"])
    assert (cfg.preset, cfg.stage.name, cfg.output_dir) == ("tiny", "stage2", "x")


@pytest.mark.parametrize(
    ("name", "typed", "meant"),
    [
        ("predict", ["a/b.mp4", "device=cpu"], ['scene="a/b.mp4"', "device=cpu"]),
        ("view", ["--cfg", "job", "x y"], ["--cfg", "job", 'folder="x y"']),
        ("view", ["folder=z", "--help"], ["folder=z", "--help"]),
        ("prepare", ["mine"], ['check="mine"']),
        ("evaluate", ["run/last.ckpt"], ['checkpoint="run/last.ckpt"']),
        ("evaluate", ["default"], ['checkpoint="default"']),
        ("evaluate", ["theirs", "annotations=a.json"], ['predictions="theirs"', "annotations=a.json"]),
        ("export_model", ["last.ckpt"], ['checkpoint="last.ckpt"']),
        ("train", ["walk.mp4"], ["walk.mp4"]),
    ],
)
def test_a_path_without_a_key_gets_one(name, typed, meant):
    assert with_keys(name, typed) == meant


@pytest.mark.parametrize("words", [["a", "b"], ["a", "scene=b"], ["scene=b", "a"]])
def test_two_paths_without_a_key_are_not_guessed(words):
    with pytest.raises(
        ConfigError, match="is a path without a name, and scene= is there already: name it, as in output="
    ):
        with_keys("predict", words)


@pytest.mark.parametrize(
    ("name", "typed", "said"),
    [
        ("predict", [], "predict needs scene=, for example: "),
        ("predict", ["x", "num_views=many"], "num_views=many is no number: give one, or leave it out"),
        ("predict", ["x", "viewer=maybe"], "viewer=maybe is neither true nor false"),
        ("predict", ["nowhere.mp4"], "there is no scene "),
        ("view", [], "view needs folder=, for example: "),
    ],
)
def test_what_is_missing_or_of_another_kind_names_its_setting(name, typed, said, tmp_path, command):
    done = command(name, *typed, folder=tmp_path)
    assert done.returncode == 1
    (sentence,) = done.stderr.splitlines()
    assert sentence.startswith(f"raytran: {said}")
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]


def test_a_refused_run_leaves_what_was_there(tmp_path, command):
    (tmp_path / "run" / "checkpoints").mkdir(parents=True)
    (tmp_path / "run" / "checkpoints" / "last.ckpt").write_bytes(b"mine")
    (tmp_path / "outputs" / "else").mkdir(parents=True)
    for words in (["output_dir=run"], ["precision=fp16"]):
        done = command("train", "preset=tiny", *words, folder=tmp_path)
        assert done.returncode == 1
    assert (tmp_path / "run" / "checkpoints" / "last.ckpt").read_bytes() == b"mine"
    assert sorted(path.name for path in (tmp_path / "outputs").iterdir()) == ["else"]


def test_a_run_that_another_process_trains_in_is_left_alone(tmp_path):
    (tmp_path / "runs" / "a").mkdir(parents=True)
    (tmp_path / "runs" / "a" / "train.log").touch()
    with one_at_a_time(tmp_path / "runs" / "a"):
        subprocess.run(
            [sys.executable, "-c", REMOVE, str(tmp_path / "runs" / "a"), str(tmp_path / "runs")], check=True
        )
        assert (tmp_path / "runs" / "a" / "train.log").exists()
    remove_refused_run(tmp_path / "runs" / "a", outputs=tmp_path / "runs")
    assert not (tmp_path / "runs").exists()


REMOVE = """
import sys
from pathlib import Path
from raytran.run.refused_run import remove_refused_run
remove_refused_run(Path(sys.argv[1]), outputs=Path(sys.argv[2]))
"""


@pytest.mark.parametrize(
    ("typed", "meant"),
    [
        ("up=0.1,0.2,0.97", "up=[0.1,0.2,0.97]"),
        ("up=-1e-3, +2, .5", "up=[-1e-3, +2, .5]"),
        ("intrinsics=500,501.5,320,240", "intrinsics=[500,501.5,320,240]"),
        *(
            (same, same)
            for same in ("up=+y", "up=-z,+y", "up=[0,0,1]", "up=auto", "num_views=4,8", "seed=1,2")
        ),
    ],
)
def test_numbers_that_are_one_value_are_no_sweep(typed, meant):
    assert with_number_lists(["scene=a,b", typed]) == ["scene=a,b", meant]


def test_a_direction_as_typed_reaches_the_command():
    cfg = compose("predict", ["scene=a", "output=b", *with_number_lists(["up=0.1,-0.2,+1"])])
    assert list(cfg.up) == [0.1, -0.2, 1]


@pytest.mark.parametrize(
    ("typed", "expected"),
    [({}, "10000"), ({"GOMP_SPINCOUNT": "7"}, "7"), ({"OMP_WAIT_POLICY": "active"}, "None")],
)
def test_threads_of_a_command_do_not_spin_long_unless_they_are_told_to(typed, expected):
    """OpenMP reads it when torch is imported, which no command may do before."""
    code = "import os, sys, raytran.predict; print(os.environ.get('GOMP_SPINCOUNT'), 'torch' in sys.modules)"
    kept = {k: v for k, v in os.environ.items() if k not in ("GOMP_SPINCOUNT", "OMP_WAIT_POLICY")}
    said = subprocess.run([sys.executable, "-c", code], env=kept | typed, capture_output=True, text=True)
    assert said.stdout.split() == [expected, "False"], said.stderr
