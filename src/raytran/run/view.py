# SPDX-License-Identifier: Apache-2.0
"""Show predicted scenes in a browser."""

from __future__ import annotations

import ipaddress
import logging
import os
import sys
import threading
import webbrowser
from pathlib import Path

from omegaconf import DictConfig

from raytran.errors import ConfigError
from raytran.viewer import MISSING, has_viser

_log = logging.getLogger(__name__)


def view(cfg: DictConfig) -> None:
    """Run ``raytran view`` until it is interrupted; see ``conf/view.yaml``.

    Raises:
        DataError: there is no result to show, or it is damaged.
        ConfigError: viser is not installed, or it cannot listen on the address wanted.
    """
    if not has_viser():
        raise ConfigError(MISSING)
    from raytran.viewer.app import ViewerApp
    from raytran.viewer.data import find_scenes
    from raytran.viewer.server import free_port, quiet_server

    scenes, host = find_scenes(Path(cfg.folder)), str(cfg.host)
    port = free_port(host, _port(cfg.port))
    try:
        with quiet_server(host, port) as server:
            ViewerApp(server, scenes)
            count = "1 scene" if len(scenes) == 1 else f"{len(scenes)} scenes"
            url = f"http://{f'[{host}]' if ':' in host else host}:{server.get_port()}/"
            _log.info("%s of %s at %s (Ctrl-C ends it)", count, Path(cfg.folder).resolve(), url)
            if not _is_local(host):
                _log.warning("host=%s: whoever reaches this machine can look at these scenes", host)
            if cfg.open and _has_screen():
                webbrowser.open(url)
            threading.Event().wait()
    except KeyboardInterrupt:
        _log.info("ended")


def _port(value: object) -> int | None:
    if value == "auto":
        return None
    if isinstance(value, int) and not isinstance(value, bool) and 0 <= value < 2**16:
        return value
    raise ConfigError(f"port={value} is no port: give a number from 0 to 65535, or auto")


def _is_local(host: str) -> bool:
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def _has_screen() -> bool:
    """Return whether a browser would open in a window and not take over the terminal."""
    return sys.platform in ("darwin", "win32") or bool(
        os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    )
