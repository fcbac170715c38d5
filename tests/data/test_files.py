# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import errno
import json
import os
import subprocess
import sys
import time

import pytest

from raytran.data.files import (
    UNFINISHED,
    SettingsRecord,
    bytes_below,
    disk_full,
    finished_folder,
    sweep,
    unfinished_name,
    whole_file,
    write_json,
    write_text,
)


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
    assert disk_full(OSError("encoder error -2 when writing image file")).strerror  # Pillow's
    assert disk_full(ValueError()) is None
    first, second = ValueError(), OSError(errno.ENOENT, "No such file")
    first.__context__, second.__context__ = second, first  # raised again while it was handled
    assert disk_full(first) is None


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


ROOMS, FILES = 6, 12

WRITE_ROOMS = f"""
import sys, time
from pathlib import Path
from raytran.data.files import UNFINISHED, finished_folder, sweep
root = Path(sys.argv[1])
sys.stdin.readline()
for round in range(20):
    sweep(root, f"{{UNFINISHED}}*")
    for number in range({ROOMS}):
        with finished_folder(root / f"{{round}}-{{number}}", replace=sys.argv[2] == "replace") as room:
            for index in range({FILES}):
                (room / str(index)).write_text(sys.argv[3])
"""


@pytest.mark.parametrize("replacing", ["replace", "keep"])
def test_processes_that_write_the_same_folders_and_sweep_write_them_whole(tmp_path, replacing):
    """Each of 120 folders has all its files, of one process; a sweep takes nothing of a living one."""
    processes = [
        subprocess.Popen(
            [sys.executable, "-c", WRITE_ROOMS, str(tmp_path), replacing, number],
            stdin=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        for number in "123"
    ]
    for process in processes:  # all have imported what they need when the first begins
        process.stdin.write("\n")
        process.stdin.flush()
    said = [process.communicate(timeout=120)[1] for process in processes]
    assert said == [""] * 3
    rooms = [path for path in tmp_path.iterdir() if not path.name.startswith(".")]
    assert len(rooms) == 20 * ROOMS
    for room in rooms:
        texts = [path.read_text() for path in room.iterdir()]
        assert len(texts) == FILES
        assert len(set(texts)) == 1
    assert names(tmp_path)[0] == "0-0"  # nothing unfinished is left


def test_unfinished_work_is_removed_when_its_process_is_dead_and_not_before(tmp_path):
    child = subprocess.Popen(
        [
            sys.executable,
            "-c",
            "import sys; from pathlib import Path; from raytran.data.files import unfinished_name\n"
            "(Path(sys.argv[1]) / unfinished_name('a.png')).mkdir()\n"
            "print(flush=True); input()",
            str(tmp_path),
        ],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
    )
    child.stdout.readline()
    (theirs,) = names(tmp_path)
    mine = unfinished_name()
    (tmp_path / mine).write_text("")
    sweep(tmp_path, f"{UNFINISHED}*")
    assert set(names(tmp_path)) == {mine, theirs}
    child.kill()
    child.communicate()
    sweep(tmp_path, f"{UNFINISHED}*")
    assert names(tmp_path) == [mine]


def test_unfinished_work_of_another_machine_is_left_for_a_week(tmp_path):
    folder = tmp_path / ".unfinished-0123abcd-7-9-11111111"
    (folder / "deep").mkdir(parents=True)
    (folder / "deep" / "a").write_text("")
    week = 7 * 24 * 3600

    def changed_before(seconds):
        for path in (folder / "deep" / "a", folder / "deep", folder):
            os.utime(path, (time.time() - seconds,) * 2)

    changed_before(week + 60)
    os.utime(folder / "deep" / "a")  # one file that is written right now
    sweep(tmp_path, f"{UNFINISHED}*")
    assert folder.is_dir()
    changed_before(week - 60)
    sweep(tmp_path, f"{UNFINISHED}*")
    assert folder.is_dir()
    changed_before(week + 60)
    sweep(tmp_path, f"{UNFINISHED}*")
    assert names(tmp_path) == []


def test_two_who_write_one_durable_file_at_once_do_not_meet(tmp_path):
    with whole_file(tmp_path / "a", durable=True) as first:
        first.write_text("first")
        with whole_file(tmp_path / "a", durable=True) as second:
            second.write_text("second")
    assert names(tmp_path) == ["a"]
    assert (tmp_path / "a").read_text() == "first"


def test_temporary_names_are_not_too_long_for_a_file_system(tmp_path):
    name = "ü" * 120 + ".txt"
    for durable in (False, True):
        with whole_file(tmp_path / name, durable=durable) as temporary:
            temporary.write_text("")
            assert temporary.suffix == ".txt"
    with finished_folder(tmp_path / ("x" * 250)) as folder:
        (folder / "a").write_text("")
    assert len(names(tmp_path)) == 3


def test_a_file_larger_than_allowed_is_a_full_disk_and_leaves_nothing(tmp_path):
    program = (
        "import resource, sys; from pathlib import Path\n"
        "from raytran.data.files import disk_full, finished_folder, write_text\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))\n"
        "root = Path(sys.argv[1])\n"
        "try: write_text(root / 'a', 'x' * 2000)\n"
        "except OSError as error: print(disk_full(error) is error)\n"
        "try:\n"
        "    with finished_folder(root / 'b') as folder: (folder / 'c').write_text('x' * 2000)\n"
        "except OSError as error: print(disk_full(error) is error)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", program, str(tmp_path)], capture_output=True, text=True, check=True
    )
    assert done.stdout == "True\nTrue\n"
    assert names(tmp_path) == []


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
