# SPDX-License-Identifier: Apache-2.0
"""The command ``raytran``: verbs, what it says of mistyped ones, and what a shell completes."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tomllib

import pytest

from raytran.__main__ import VERBS, listing, main
from raytran.run.config_dir import config_dir


def raytran(*words, folder, **environment):
    return subprocess.run(
        [sys.executable, "-m", "raytran", *words],
        cwd=folder,
        env=os.environ | environment,
        capture_output=True,
        text=True,
        check=False,
    )


def test_every_command_is_a_verb(project_root):
    assert set(VERBS) == {path.stem for path in config_dir().glob("*.yaml")}
    project = tomllib.loads((project_root / "pyproject.toml").read_text())["project"]
    assert project["scripts"] == {"raytran": "raytran.__main__:main"}


@pytest.mark.parametrize("words", [[], ["--help"], ["-h"]])
def test_alone_it_lists_the_verbs(capsys, words):
    main(words)
    said = capsys.readouterr().out
    assert said == listing()
    for verb, purpose in VERBS.items():
        assert re.search(rf"^  {verb} +{re.escape(purpose)}$", said, re.MULTILINE)
    assert max(map(len, said.splitlines())) <= 110


def test_the_list_loads_neither_torch_nor_hydra(tmp_path):
    code = (
        "import sys; from raytran.__main__ import main; main([]);"
        "print([name for name in ('torch', 'hydra', 'omegaconf', 'numpy') if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True)
    assert done.stdout.endswith("\n[]\n"), done.stderr


@pytest.mark.parametrize(
    ("word", "said"),
    [
        ("evalute", "there is no verb evalute: is evaluate meant?"),
        ("eval", "is evaluate meant?"),
        ("export", "is export_model meant?"),
        ("test", "there is no verb test: is evaluate meant?"),
        ("xyzzy", "there is no verb xyzzy: raytran alone lists the verbs"),
        ("preset=tiny", "a verb comes first, as in raytran train preset=tiny"),
        (".", ". is a path and no verb: is raytran predict . meant?"),
    ],
)
def test_a_wrong_verb_is_one_sentence(capsys, word, said):
    with pytest.raises(SystemExit) as stop:
        main([word])
    assert stop.value.code == 1
    (sentence,) = capsys.readouterr().err.splitlines()
    assert sentence.startswith("raytran: ")
    assert said in sentence


def test_a_verb_is_its_command(tmp_path):
    done = raytran("demo", "--cfg", "job", "validate_every=7", folder=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "validate_every: 7" in done.stdout


@pytest.mark.parametrize(
    ("line", "answer"),
    [
        ("raytran ", set(VERBS)),
        ("raytran pre", {"predict", "prepare"}),
        ("raytran demo pres", {"preset="}),
        ("raytran demo preset=", {f"preset={name}" for name in ("laptop", "raytran", "small", "tiny")}),
        ("raytran plan preset=", {f"preset={name}" for name in ("laptop", "raytran", "small", "tiny")}),
    ],
)
def test_a_shell_completes(tmp_path, line, answer):
    done = raytran("-sc", "query=bash", folder=tmp_path, COMP_LINE=line)
    assert set(done.stdout.split()) == answer, done.stderr


def test_bash_completes_after_the_documented_line(tmp_path):
    """In bash itself, with a program ``raytran`` on its path as pip makes one."""
    (tmp_path / "raytran").write_text(f'#!/bin/sh\nexec {sys.executable} -m raytran "$@"\n')
    (tmp_path / "raytran").chmod(0o755)
    script = (
        'eval "$(raytran -sc install=bash)"; COMP_LINE="raytran predict sce"; COMP_CWORD=2;'
        'hydra_bash_completion; echo "${COMPREPLY[@]}"; complete -p raytran'
    )
    path = f"{tmp_path}:{os.environ['PATH']}"
    done = subprocess.run(
        ["bash", "-c", script], cwd=tmp_path, env=os.environ | {"PATH": path}, capture_output=True, text=True
    )
    assert done.stdout.split()[0] == "scene=", done.stderr
    assert "hydra_bash_completion raytran" in done.stdout


@pytest.mark.parametrize(
    "words", ["-m raytran", "-m raytran.view --help", "-m raytran.view folder=x --cfg job"]
)
def test_a_reader_that_leaves_is_no_error(tmp_path, words):
    """As behind ``| head -1``, here with a reader that has gone before the first line."""
    reading, writing = os.pipe()
    os.close(reading)
    done = subprocess.run(
        [sys.executable, *words.split()], cwd=tmp_path, stdout=writing, stderr=subprocess.PIPE, text=True
    )
    os.close(writing)
    assert (done.returncode, done.stderr) == (0, "")
