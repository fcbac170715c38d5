# SPDX-License-Identifier: Apache-2.0
"""Habits of the sources that a reader relies on."""

from __future__ import annotations

import ast

SAYS_NOTHING = {"utils", "util", "misc", "common", "helpers", "helper"}


def parsed_sources(root):
    for path in sorted((root / "src" / "raytran").rglob("*.py")):
        text = path.read_text()
        yield path, text, ast.parse(text)


def test_every_file_has_a_name_that_says_something(project_root):
    for path, _, _ in parsed_sources(project_root):
        assert not SAYS_NOTHING & set(path.with_suffix("").parts), f"{path}: a name that says nothing"


def test_no_assert_and_no_print(project_root):
    for path, _, tree in parsed_sources(project_root):
        for node in ast.walk(tree):
            where = f"{path}:{getattr(node, 'lineno', 0)}"
            assert not isinstance(node, ast.Assert), f"{where}: raise an error of raytran.errors instead"
            is_print = (
                isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "print"
            )
            assert not is_print, f"{where}: use logging or rich instead of print"


def test_every_file_names_its_licence(project_root):
    for folder in ("src", "tests", "benchmarks"):
        for path in (project_root / folder).rglob("*.py"):
            assert path.read_text().startswith("# SPDX-License-Identifier: Apache-2.0\n"), path


def test_files_reach_pillow_in_one_place(project_root):
    """``open_image`` looks at a file's first bytes; Pillow alone would start Ghostscript for some."""
    for path, _, tree in parsed_sources(project_root):
        opens = [
            node.lineno
            for node in ast.walk(tree)
            if isinstance(node, ast.Attribute) and node.attr in ("open", "imread") and _is_pillow(node.value)
        ]
        if path.parts[-2:] != ("data", "images.py"):
            assert not opens, f"{path}:{opens}: open images by raytran.data.images.open_image"


def _is_pillow(node):
    return isinstance(node, ast.Name) and node.id in ("Image", "imageio", "cv2")
