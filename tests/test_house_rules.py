# SPDX-License-Identifier: Apache-2.0
"""Sizes and habits of the sources that a reader relies on."""

from __future__ import annotations

import ast

MAX_FILE_LINES = 300
MAX_FUNCTION_LINES = 50
MAX_ENTRY_LINES = 60
SAYS_NOTHING = {"utils", "util", "misc", "common", "helpers", "helper"}


def parsed_sources(root):
    for path in sorted((root / "src" / "raytran").rglob("*.py")):
        text = path.read_text()
        yield path, text, ast.parse(text)


def test_files_are_short_and_named(project_root):
    package = project_root / "src" / "raytran"
    for path, text, _ in parsed_sources(project_root):
        lines = text.count("\n")
        is_entry = path.parent == package or path.name == "__main__.py"
        limit = MAX_ENTRY_LINES if is_entry and "def main" in text else MAX_FILE_LINES
        assert lines <= limit, f"{path} has {lines} lines, at most {limit} are allowed"
        assert not SAYS_NOTHING & set(path.with_suffix("").parts), f"{path}: a name that says nothing"


def test_functions_are_short(project_root):
    for path, _, tree in parsed_sources(project_root):
        for node in ast.walk(tree):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                lines = (node.end_lineno or node.lineno) - node.lineno + 1
                assert lines <= MAX_FUNCTION_LINES, f"{path}:{node.lineno} {node.name} has {lines} lines"


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
