# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json
import signal
import subprocess
import sys
import urllib.request

import pytest
from omegaconf import OmegaConf

from raytran.errors import ConfigError, DataError
from raytran.run import view as module
from raytran.run.view import view


@pytest.fixture
def results(tmp_path):
    for name in ("hall", "room"):
        (tmp_path / "results" / name).mkdir(parents=True)
        content = {"format": "raytran.scene/1", "scene_id": name, "objects": []}
        (tmp_path / "results" / name / "scene.json").write_text(json.dumps(content))
    return tmp_path / "results"


@pytest.fixture
def interruptible():
    """Children of a shell's background job ignore Ctrl-C, and so would theirs: this one's do not."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def test_it_shows_until_it_is_interrupted(results, interruptible):
    pytest.importorskip("viser", reason="needs viser (pip install 'raytran[viewer]')")
    command = [sys.executable, "-m", "raytran.view", ".", "port=0", "open=false"]
    process = subprocess.Popen(
        command, cwd=results, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    line = process.stdout.readline()
    assert "2 scenes of" in line
    (address,) = [word for word in line.split() if word.startswith("http://127.0.0.1:")]
    with urllib.request.urlopen(address, timeout=20) as answer:
        assert b"<title>Viser</title>" in answer.read()
    process.send_signal(signal.SIGINT)
    said, complaint = process.communicate(timeout=60)
    assert (process.returncode, said, complaint) == (0, "ended\n", "")
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
    pytest.importorskip("viser", reason="needs viser (pip install 'raytran[viewer]')")
    settings = {"folder": str(results), "port": 0, "host": "127.0.0.1", "open": False}
    with pytest.raises(error, match=message):
        view(OmegaConf.create(settings | changes))


def test_a_missing_package_is_one_sentence(results, monkeypatch):
    monkeypatch.setattr(module, "has_viser", lambda: False)
    settings = {"folder": str(results), "port": 0, "host": "127.0.0.1", "open": False}
    with pytest.raises(ConfigError, match=r"viser, which is not installed: pip install 'raytran\[viewer\]'$"):
        view(OmegaConf.create(settings))
