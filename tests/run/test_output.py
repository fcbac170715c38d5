# SPDX-License-Identifier: Apache-2.0
"""Results appear whole or not at all, and nothing foreign is deleted."""

from __future__ import annotations

import shutil

import pytest

from raytran.errors import ConfigError, DataError
from raytran.run.output import one_writer, replaced_folder


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


@pytest.mark.parametrize("name", ["result", "x" * 250, "ü ,=(2)"])
def test_a_folder_has_one_writer_and_the_other_is_told_which(tmp_path, name):
    folder = tmp_path / "deep" / name
    with one_writer(folder, marker="scene.json"):
        with pytest.raises(ConfigError) as raised, one_writer(folder, marker="scene.json"):
            pass
        fill(folder, "first")
        with one_writer(folder.with_name("another"), marker="scene.json"):
            pass
    assert raised.value.args[0].startswith(f"another process writes {folder} (number ")
    assert " (number " in str(raised.value)  # that of a long name is cut, not this
    with one_writer(folder, marker="scene.json"):
        pass
    assert [path.name for path in folder.parent.iterdir()] == [name]


def test_a_writer_does_not_begin_over_something_foreign(tmp_path):
    (tmp_path / "thesis.tex").touch()
    with pytest.raises(ConfigError, match="no earlier result"), one_writer(tmp_path, marker="scene.json"):
        pass
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]


def test_of_two_results_at_once_the_last_one_stays_whole(tmp_path):
    folder = tmp_path / "result"
    with replaced_folder(folder, marker="scene.json") as first:
        (first / "scene.json").write_text("first")
        (first / "only_of_the_first").touch()
        fill(folder, "second")
    assert sorted(path.name for path in folder.iterdir()) == ["only_of_the_first", "scene.json"]
    assert [path.name for path in tmp_path.iterdir()] == ["result"]


def test_a_folder_removed_meanwhile_is_one_sentence(tmp_path):
    def write():
        with replaced_folder(tmp_path / "deep" / "result", marker="scene.json") as fresh:
            shutil.rmtree(tmp_path / "deep")
            (fresh / "scene.json").write_text("")

    with pytest.raises(DataError, match="deep was removed while result was written"):
        write()


def test_what_ends_before_it_has_written_leaves_no_folder(tmp_path):
    (tmp_path / "kept").mkdir()
    for place in (tmp_path / "kept" / "a" / "b", tmp_path / "outputs" / "evaluations" / "now"):
        with pytest.raises(ConfigError), one_writer(place, marker="metrics.json"):
            raise ConfigError("there are no rooms")
    assert [path.name for path in tmp_path.iterdir()] == ["kept"]
    assert not list((tmp_path / "kept").iterdir())
    with one_writer(tmp_path / "outputs" / "now", marker="metrics.json"):
        (tmp_path / "outputs" / "now").mkdir()
    assert (tmp_path / "outputs" / "now").is_dir()
