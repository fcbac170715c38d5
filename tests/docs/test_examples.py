# SPDX-License-Identifier: Apache-2.0
"""Examples in the pages give what they say; those that only show a use name things that are there."""

from __future__ import annotations

import ast
import doctest
import importlib
import re
from pathlib import Path

import pytest

DOCS = Path(__file__).resolve().parents[2] / "docs"
PAGES = [path for path in sorted(DOCS.rglob("*.md")) if ">>> " in path.read_text(encoding="utf-8")]


@pytest.mark.parametrize("page", PAGES, ids=lambda path: str(path.relative_to(DOCS)))
def test_examples(page):
    done = doctest.testfile(str(page), module_relative=False, encoding="utf-8", optionflags=doctest.ELLIPSIS)
    assert done.attempted
    assert not done.failed


def test_code_that_is_shown_names_things_that_are_there(pages):
    blocks = {
        (page, block)
        for page, text in pages.items()
        if page.suffix == ".md"
        for block in re.findall(r"^```python\n(.*?)^```", text, flags=re.MULTILINE | re.DOTALL)
        if ">>> " not in block
    }
    assert blocks
    for page, block in blocks:
        for node in ast.walk(ast.parse(block, filename=str(page))):
            if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "raytran":
                module = importlib.import_module(node.module)
                missing = [alias.name for alias in node.names if not hasattr(module, alias.name)]
                assert not missing, f"{page}: {node.module} has no {missing[0]}"


def test_names_in_the_text_are_there(pages):
    """``raytran.ops.traverse.trace_pairs`` and its like, wherever a page mentions them."""
    named = {
        (page.name, name)
        for page, text in pages.items()
        for name in re.findall(r"`(raytran(?:\.[A-Za-z_]\w*)+)(?:\([^`]*\))?`", text)
    }
    assert len(named) > 10
    wrong = [f"{page}: {name}" for page, name in sorted(named) if not exists(name)]
    assert not wrong, wrong
    assert exists("raytran.ops.traverse.trace_pairs")
    assert not exists("raytran.ops.traverse.trace_pears")
    assert not exists("raytran.optics.trace_pairs")


def exists(name):
    parts = name.split(".")
    for length in range(len(parts), 0, -1):
        try:
            found = importlib.import_module(".".join(parts[:length]))
        except ModuleNotFoundError:
            continue
        for attribute in parts[length:]:
            if not hasattr(found, attribute):
                return False
            found = getattr(found, attribute)
        return True
    return False
