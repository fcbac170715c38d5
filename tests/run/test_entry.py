# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import os
import subprocess
import sys

import pytest
from hydra.errors import InstantiationException
from omegaconf import OmegaConf

from raytran.errors import DataError
from raytran.run.entry import compose, name_positional, run_or_exit


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


def test_a_defect_keeps_its_traceback():
    with pytest.raises(ZeroDivisionError):
        run_or_exit(lambda cfg: 1 / 0, OmegaConf.create())


@pytest.mark.parametrize(
    ("typed", "said"),
    [
        ("learning_speed=3", "learning_speed"),
        ("model=tinny", "model/tinny"),
        ("seed", "key=value"),
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
    assert f"python -m raytran.{name}" in done.stdout
    assert "preset" in done.stdout


def test_compose_is_what_the_command_line_would_compose():
    cfg = compose("train", ["preset=tiny", "experiment=stage2", "output_dir=x"])
    assert (cfg.preset, cfg.stage.name, cfg.output_dir) == ("tiny", "stage2", "x")


@pytest.mark.parametrize(
    ("typed", "meant"),
    [
        (["a/b.pt", "device=cpu"], ['file="a/b.pt"', "device=cpu"]),
        (["--cfg", "job", "x y"], ["--cfg", "job", 'file="x y"']),
        (["file=z.pt", "--help"], ["file=z.pt", "--help"]),
    ],
)
def test_words_without_a_key_get_one(typed, meant):
    assert name_positional(typed, "file") == meant


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
