# SPDX-License-Identifier: Apache-2.0
"""A small web server that gives a browser the viewer's page and the scenes it shows, and nothing else.

It only reads. By default it listens to this machine alone, and then answers only to a name of this machine,
so that no page from elsewhere can reach it by a name that it made point here.
"""

from __future__ import annotations

import ipaddress
import json
import logging
import os
import shutil
import socket
import socketserver
from collections.abc import Mapping
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import unquote, urlsplit

from raytran.errors import ConfigError
from raytran.viewer.scenes import shown_file

_log = logging.getLogger(__name__)

FIRST_PORT = 8765
_PORTS_TRIED = 20

_PAGE = Path(__file__).parent / "page"
_MEDIA = {
    ".html": "text/html; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".json": "application/json",
    ".glb": "model/gltf-binary",
    ".jpg": "image/jpeg",
}
_HEADERS = {
    "Content-Security-Policy": "default-src 'self'; img-src 'self' blob: data:; connect-src 'self' blob:",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-cache",
}
_PACKED = ".gz"
"""Ending of the page's parts that are stored compressed; the browser unpacks them."""


class Viewer(ThreadingHTTPServer):
    """Serves the page and some scenes.

    Args:
        scenes: folder of each result by the name to call it (``find_scenes``).
        host: address to listen on.
        port: number, 0 for any that is free, or None for 8765 or the next one that is free.

    Raises:
        ConfigError: it cannot listen there.
    """

    daemon_threads = True
    allow_reuse_address = True

    def __init__(
        self, scenes: Mapping[str, Path], *, host: str = "127.0.0.1", port: int | None = None
    ) -> None:
        self.names = tuple(scenes)
        self.folders = tuple(scenes.values())
        self.parts = _page_parts()
        self._bind(host, port)

    def server_bind(self) -> None:
        """Take the address, without the look-up of its name in which some networks lose seconds."""
        socketserver.TCPServer.server_bind(self)
        self.server_name, self.server_port = str(self.server_address[0]), int(self.server_address[1])

    def _bind(self, host: str, port: int | None) -> None:
        self.address_family = socket.AF_INET6 if ":" in host else socket.AF_INET
        tried = range(FIRST_PORT, FIRST_PORT + _PORTS_TRIED) if port is None else (port,)
        for number in tried:
            try:
                super().__init__((host, number), _Handler)
            except (OSError, OverflowError) as error:
                failure = error
                continue
            self.only_local = ipaddress.ip_address(self.server_name).is_loopback
            return
        which = f"port={port}" if port is not None else f"ports {tried[0]} to {tried[-1]}"
        raise ConfigError(
            f"cannot listen on host={host}, {which} ({failure}): choose another port=, 0 for any that is free"
        ) from failure

    @property
    def url(self) -> str:
        """Where to point a browser."""
        name = f"[{self.server_name}]" if ":" in self.server_name else self.server_name
        return f"http://{name}:{self.server_port}/"


class _Handler(BaseHTTPRequestHandler):
    server: Viewer
    protocol_version = "HTTP/1.1"
    timeout = 60

    def do_GET(self) -> None:
        self._answer(with_content=True)

    def do_HEAD(self) -> None:
        self._answer(with_content=False)

    def log_message(self, format: str, *args: object) -> None:
        _log.debug("%s %s", self.address_string(), format % args)

    def version_string(self) -> str:
        return "raytran"

    def _answer(self, *, with_content: bool) -> None:
        if self.server.only_local and not _is_local(self.headers.get("Host", "")):
            self._refuse(HTTPStatus.FORBIDDEN)
            return
        name = unquote(self.path.partition("?")[0]).removeprefix("/") or "index.html"
        try:
            if name in self.server.parts:
                content, packed = self.server.parts[name]
                self._start(len(content), name, packed=packed)
                if with_content:
                    self.wfile.write(content)
            elif name == "scenes.json":
                content = json.dumps(self.server.names).encode()
                self._start(len(content), name)
                if with_content:
                    self.wfile.write(content)
            else:
                self._send_file(name, with_content=with_content)
        except (BrokenPipeError, ConnectionResetError):
            self.close_connection = True  # the page was closed while it loaded

    def _send_file(self, name: str, *, with_content: bool) -> None:
        """Answer with ``scenes/<number>/<file>``."""
        kind, _, rest = name.partition("/")
        number, _, wanted = rest.partition("/")
        known = kind == "scenes" and number.isascii() and number.isdigit()
        path = None
        if known and int(number[:9]) < len(self.server.folders):
            path = shown_file(self.server.folders[int(number[:9])], wanted)
        if path is None:
            self._refuse(HTTPStatus.NOT_FOUND)
            return
        with path.open("rb") as file:
            self._start(os.fstat(file.fileno()).st_size, wanted)
            if with_content:
                shutil.copyfileobj(file, self.wfile)

    def _start(self, length: int, name: str, *, packed: bool = False) -> None:
        self.send_response(HTTPStatus.OK)
        self.send_header("Content-Type", _MEDIA.get(Path(name).suffix, "application/octet-stream"))
        self.send_header("Content-Length", str(length))
        if packed:
            self.send_header("Content-Encoding", "gzip")
        self._finish_headers()

    def _refuse(self, status: HTTPStatus) -> None:
        self.send_response(status)
        self.send_header("Content-Length", "0")
        self._finish_headers()

    def _finish_headers(self) -> None:
        for name, value in _HEADERS.items():
            self.send_header(name, value)
        self.end_headers()


def _page_parts() -> dict[str, tuple[bytes, bool]]:
    """Return the files of the page by name, each with whether it is compressed."""
    parts = {}
    for path in sorted(_PAGE.rglob("*")):
        if path.suffix in (*_MEDIA, _PACKED):
            name = path.relative_to(_PAGE).as_posix()
            parts[name.removesuffix(_PACKED)] = (path.read_bytes(), path.suffix == _PACKED)
    return parts


def _is_local(host: str) -> bool:
    """Return whether a request's ``Host`` names this machine as its own user would."""
    try:
        name = urlsplit(f"//{host}").hostname or ""
        return name == "localhost" or ipaddress.ip_address(name).is_loopback
    except ValueError:
        return False
