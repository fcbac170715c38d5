# SPDX-License-Identifier: Apache-2.0
"""Results appear whole or not at all, and nothing foreign is deleted."""

from __future__ import annotations

import pytest

from raytran.errors import ConfigError
from raytran.run.output import replaced_folder


def fill(folder, text: str) -> None:
    with replaced_folder(folder, marker="scene.json") as fresh:
        (fresh / "scene.json").write_text(text)
        assert not folder.exists() or (folder / "scene.json").read_text() != text


def test_a_result_replaces_the_earlier_one(tmp_path):
    folder = tmp_path / "deep" / "result"
    fill(folder, "first")
    (folder / "stale.txt").touch()
    fill(folder, "second")
    assert [path.name for path in folder.iterdir()] == ["scene.json"]
    assert (folder / "scene.json").read_text() == "second"
    assert [path.name for path in folder.parent.iterdir()] == ["result"]


def test_a_failure_leaves_what_was_there(tmp_path):
    folder = tmp_path / "result"
    fill(folder, "first")
    with pytest.raises(ZeroDivisionError), replaced_folder(folder, marker="scene.json") as fresh:
        (fresh / "scene.json").write_text(str(1 / 0))
    assert (folder / "scene.json").read_text() == "first"
    assert [path.name for path in tmp_path.iterdir()] == ["result"]


def test_foreign_folders_and_files_are_safe(tmp_path):
    (tmp_path / "thesis.tex").touch()
    for output in (tmp_path, tmp_path / "thesis.tex"):
        with (
            pytest.raises(ConfigError, match="no earlier result"),
            replaced_folder(output, marker="scene.json"),
        ):
            pass
    assert (tmp_path / "thesis.tex").exists()
