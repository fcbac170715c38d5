# SPDX-License-Identifier: Apache-2.0
"""The command from outside: what it says, and how it ends."""

from __future__ import annotations

import signal
import subprocess
import sys
import urllib.request

import pytest
from omegaconf import OmegaConf

from raytran.errors import ConfigError, DataError
from raytran.run.view import view


@pytest.fixture
def results(tmp_path):
    for name in ("hall", "room"):
        (tmp_path / "results" / name).mkdir(parents=True)
        (tmp_path / "results" / name / "scene.json").write_text("{}")
    return tmp_path / "results"


@pytest.fixture
def interruptible():
    """Children of a shell's background job ignore Ctrl-C, and so would theirs: this one's do not."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def start(*arguments, folder):
    command = [sys.executable, "-m", "raytran.view", *arguments]
    return subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def test_it_shows_until_it_is_interrupted_and_never_needs_torch(results, interruptible):
    command = start(".", "port=0", "open=false", folder=results)
    line = command.stdout.readline()
    assert "2 scenes of" in line
    (address,) = [word for word in line.split() if word.startswith("http://127.0.0.1:")]
    with urllib.request.urlopen(f"{address}scenes.json", timeout=5) as answer:
        assert answer.read() == b'["hall", "room"]'
    with open(f"/proc/{command.pid}/maps") as file:
        assert "libtorch" not in file.read()
    command.send_signal(signal.SIGINT)
    said, complaint = command.communicate(timeout=60)
    assert (command.returncode, said, complaint) == (0, "ended\n", "")
    assert {path.name for path in results.iterdir()} == {"hall", "room"}


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"folder": "nowhere"}, DataError, "no folder nowhere"),
        ({"port": "http"}, ConfigError, "port=http is no port"),
        ({"port": 70000}, ConfigError, "port=70000 is no port"),
        ({"port": True}, ConfigError, "port=True is no port"),
        ({"host": "no.such.host.example"}, ConfigError, "cannot listen on host=no.such.host.example"),
    ],
)
def test_mistakes_are_one_sentence(results, changes, error, message):
    settings = {"folder": str(results), "port": 0, "host": "127.0.0.1", "open": False}
    with pytest.raises(error, match=message):
        view(OmegaConf.create(settings | changes))
