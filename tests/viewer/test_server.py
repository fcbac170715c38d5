# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import re
import socket
import urllib.request

import pytest
import rich

import raytran.viewer
from raytran.errors import ConfigError, DataError

from .conftest import write_result

pytest.importorskip("viser", reason="needs viser (pip install 'raytran[viewer]')")
from raytran.viewer.server import free_port, quiet_server, write_html


def test_one_file_holds_the_scene_and_the_program_that_shows_it(tmp_path):
    folder = write_result(tmp_path / "room", size=(480, 640))
    other = write_result(tmp_path / "other", num_objects=1, with_viewer=False)
    path, small = write_html(folder), write_html(other)
    page = path.read_text()
    assert path == folder / "prediction.html"
    assert 700_000 < path.stat().st_size < 1_500_000
    (data,) = re.findall(r'__VISER_EMBED_DATA__="([A-Za-z0-9+/=]+)"', page)
    assert len(data) > path.stat().st_size - small.stat().st_size > 10_000
    # Nothing is loaded from elsewhere; the address of SVG's namespace is a name.
    assert set(re.findall(r"https?://[\w./-]+", page)) <= {"http://www.w3.org/2000/svg"}
    assert not re.findall(r'(?:src|href)="(?!data:)', page)


def test_a_server_is_quiet_in_a_notebook_too(monkeypatch):
    shown = []
    monkeypatch.setattr("rich.jupyter.display", lambda *words, **_: shown.append(words))
    console = rich.get_console()
    monkeypatch.setattr(console, "is_jupyter", True)
    with quiet_server():
        assert not console.quiet
    assert not shown


def test_a_server_is_quiet_and_gives_the_page(capfd):
    with (
        quiet_server() as server,
        urllib.request.urlopen(f"http://127.0.0.1:{server.get_port()}/", timeout=10) as answer,
    ):
        assert b"<title>Viser</title>" in answer.read()
    said = capfd.readouterr()
    assert said.out + said.err == ""


def test_a_port_that_is_taken(monkeypatch):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(ConfigError, match=rf"cannot listen on host=127\.0\.0\.1, port={port} \("):
            free_port("127.0.0.1", port)
        monkeypatch.setattr("raytran.viewer.server.FIRST_PORT", port)
        assert port < free_port("127.0.0.1", None) < port + 20
    assert free_port("127.0.0.1", 0) > 0
    with pytest.raises(ConfigError, match=r"cannot listen on host=no\.such\.host\.example, port=0"):
        free_port("no.such.host.example", 0)


def test_show_is_for_notebooks(result, monkeypatch, tmp_path):
    heights = []
    monkeypatch.setattr("viser.SceneApi.show", lambda _, height: heights.append(height))
    raytran.viewer.show(result, height=333)
    assert heights == [333]
    with pytest.raises(DataError, match="no scene file"):
        raytran.viewer.show(tmp_path)
    monkeypatch.setattr(raytran.viewer, "has_viser", lambda: False)
    with pytest.raises(ConfigError, match=r"not installed: pip install 'raytran\[viewer\]'"):
        raytran.viewer.show(result)
