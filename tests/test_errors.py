# SPDX-License-Identifier: Apache-2.0
"""A message is one printable line of at most 300 characters, whatever was put into it."""

from __future__ import annotations

import ast
import pickle
import re

import pytest

from raytran.errors import LONGEST, CheckpointError, DataError, RaytranError, ShapeError, one_line, page
from raytran.run.entry import _exit_with

LONGEST_LITERAL = 200
"""Characters of a message beside the values in it, which need room too."""

ERRORS = ("ConfigError", "DataError", "CheckpointError", "RaytranError", "NonFiniteError", "ShapeError")


@pytest.mark.parametrize(
    "value",
    [
        *(
            "9" * 70_000,
            "a b " * 20_000,
            "x" * 10**7,
            "a\nb\r\nc",
            "\x1b[31mred\x1b[0m",
            "\ud800",
            "\u202eevil",
            "\0",
        ),
        *("/very" * 60 + "/long/name.json", "\u2028" * 500, "\U0010ffff" * 299),
    ],
    ids=lambda value: ascii(value)[:20],
)
def test_any_value_leaves_one_line_with_the_reason_and_the_remedy(value, capsys):
    error = DataError(f"bad number {value} in line 3: export the file again")
    said = str(error)
    assert len(said) <= LONGEST
    assert said.isprintable()
    assert said.startswith("bad number ")
    assert said.endswith("export the file again")
    said.encode("utf-8")
    with pytest.raises(SystemExit):
        _exit_with(error)
    assert capsys.readouterr().err == f"raytran: {said}\n"


def test_what_fits_is_left_alone():
    sentence = f"no file at {'/a' * 70}: give another – “ü”, 部屋"
    assert str(CheckpointError(sentence)) == sentence
    assert one_line("x" * LONGEST) == "x" * LONGEST


def test_of_two_long_paths_both_keep_their_ends():
    first, second = f"/data/{'a' * 400}/one.json", f"/data/{'b' * 200}/two.json"
    said = str(DataError(f"{first} and {second} both hold scene 7: delete one of them"))
    assert len(said) <= LONGEST
    assert re.fullmatch(
        r"/data/a+…a+/one\.json and /data/b+(…b+)?/two\.json both hold scene 7: delete one of them", said
    )


@pytest.mark.parametrize("kind", [RaytranError, ShapeError])
def test_what_was_given_is_kept(kind):
    error = pickle.loads(pickle.dumps(kind("a" * 500)))
    assert error.args == ("a" * 500,)
    assert len(str(error)) == LONGEST


def test_an_error_without_words():
    assert str(RaytranError()) == ""


def raised_errors(project_root):
    """Yield place, literal parts and number of values of each message in the sources."""
    for path in sorted((project_root / "src" / "raytran").rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            named = isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in ERRORS
            if named and node.args:
                parts = [part.value for part in ast.walk(node.args[0]) if isinstance(part, ast.Constant)]
                yield f"{path}:{node.lineno}", [part for part in parts if isinstance(part, str)]


def test_messages_leave_room_for_the_values_in_them(project_root):
    found = list(raised_errors(project_root))
    assert len(found) > 300
    for where, parts in found:
        length = sum(map(len, parts))
        assert length <= LONGEST_LITERAL, f"{where}: {length} characters beside its values, shorten it"
        assert not re.search(r"\n|\.\s+[A-Z][a-z]", "{}".join(parts)), f"{where}: more than one sentence"


def test_a_page_lies_in_the_package_or_in_the_clone(tmp_path, project_root):
    assert page("own-data.md") == str(project_root / "docs" / "own-data.md")
    package = tmp_path / "site" / "packages" / "raytran"
    assert page("own-data.md", package) == "docs/own-data.md"
    (package / "docs").mkdir(parents=True)
    (package / "docs" / "own-data.md").touch()
    assert page("own-data.md", package) == str(package / "docs" / "own-data.md")
    assert page(".", package) == str(package / "docs")


def test_pages_that_messages_name_are_there(project_root):
    """Without a clone ``docs/x.md`` is no path: messages say where the page lies, by ``page``."""
    named = 0
    for path in sorted((project_root / "src" / "raytran").rglob("*.py")):
        tree = ast.parse(path.read_text())
        documented = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
        for node in ast.walk(tree):
            if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "page":
                named += 1
                assert (project_root / "docs" / node.args[0].value).exists(), f"{path}:{node.lineno}"
            is_text = isinstance(node, ast.Constant) and isinstance(node.value, str)
            if is_text and id(node) not in documented:
                bare = re.search(r"(?<![/.])\bdocs/[\w/-]+\.md", node.value)
                assert bare is None, f"{path}:{node.lineno}: name it by raytran.errors.page"
    assert named > 3
