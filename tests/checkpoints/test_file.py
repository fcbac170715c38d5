# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import os
import pickle
import resource
import shutil
import zipfile

import pytest
import torch

from raytran.checkpoints.file import FORMAT, read_checkpoint, read_newest, write_checkpoint, write_weights
from raytran.errors import CheckpointError

METADATA = {"format": FORMAT, "stage": "stage2", "preset": "tiny", "model": {}, "views": {}}


def content(value=0.0, **changes):
    return {**METADATA, "state_dict": {"weight": torch.arange(1000.0) + value}, **changes}


def weight(path):
    return read_checkpoint(path)["state_dict"]["weight"][0].item()


@pytest.fixture
def path(tmp_path):
    path = tmp_path / "checkpoints" / "last.ckpt"
    write_checkpoint(path, content())
    return path


def flip_bit(path):
    """Change one bit of the weights, which the archive stores as they are."""
    file = bytearray(path.read_bytes())
    file[file.index(torch.tensor(500.0).numpy().tobytes())] ^= 1
    path.write_bytes(file)


def test_what_is_written_is_read_without_trust(path):
    assert torch.equal(read_checkpoint(path)["state_dict"]["weight"], torch.arange(1000.0))
    assert torch.load(path, weights_only=True)["format"] == "raytran.checkpoint/2"
    assert [file.name for file in path.parent.iterdir()] == ["last.ckpt"]


@pytest.mark.parametrize("ending", ["ckpt", "safetensors"])
def test_stages_of_earlier_checkpoints_have_their_present_names(tmp_path, ending):
    path = tmp_path / f"old.{ending}"
    stage = {"name": "view", "parent": "occupancy", "other_parents": ["joint", "shape"], "terms": ["view"]}
    metadata = {
        **METADATA,
        "format": "raytran.checkpoint/1",
        "stage": "view",
        "parent": {"stage": "occupancy", "step": 3},
        "config": {"stage": stage, "schedule": {"batch": 2, "joint": {"steps": 5}}, "loss": {"shape": 1.0}},
    }
    if ending == "ckpt":
        write_checkpoint(path, {**metadata, "state_dict": {}})
    else:
        write_weights(path, metadata, {})
    found = read_checkpoint(path)
    assert (found["stage"], found["parent"]) == ("novel_view", {"stage": "stage1", "step": 3})
    assert found["config"] == {
        "stage": {
            "name": "novel_view",
            "parent": "stage1",
            "other_parents": ["stage2", "stage3"],
            "terms": ["view"],
        },
        "schedule": {"batch": 2, "stage2": {"steps": 5}},
        "loss": {"shape": 1.0},
    }


@pytest.mark.parametrize("share", [0.0, 0.5, 0.99])
def test_a_file_cut_short_is_one_sentence(path, share):
    file = path.read_bytes()
    path.write_bytes(file[: int(share * len(file))])
    with pytest.raises(CheckpointError, match=r"last\.ckpt.*damaged or cut short.*train that stage again"):
        read_checkpoint(path)


def test_one_wrong_bit_is_found(path):
    flip_bit(path)
    # PyTorch does not notice.
    assert not torch.equal(torch.load(path)["state_dict"]["weight"], torch.arange(1000.0))
    with pytest.raises(CheckpointError, match="damaged or cut short"):
        read_checkpoint(path)


def test_a_missing_file_is_one_sentence(tmp_path):
    with pytest.raises(CheckpointError, match=r"no checkpoint at .*nothing\.ckpt"):
        read_checkpoint(tmp_path / "nothing.ckpt")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"format": None}, r"expected format raytran\.checkpoint/2, got None"),
        ({"format": "raytran.checkpoint/3"}, r"newer raytran \(format raytran\.checkpoint/3.*update raytran"),
        ({"model": "RayTran"}, r"no proper 'model'"),
        ({"state_dict": {"weight": 1.0}}, r"weights are no tensors"),
    ],
)
def test_another_programs_checkpoint_is_refused(tmp_path, changes, message):
    torch.save(content(**changes), tmp_path / "other.ckpt")
    with pytest.raises(CheckpointError, match=message):
        read_checkpoint(tmp_path / "other.ckpt")


class Bomb:
    """Runs a command when it is unpickled."""

    def __init__(self, target):
        self.target = target

    def __reduce__(self):
        return os.system, (f"touch {self.target}",)


@pytest.mark.parametrize("place", ["state_dict", "callbacks", "format"])
def test_no_pickle_is_run(tmp_path, place):
    target = tmp_path / "ran"
    torch.save(content(**{place: Bomb(target)}), tmp_path / "bad.ckpt")
    with pytest.raises(CheckpointError, match=r"more than tensors and plain values.*do not use"):
        read_checkpoint(tmp_path / "bad.ckpt")
    assert not target.exists()
    torch.load(tmp_path / "bad.ckpt", weights_only=False)
    assert target.exists(), "the file was harmless: this test proved nothing"


def test_a_bare_pickle_is_not_run(tmp_path):
    (tmp_path / "bad.ckpt").write_bytes(pickle.dumps(Bomb(tmp_path / "ran")))
    with pytest.raises(CheckpointError, match="cannot read"):
        read_checkpoint(tmp_path / "bad.ckpt")
    assert not (tmp_path / "ran").exists()


def test_an_archive_that_unfolds_in_memory_is_refused(path, tmp_path):
    with (
        zipfile.ZipFile(path) as whole,
        zipfile.ZipFile(tmp_path / "small.ckpt", "w", zipfile.ZIP_DEFLATED) as small,
    ):
        for name in whole.namelist():
            small.writestr(name, whole.read(name))
    with pytest.raises(CheckpointError, match="compressed archive"):
        read_checkpoint(tmp_path / "small.ckpt")


def test_a_kill_while_writing_keeps_the_old_file(path, monkeypatch):
    before = path.read_bytes()

    def stop(content, file):
        file.write(b"half")
        raise KeyboardInterrupt

    monkeypatch.setattr(torch, "save", stop)
    with pytest.raises(KeyboardInterrupt):
        write_checkpoint(path, content(1))
    assert path.read_bytes() == before


def test_the_one_before_is_kept(path):
    for value in (1, 2):
        write_checkpoint(path, content(value))
    assert (weight(path), weight(path.with_name("previous.ckpt"))) == (2, 1)
    assert sorted(file.name for file in path.parent.iterdir()) == ["last.ckpt", "previous.ckpt"]


@pytest.mark.parametrize("renaming", [1, 2])
def test_a_kill_between_two_names_leaves_whole_files(path, monkeypatch, renaming):
    write_checkpoint(path, content(1))
    calls = []

    def replace(source, target, *, original=os.replace):
        calls.append(target)
        if len(calls) == renaming:
            raise KeyboardInterrupt
        original(source, target)

    monkeypatch.setattr(os, "replace", replace)
    with pytest.raises(KeyboardInterrupt):
        write_checkpoint(path, content(2))
    assert (weight(path), weight(path.with_name("previous.ckpt"))) == (renaming, 0)


def test_a_file_system_without_links(path, monkeypatch):
    def link(*_):
        raise PermissionError

    monkeypatch.setattr(os, "link", link)
    write_checkpoint(path, content(1))
    assert (weight(path), weight(path.with_name("previous.ckpt"))) == (1, 0)


@pytest.mark.parametrize("damage", ["cut", "bit", "gone"])
def test_the_last_good_one_is_found(path, caplog, damage):
    write_checkpoint(path, content(1))
    assert read_newest(path.parent)[0] == path
    if damage == "cut":
        path.write_bytes(path.read_bytes()[:-100])
    elif damage == "bit":
        flip_bit(path)
    else:
        path.unlink()
    found, read = read_newest(path.parent)
    assert (found.name, read["state_dict"]["weight"][0]) == ("previous.ckpt", 0)
    assert ("going on from the one before it" in caplog.text) == (damage != "gone")
    # Written again, the good one is kept until the new one stands.
    write_checkpoint(path, content(2))
    assert weight(path) == 2


def test_no_good_one_is_one_sentence(path, tmp_path):
    assert read_newest(tmp_path) is None
    shutil.copy(path, path.with_name("previous.ckpt"))
    for name in ("last.ckpt", "previous.ckpt"):
        path.with_name(name).write_bytes(b"")
    with pytest.raises(CheckpointError, match=r"cannot read .*last\.ckpt"):
        read_newest(path.parent)


def test_a_newer_one_is_not_passed_over_for_an_old_one(path):
    write_checkpoint(path, content(format="raytran.checkpoint/9"))
    with pytest.raises(CheckpointError, match="newer raytran"):
        read_newest(path.parent)


def test_a_full_disk_is_one_sentence_and_keeps_what_is_there(path):
    before = path.read_bytes()
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    # The system then refuses to let a file grow, as it does on a full disk.
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, limits[1]))
    try:
        with pytest.raises(CheckpointError, match=r"cannot write .*last\.ckpt .*: make room there.*is kept"):
            write_checkpoint(path, content(state_dict={"weight": torch.zeros(100_000)}))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert path.read_bytes() == before
    assert [file.name for file in path.parent.iterdir()] == ["last.ckpt"]
