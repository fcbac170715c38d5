# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import errno
import json

import pytest

from raytran.data.atomic import bytes_below, finished_folder, no_room, sweep, write_json, write_text


def names(root):
    return sorted(str(path.relative_to(root)) for path in root.rglob("*"))


def test_text_and_json(tmp_path):
    write_text(tmp_path / "new" / "a.txt", "grün\n")
    assert (tmp_path / "new" / "a.txt").read_text(encoding="utf-8") == "grün\n"
    write_json(tmp_path / "b.json", {"b": 1, "a": [2.5]})
    assert json.loads((tmp_path / "b.json").read_text()) == {"b": 1, "a": [2.5]}
    assert names(tmp_path) == ["b.json", "new", "new/a.txt"]


def test_a_text_that_cannot_be_written_leaves_the_old_one(tmp_path):
    write_text(tmp_path / "a.txt", "old")
    with pytest.raises(UnicodeEncodeError):
        write_text(tmp_path / "a.txt", "\ud800")
    assert names(tmp_path) == ["a.txt"]
    assert (tmp_path / "a.txt").read_text() == "old"


def test_a_folder_appears_whole(tmp_path):
    with finished_folder(tmp_path / "deep" / "scan") as folder:
        assert folder.name == "scan"
        (folder / "a").write_text("1")
        assert not (tmp_path / "deep" / "scan").exists()
    assert names(tmp_path) == ["deep", "deep/scan", "deep/scan/a"]


def test_a_folder_that_fails_leaves_nothing(tmp_path):
    def fail():
        with finished_folder(tmp_path / "scan") as folder:
            (folder / "a").write_text("1")
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail()
    assert names(tmp_path) == []


def test_a_folder_finished_by_another_process_stays(tmp_path):
    with finished_folder(tmp_path / "scan") as folder:
        (folder / "mine").write_text("")
        (tmp_path / "scan").mkdir()
        (tmp_path / "scan" / "theirs").write_text("")
    assert names(tmp_path) == ["scan", "scan/theirs"]


def test_sweep_removes_what_matches(tmp_path):
    for name in (".unfinished-a.1", "keep", "x/.unfinished-b.2/c"):
        (tmp_path / name).mkdir(parents=True)
    (tmp_path / "x" / "k.tmp").write_text("")
    sweep(tmp_path, ".unfinished-*", "*/.unfinished-*", "*/*.tmp")
    assert names(tmp_path) == ["keep", "x"]
    sweep(tmp_path / "missing", "*")


def test_a_full_disk_is_seen_behind_other_errors():
    full = OSError(errno.ENOSPC, "No space left on device")
    wrapped = ValueError()
    wrapped.__cause__ = full
    assert no_room(full) is full
    assert no_room(wrapped) is full
    assert no_room(OSError(errno.ENOENT, "No such file")) is None
    assert no_room(ValueError()) is None


def test_bytes_below(tmp_path):
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "b").write_bytes(b"12345")
    (tmp_path / "c").write_bytes(b"123")
    assert bytes_below(tmp_path) == 8
    assert bytes_below(tmp_path / "missing") == 0
