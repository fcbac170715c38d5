# SPDX-License-Identifier: Apache-2.0
"""The viewer: predicted scenes in the browser, in a notebook, and as one file to send away (viser)."""

from __future__ import annotations

import importlib.util
from pathlib import Path

from raytran.errors import ConfigError

HTML = "prediction.html"
"""A scene as one file, in the folder of its result."""

MISSING = "the viewer is viser, which is not installed: pip install 'raytran[viewer]'"


def has_viser() -> bool:
    """Return whether the package that draws is installed."""
    return importlib.util.find_spec("viser") is not None


def show(folder: str | Path, *, height: int = 600) -> None:
    """Show a result of ``raytran.predict`` in a notebook; elsewhere in a new page of the browser.

    Args:
        folder: the result.
        height: of the picture in the notebook, pixels.

    Raises:
        ConfigError: viser is not installed.
        DataError: the folder holds no result, or a damaged one.
    """
    if not has_viser():
        raise ConfigError(MISSING)
    from raytran.viewer.server import show_scene

    show_scene(Path(folder), height)
