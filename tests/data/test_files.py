# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import errno
import json

import pytest

from raytran.data.files import (
    UNFINISHED,
    SettingsRecord,
    bytes_below,
    disk_full,
    exclusive_lock,
    finished_folder,
    sweep,
    whole_file,
    write_json,
    write_text,
)
from raytran.errors import ConfigError


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
    assert disk_full(full) is full
    assert disk_full(wrapped) is full
    assert disk_full(OSError(errno.ENOENT, "No such file")) is None
    assert disk_full(ValueError()) is None


def test_bytes_below(tmp_path):
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "b").write_bytes(b"12345")
    (tmp_path / "c").write_bytes(b"123")
    assert bytes_below(tmp_path) == 8
    assert bytes_below(tmp_path / "missing") == 0


def test_a_file_appears_whole_and_its_temporary_name_tells_the_format(tmp_path):
    for durable in (False, True):
        with whole_file(tmp_path / "new" / "a.png", durable=durable) as temporary:
            temporary.write_bytes(b"1")
            assert temporary.suffix == ".png"
            assert temporary.name.startswith(UNFINISHED)
            assert not (tmp_path / "new" / "a.png").exists()
        assert names(tmp_path) == ["new", "new/a.png"]
        (tmp_path / "new" / "a.png").unlink()


def test_what_a_killed_call_left_of_a_durable_file_is_overwritten(tmp_path):
    (tmp_path / ".unfinished-a").write_text("half of the earlier one")
    with whole_file(tmp_path / "a", durable=True) as temporary:
        temporary.write_text("new")
    assert names(tmp_path) == ["a"]
    assert (tmp_path / "a").read_text() == "new"


def test_a_folder_is_replaced_when_asked(tmp_path):
    (tmp_path / "scan").mkdir()
    (tmp_path / "scan" / "old").write_text("")
    with finished_folder(tmp_path / "scan", replace=True) as folder:
        (folder / "new").write_text("")
    assert names(tmp_path) == ["scan", "scan/new"]


def test_a_lock_is_held_by_one(tmp_path):
    path, taken = tmp_path / "new" / ".lock", ConfigError("taken")
    with exclusive_lock(path, if_taken=taken) as descriptor:
        assert descriptor > 0
        with pytest.raises(ConfigError, match="taken"), exclusive_lock(path, if_taken=taken):
            pass
    with exclusive_lock(path, if_taken=taken):
        pass


def test_a_record_names_the_settings_that_differ(tmp_path):
    record = SettingsRecord(tmp_path / "new" / "record.json")
    assert record.read() == {}
    assert record.begin({"seed": 1, "size": (2, 3)}) == []
    assert record.begin({"seed": 1, "size": [2, 3], "cads": None}) == []
    assert record.begin({"seed": 2, "cads": "x"}) == ["seed", "cads", "size"]
    assert record.read() == {"seed": 1, "size": [2, 3]}


@pytest.mark.parametrize("text", ['{"seed', "[1]", ""])
def test_everything_differs_from_a_damaged_record(tmp_path, text):
    record = SettingsRecord(tmp_path / "record.json")
    record.path.write_text(text)
    assert record.begin({"seed": 1}) == ["seed"]
