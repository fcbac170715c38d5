# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json
import pickle
import resource
import struct

import pytest
import torch
from safetensors.torch import load_file, save_file

from raytran.checkpoints.file import FORMAT, read_checkpoint, write_checkpoint, write_weights
from raytran.errors import CheckpointError

METADATA = {
    "format": FORMAT,
    "stage": "stage2",
    "preset": "tiny",
    "model": {"a": [1, 2.5, None]},
    "views": {},
}
WEIGHTS = {
    "a.weight": torch.arange(1000.0).view(10, 100),
    "a.steps": torch.tensor(7),
    "b.half": torch.arange(5, dtype=torch.bfloat16),
    "b.none": torch.zeros(0, 3),
}


@pytest.fixture
def path(tmp_path):
    path = tmp_path / "weights" / "rooms.safetensors"
    write_weights(path, METADATA, WEIGHTS)
    return path


def parts(path):
    """Return the header, parsed, and the bytes behind it."""
    file = path.read_bytes()
    (length,) = struct.unpack("<Q", file[:8])
    return json.loads(file[8 : 8 + length]), file[8 + length :]


def put_together(path, header, data):
    text = json.dumps(header).encode()
    path.write_bytes(struct.pack("<Q", len(text)) + text + data)


def same_weights(found, expected):
    assert found.keys() == expected.keys()
    for name, value in found.items():
        assert value.dtype == expected[name].dtype
        assert torch.equal(value, expected[name]), name


def test_what_is_written_is_read_as_a_checkpoint(path):
    content = read_checkpoint(path)
    assert {name: content[name] for name in METADATA} == METADATA
    same_weights(content["state_dict"], {f"model.{name}": value for name, value in WEIGHTS.items()})
    assert [file.name for file in path.parent.iterdir()] == ["rooms.safetensors"]


def test_any_program_opens_it(path):
    same_weights(load_file(path), WEIGHTS)
    header = parts(path)[0]["__metadata__"]
    assert (header["format"], json.loads(header["raytran"])) == ("pt", METADATA)


def test_tensors_that_share_memory_are_written(tmp_path):
    both = torch.arange(6.0)
    write_weights(tmp_path / "a.safetensors", METADATA, {"a": both, "b": both, "c": both.view(2, 3).t()})
    assert torch.equal(load_file(tmp_path / "a.safetensors")["c"], both.view(2, 3).t())


def test_another_name(path, tmp_path):
    as_ckpt = path.rename(tmp_path / "weights.ckpt")
    assert read_checkpoint(as_ckpt)["stage"] == "stage2"
    write_checkpoint(tmp_path / "a.ckpt", {**METADATA, "state_dict": WEIGHTS})
    as_weights = (tmp_path / "a.ckpt").rename(tmp_path / "a.safetensors")
    with pytest.raises(CheckpointError, match="no safetensors file"):
        read_checkpoint(as_weights)


@pytest.mark.parametrize("share", [0.0, 0.001, 0.3, 0.99])
def test_a_file_cut_short_is_one_sentence(path, share):
    file = path.read_bytes()
    path.write_bytes(file[: int(share * len(file))])
    with pytest.raises(
        CheckpointError, match=r"cannot read .*rooms\.safetensors: .*cut short.*export it again"
    ):
        read_checkpoint(path)


@pytest.mark.parametrize("what", ["weight", "metadata", "name"])
def test_one_wrong_bit_is_found(path, what):
    file = bytearray(path.read_bytes())
    looked_for = {"weight": torch.tensor(500.0).numpy().tobytes(), "metadata": b"2.5", "name": b"b.half"}[
        what
    ]
    file[file.index(looked_for)] ^= 1
    path.write_bytes(file)
    assert len(load_file(path)) == len(WEIGHTS), "safetensors itself notices: this test proves nothing"
    with pytest.raises(CheckpointError, match="damaged"):
        read_checkpoint(path)


def test_a_strangers_file_is_refused(tmp_path):
    save_file({"weight": torch.zeros(3)}, tmp_path / "other.safetensors", metadata={"format": "pt"})
    with pytest.raises(
        CheckpointError, match=r"other\.safetensors holds no network of raytran.*export_model"
    ):
        read_checkpoint(tmp_path / "other.safetensors")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"format": "raytran.checkpoint/3"}, "newer raytran"),
        ({"format": "someone/1"}, "expected format"),
        ({"model": "RayTran"}, "no proper 'model'"),
        ({"views": None}, "no proper 'views'"),
    ],
)
def test_another_card_is_refused(tmp_path, changes, message):
    write_weights(tmp_path / "other.safetensors", {**METADATA, **changes}, WEIGHTS)
    with pytest.raises(CheckpointError, match=message):
        read_checkpoint(tmp_path / "other.safetensors")


@pytest.mark.parametrize("metadata", ["", "{", "[]", "3", "[" * 100_000, '{"a": "' + "x" * 2_000_000 + '"}'])
def test_a_made_up_card_is_refused(path, metadata):
    header, data = parts(path)
    header["__metadata__"]["raytran"] = metadata
    put_together(path, header, data)
    with pytest.raises(CheckpointError, match=r"rooms\.safetensors"):
        read_checkpoint(path)


@pytest.mark.parametrize(
    "tensor",
    [
        {"dtype": "F32", "shape": [1 << 40], "data_offsets": [0, 1 << 42]},
        {"dtype": "F32", "shape": [1 << 60, 1 << 60], "data_offsets": [0, 4000]},
        {"dtype": "F32", "shape": [1000], "data_offsets": [-4000, 0]},
        {"dtype": "F32", "shape": [10], "data_offsets": [0, 4000]},
        {"dtype": "OBJECT", "shape": [1000], "data_offsets": [0, 4000]},
        None,
    ],
)
def test_made_up_tensors_are_refused(path, tensor):
    header, data = parts(path)
    put_together(path, {"__metadata__": header["__metadata__"], "a": tensor}, data)
    with pytest.raises(CheckpointError, match="cannot read"):
        read_checkpoint(path)


def test_a_header_that_claims_everything_is_refused(path):
    path.write_bytes(struct.pack("<Q", 1 << 62) + b"{" + b" " * 100)
    with pytest.raises(CheckpointError, match="cannot read"):
        read_checkpoint(path)


class Bomb:
    """Fails the test when it is unpickled."""

    def __reduce__(self):
        return pytest.fail, ("a pickle was run",)


def test_no_pickle_is_run(tmp_path):
    (tmp_path / "bad.safetensors").write_bytes(pickle.dumps(Bomb()))
    with pytest.raises(CheckpointError, match="cannot read"):
        read_checkpoint(tmp_path / "bad.safetensors")


def test_a_full_disk_is_one_sentence_and_keeps_what_is_there(path):
    before = path.read_bytes()
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    # The system then refuses to let a file grow, as it does on a full disk.
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, limits[1]))
    try:
        with pytest.raises(CheckpointError, match=r"cannot write .*rooms\.safetensors .*: make room there"):
            write_weights(path, METADATA, {"weight": torch.zeros(100_000)})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert path.read_bytes() == before
    assert [file.name for file in path.parent.iterdir()] == ["rooms.safetensors"]


def test_others_may_read_it(path, tmp_path):
    (tmp_path / "ordinary").touch()
    assert path.stat().st_mode == (tmp_path / "ordinary").stat().st_mode
