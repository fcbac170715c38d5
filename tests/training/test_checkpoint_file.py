# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import pytest
import torch

from raytran.errors import CheckpointError
from raytran.training.checkpoint_file import FORMAT, read_checkpoint, write_checkpoint


@pytest.fixture
def path(tmp_path):
    path = tmp_path / "checkpoints" / "last.ckpt"
    write_checkpoint(path, {"format": FORMAT, "weight": torch.arange(1000.0)})
    return path


def test_what_is_written_is_read_without_trust(path):
    assert torch.equal(read_checkpoint(path)["weight"], torch.arange(1000.0))
    assert torch.load(path, weights_only=True)["format"] == "raytran.checkpoint/1"
    assert [file.name for file in path.parent.iterdir()] == ["last.ckpt"]


@pytest.mark.parametrize("share", [0.0, 0.5, 0.99])
def test_a_file_cut_short_is_one_sentence(path, share):
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    with pytest.raises(CheckpointError, match=r"last\.ckpt.*damaged or cut short.*train that stage again"):
        read_checkpoint(path)


def test_a_missing_file_is_one_sentence(tmp_path):
    with pytest.raises(CheckpointError, match=r"no checkpoint at .*nothing\.ckpt"):
        read_checkpoint(tmp_path / "nothing.ckpt")


def test_another_programs_checkpoint_is_refused(tmp_path):
    torch.save({"state_dict": {}}, tmp_path / "other.ckpt")
    with pytest.raises(CheckpointError, match=r"expected format raytran\.checkpoint/1, got None"):
        read_checkpoint(tmp_path / "other.ckpt")


def test_a_kill_while_writing_keeps_the_old_file(path, monkeypatch):
    before = path.read_bytes()

    def stop(content, file):
        file.write(b"half")
        raise KeyboardInterrupt

    monkeypatch.setattr(torch, "save", stop)
    with pytest.raises(KeyboardInterrupt):
        write_checkpoint(path, {"format": FORMAT})
    assert path.read_bytes() == before
