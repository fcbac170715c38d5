# SPDX-License-Identifier: Apache-2.0
"""viser's server: where it listens, and a scene as one HTML file."""

from __future__ import annotations

import io
import logging
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout
from pathlib import Path

import rich
import viser

from raytran.errors import ConfigError
from raytran.viewer import HTML
from raytran.viewer.data import read_viewer_scene
from raytran.viewer.scene import SceneNodes

FIRST_PORT = 8765
_PORTS_TRIED = 20


@contextmanager
def quiet_server(host: str = "127.0.0.1", port: int = 0) -> Iterator[viser.ViserServer]:
    """Run a server that prints nothing while a block runs.

    Args:
        host: address to listen on.
        port: 0 for any that is free.
    """
    logging.getLogger("websockets.server").setLevel(logging.WARNING)
    before = set(threading.enumerate())
    with _silence():
        server = viser.ViserServer(host=host, port=port, label="raytran", verbose=False)
    loop = [thread for thread in threading.enumerate() if thread.daemon and thread not in before]
    try:
        yield server
    finally:
        with _silence():
            server.stop()
            # viser waits a while for its thread, which on a busy machine says good-bye later.
            for thread in loop:
                thread.join(timeout=30)


@contextmanager
def _silence() -> Iterator[None]:
    """Have viser print nothing; in a notebook rich does not write to the standard output."""
    console = rich.get_console()
    before, console.quiet = console.quiet, True
    try:
        with redirect_stdout(io.StringIO()):
            yield
    finally:
        console.quiet = before


def free_port(host: str, port: int | None) -> int:
    """Return a port to listen on; viser itself would wait for ever at an address that it cannot have.

    Args:
        host: address to listen on.
        port: the one wanted, 0 for any that is free, None for 8765 or the next that is free.

    Raises:
        ConfigError: it cannot listen there.
    """
    tried = range(FIRST_PORT, FIRST_PORT + _PORTS_TRIED) if port is None else (port,)
    for number in tried:
        try:
            family, kind, _, _, address = socket.getaddrinfo(host, number, type=socket.SOCK_STREAM)[0]
            with socket.socket(family, kind) as trial:
                trial.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                trial.bind(address)
                return int(trial.getsockname()[1])
        except OSError as error:
            failure = error
    which = f"port={port}" if port is not None else f"ports {tried[0]} to {tried[-1]}"
    raise ConfigError(
        f"cannot listen on host={host}, {which} ({failure}): choose another port=, 0 for any that is free"
    ) from failure


def write_html(folder: Path) -> Path:
    """Write a result as ``prediction.html``, one file that needs neither a network nor this package.

    Args:
        folder: a result of ``raytran.predict``.

    Returns:
        the file.

    Raises:
        DataError: the result is damaged.
    """
    with quiet_server() as server:
        SceneNodes(server, read_viewer_scene(folder), export=True)
        (folder / HTML).write_text(server.scene.as_html(), encoding="utf-8")
    return folder / HTML


def show_scene(folder: Path, height: int) -> None:
    """See ``raytran.viewer.show``."""
    with quiet_server() as server:
        SceneNodes(server, read_viewer_scene(folder), export=True)
        server.scene.show(height)
