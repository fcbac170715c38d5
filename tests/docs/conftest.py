# SPDX-License-Identifier: Apache-2.0
"""The pages that people read."""

from __future__ import annotations

import json

import pytest


def text_of(path):
    """Return the text of a page; of a notebook that of its cells."""
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".ipynb":
        return "\n\n".join("".join(cell["source"]) for cell in json.loads(text)["cells"])
    return text


@pytest.fixture(scope="session")
def pages(project_root):
    """Text of each page by its path: those at the top, in docs, beside benchmarks, notebooks and sources."""
    found = [
        *project_root.glob("*.md"),
        *(project_root / "docs").rglob("*.md"),
        *(project_root / "notebooks").glob("*.ipynb"),
        *(
            path
            for folder in ("benchmarks", "notebooks", "src")
            for path in (project_root / folder).rglob("*.md")
        ),
    ]
    return {path: text_of(path) for path in sorted(found)}
