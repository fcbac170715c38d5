# SPDX-License-Identifier: Apache-2.0
"""Locks between processes, which are forked here: a process cannot lock itself out of its own file twice."""

from __future__ import annotations

import errno
import fcntl
import json
import logging
import os
import signal
import subprocess
import sys
import threading
import time
from dataclasses import replace

import pytest

from raytran.data.locks import Holder, Process, exclusive_lock, lock_when_free
from raytran.errors import ConfigError, DataError

HOLD = """
import sys, time
from pathlib import Path
from raytran.data.locks import exclusive_lock
from raytran.errors import ConfigError
with exclusive_lock(Path(sys.argv[1]), if_taken=ConfigError):
    print("held", flush=True)
    time.sleep(float(sys.argv[2]))
"""


@pytest.fixture(params=["flock", "by name"])
def system(request, monkeypatch):
    """A file system with locks, and one without."""
    if request.param == "by name":

        def flock(*_):
            raise OSError(errno.ENOLCK, "No locks available")

        monkeypatch.setattr(fcntl, "flock", flock)
    return request.param


@pytest.fixture
def hold(system):
    """Start a process that holds a lock for some seconds."""
    started = []

    def start(path, seconds):
        without = "import fcntl\ndef f(*_): raise OSError(37, 'No locks')\nfcntl.flock = f\n"
        program = (without if system == "by name" else "") + HOLD
        process = subprocess.Popen(
            [sys.executable, "-c", program, str(path), str(seconds)], stdout=subprocess.PIPE, text=True
        )
        started.append(process)
        assert process.stdout.readline() == "held\n"
        return process

    yield start
    for process in started:
        process.kill()
        process.communicate()


def names(root):
    return sorted(path.name for path in root.rglob("*"))


def test_a_lock_is_held_by_one_and_leaves_nothing(tmp_path, system):
    path = tmp_path / "new" / ".lock"
    with exclusive_lock(path, if_taken=ConfigError) as descriptor:
        assert descriptor > 0
        with pytest.raises(ConfigError), exclusive_lock(path, if_taken=ConfigError):
            pass
    with exclusive_lock(path, if_taken=ConfigError):
        pass
    assert names(tmp_path) == ["new"]


def test_an_error_gives_the_lock_back(tmp_path, system):
    with pytest.raises(ZeroDivisionError), exclusive_lock(tmp_path / "l", if_taken=ConfigError):
        raise ZeroDivisionError
    assert names(tmp_path) == []


def test_who_holds_it_is_said(tmp_path, hold):
    process = hold(tmp_path / "l", 60)
    with pytest.raises(ConfigError) as raised, exclusive_lock(tmp_path / "l", if_taken=ConfigError):
        pass
    said = str(raised.value)
    assert f"number {process.pid} on {os.uname().nodename}, python " in said
    assert f"since {time.strftime('%Y-%m-%d')}" in said
    assert len(said) < 300 - len(str(tmp_path))


@pytest.mark.parametrize("signum", [signal.SIGKILL, signal.SIGTERM])
def test_the_lock_of_a_dead_process_is_free(tmp_path, hold, signum):
    process = hold(tmp_path / "l", 60)
    process.send_signal(signum)
    process.wait()
    with exclusive_lock(tmp_path / "l", if_taken=ConfigError):
        pass
    assert names(tmp_path) == []


def test_waiting_says_for_whom(tmp_path, hold, caplog):
    caplog.set_level(logging.INFO, "raytran")
    process = hold(tmp_path / "l", 0.5)
    began = time.monotonic()
    with lock_when_free(tmp_path / "l", work="makes the rooms in x") as waited:
        assert waited
    assert time.monotonic() - began < 10
    (line,) = caplog.messages
    assert line.startswith(f"another process makes the rooms in x (number {process.pid} on ")
    assert line.endswith("): waiting for it to end")
    with lock_when_free(tmp_path / "l", work="") as waited:
        assert not waited


def test_many_who_wait_come_one_after_another(tmp_path, system):
    inside, most, turns = [], [], []

    def work(number):
        for _ in range(5):
            with lock_when_free(tmp_path / "l", work="counts"):
                inside.append(number)
                most.append(len(inside))
                turns.append(number)
                inside.remove(number)

    threads = [threading.Thread(target=work, args=(number,)) for number in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60)
    assert set(most) == {1}
    assert len(turns) == 20


def test_a_lock_on_another_machine_without_locks_holds_and_says_what_to_do(tmp_path, monkeypatch):
    monkeypatch.setattr(fcntl, "flock", lambda *_: (_ for _ in ()).throw(OSError(errno.ENOLCK, "")))
    claim = tmp_path / "l-claim"
    claim.write_text(replace(Holder(), process="0123abcd-7-9", host="node7").as_text())
    with pytest.raises(ConfigError, match=f"7 on node7.*if it has ended, remove {claim}"):
        exclusive_lock(tmp_path / "l", if_taken=ConfigError).__enter__()
    assert claim.is_file()


@pytest.mark.parametrize("text", ["", "{", "[]", '{"process": 1}', "\x00"])
def test_a_holder_that_says_nothing(tmp_path, text):
    path = tmp_path / "l"
    path.write_text(text)
    with path.open() as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        with pytest.raises(ConfigError, match="does not say which"):
            exclusive_lock(path, if_taken=ConfigError).__enter__()


def test_an_empty_claim_that_is_old_was_left(tmp_path, monkeypatch):
    monkeypatch.setattr(fcntl, "flock", lambda *_: (_ for _ in ()).throw(OSError(errno.ENOLCK, "")))
    claim = tmp_path / "l-claim"
    claim.write_text("")
    with pytest.raises(ConfigError):
        exclusive_lock(tmp_path / "l", if_taken=ConfigError).__enter__()
    os.utime(claim, (0, 0))
    with exclusive_lock(tmp_path / "l", if_taken=ConfigError):
        pass


def test_a_folder_that_cannot_be_made(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(DataError, match="cannot write to"):
        exclusive_lock(tmp_path / "file" / "l", if_taken=ConfigError).__enter__()


def test_processes_are_told_apart():
    me = Process.this()
    assert me.lives()
    assert Process.named_in(f".unfinished-{me}-abc-a.png") == me
    assert Process.named_in(".unfinished-scene0001_00.123") is None
    assert replace(me, started=me.started + 1).lives() is False  # the number was used again
    assert replace(me, machine="00000000").lives() is None
    child = subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE)
    stat = json.dumps(open(f"/proc/{child.pid}/stat").read().split())  # noqa: SIM115 - read at once
    other = Process(me.machine, child.pid, int(json.loads(stat)[21]))
    assert other.lives()
    child.kill()
    while other.lives():  # a zombie writes nothing
        time.sleep(0.01)
    child.communicate()
    assert not other.lives()
