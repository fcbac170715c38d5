# SPDX-License-Identifier: Apache-2.0
"""Show predicted scenes in a browser."""

from __future__ import annotations

import logging
import os
import sys
import webbrowser
from pathlib import Path

from omegaconf import DictConfig

from raytran.errors import ConfigError
from raytran.viewer.scenes import find_scenes
from raytran.viewer.server import Viewer

_log = logging.getLogger(__name__)


def view(cfg: DictConfig) -> None:
    """Run ``python -m raytran.view`` until it is interrupted; see ``conf/view.yaml``.

    Raises:
        DataError: there is no result to show.
        ConfigError: it cannot listen on the address wanted.
    """
    scenes = find_scenes(Path(cfg.folder))
    with Viewer(scenes, host=str(cfg.host), port=_port(cfg.port)) as server:
        count = "1 scene" if len(scenes) == 1 else f"{len(scenes)} scenes"
        _log.info("%s of %s at %s (Ctrl-C ends it)", count, Path(cfg.folder).resolve(), server.url)
        if not server.only_local:
            _log.warning("host=%s: whoever reaches this machine can look at these scenes", cfg.host)
        if cfg.open and _has_screen():
            webbrowser.open(server.url)
        try:
            server.serve_forever()
        except KeyboardInterrupt:
            _log.info("ended")


def _port(value: object) -> int | None:
    if value == "auto":
        return None
    if isinstance(value, int) and not isinstance(value, bool) and 0 <= value < 2**16:
        return value
    raise ConfigError(f"port={value} is no port: give a number from 0 to 65535, or auto")


def _has_screen() -> bool:
    """Return whether a browser would open in a window and not take over the terminal."""
    return sys.platform in ("darwin", "win32") or bool(
        os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    )
