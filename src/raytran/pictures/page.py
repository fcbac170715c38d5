# SPDX-License-Identifier: Apache-2.0
"""Self-contained HTML pages: a template, filled, with its pictures inside."""

from __future__ import annotations

import base64
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined

from raytran.data.files import write_text


def write_page(
    path: Path, template: str, *, filters: Mapping[str, Callable[..., str]] | None = None, **content: Any
) -> Path:
    """Fill a template and write the page; it appears whole or not at all.

    Args:
        path: HTML file.
        template: name in ``pictures/templates``.
        filters: further filters of the template.
        content: its variables.

    Returns:
        ``path``.
    """
    environment = Environment(
        loader=PackageLoader("raytran", "pictures/templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters.update(filters or {})
    path.parent.mkdir(parents=True, exist_ok=True)
    write_text(path, environment.get_template(template).render(**content))
    return path


def data_uri(content: bytes, media: str) -> str:
    """Return a picture as an address that holds it, e.g. of media type ``image/png``."""
    return f"data:{media};base64,{base64.b64encode(content).decode()}"
