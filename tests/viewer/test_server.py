# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import http.client
import json
import socket
import urllib.request

import pytest

from raytran.errors import ConfigError
from raytran.viewer import server as module
from raytran.viewer.scenes import find_scenes
from raytran.viewer.server import Viewer


@pytest.fixture(scope="module")
def served(result, serve):
    (result.parent / "outside.txt").write_text("outside")
    with serve(result) as server:
        yield server


def ask(server, path, method="GET", **headers):
    """Send exactly this path, as no browser would."""
    connection = http.client.HTTPConnection("127.0.0.1", server.server_port, timeout=5)
    connection.putrequest(method, path, skip_host="Host" in headers)
    for name, value in headers.items():
        connection.putheader(name, value)
    connection.endheaders()
    response = connection.getresponse()
    content = response.read()
    connection.close()
    return response, content


def test_the_page_and_its_scene(served, result):
    page, content = ask(served, "/")
    assert page.status == 200
    assert page.getheader("Content-Type") == "text/html; charset=utf-8"
    assert b"<canvas" in content
    assert json.loads(ask(served, "/scenes.json")[1]) == ["room"]
    for name in ("scene.json", "scene.glb", "view/view.json", "view/frames/0000.jpg"):
        assert ask(served, f"/scenes/0/{name}")[1] == (result / name).read_bytes(), name
    assert ask(served, "/scenes/0/view/frames/0000.jpg?again")[0].getheader("Content-Type") == "image/jpeg"
    packed, _ = ask(served, "/vendor/three.js")
    assert packed.getheader("Content-Encoding") == "gzip"
    assert packed.getheader("Content-Type") == "text/javascript; charset=utf-8"


def test_a_page_may_load_from_here_alone(served):
    for path in ("/", "/scenes/0/scene.json", "/nothing"):
        policy = ask(served, path)[0].getheader("Content-Security-Policy")
        assert policy.startswith("default-src 'self';")
        assert "http" not in policy


@pytest.mark.parametrize(
    "path",
    [
        *("/outside.txt", "/../outside.txt", "/scenes/0/../../outside.txt", "/scenes/0/%2e%2e/outside.txt"),
        *(
            "/scenes/0/view/..%2f..%2foutside.txt",
            "/scenes/0/view/%5c..%5coutside.txt",
            "/scenes/0//etc/passwd",
        ),
        *(
            "//etc/passwd",
            "/%2fetc%2fpasswd",
            "/scenes/0/view/%00",
            "/scenes/1/scene.json",
            "/scenes/-1/scene.json",
        ),
        *("/scenes/0/meshes/00.ply", "/scenes/", "/scenes/0", "/scenes/%D9%A0/scene.json"),
        *(
            "/scenes/99999999999999999999/scene.json",
            "/server.py",
            "/../server.py",
            "/vendor/three.js.gz",
            "//[zz",
        ),
    ],
)
def test_nothing_else_is_given_away(served, path):
    response, content = ask(served, path)
    assert response.status == 404
    assert content == b""


def test_it_only_reads(served, result):
    before = (result / "scene.json").read_bytes()
    for method in ("POST", "PUT", "DELETE", "OPTIONS"):
        assert ask(served, "/scenes/0/scene.json", method)[0].status == 501
    head, content = ask(served, "/scenes/0/scene.json", "HEAD")
    assert (head.status, int(head.getheader("Content-Length")), content) == (200, len(before), b"")
    assert (result / "scene.json").read_bytes() == before


def test_only_names_of_this_machine_are_answered(served):
    for host in ("127.0.0.1", "localhost:80", "[::1]:9"):
        assert ask(served, "/", Host=host)[0].status == 200, host
    for host in ("elsewhere.example", "127.0.0.1.example", "", "10.0.0.1", "[zz]"):
        assert ask(served, "/", Host=host)[0].status == 403, host


def test_who_listens_to_all_is_asked_by_any_name(result, serve):
    with serve(result, host="0.0.0.0") as server:
        assert not server.only_local
        assert ask(server, "/", Host="elsewhere.example")[0].status == 200


def test_it_listens_to_this_machine_alone(served):
    assert served.server_address[0] == "127.0.0.1"
    assert served.only_local
    assert served.url == f"http://127.0.0.1:{served.server_port}/"


@pytest.mark.skipif(not socket.has_dualstack_ipv6(), reason="this machine has no IPv6")
def test_it_listens_to_this_machine_by_its_newer_address(result, serve):
    with serve(result, host="::1") as server:
        assert server.only_local
        assert server.url == f"http://[::1]:{server.server_port}/"
        with urllib.request.urlopen(server.url) as answer:
            assert answer.status == 200


def test_ports(result, monkeypatch):
    scenes = find_scenes(result)
    with socket.create_server(("127.0.0.1", 0)) as taken:
        number = taken.getsockname()[1]
        with pytest.raises(ConfigError, match=rf"port={number} .*choose another port="):
            Viewer(scenes, port=number)
        monkeypatch.setattr(module, "FIRST_PORT", number)
        with Viewer(scenes) as server:
            assert number < server.server_port < number + 20
    with pytest.raises(ConfigError, match=r"host=256\.1\.1\.1"):
        Viewer(scenes, host="256.1.1.1", port=0)
