# SPDX-License-Identifier: Apache-2.0
"""Files of torch.save that claim more than they hold."""

from __future__ import annotations

import pickle
import struct
import time
import tracemalloc
import zipfile
from collections import OrderedDict

import numpy as np
import pytest
import torch

from raytran.tensor_archive import load_archive, load_stream


def save(path, content):
    torch.save(content, path)
    return path


def with_pickle(path, content: bytes, *, other=(), **parts):
    """Write an archive with this pickle, and parts beside it by name."""
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("archive/data.pkl", content)
        archive.writestr("archive/version", b"3\n")
        archive.writestr("archive/byteorder", b"little")
        for name, data in parts.items():
            archive.writestr(f"archive/data/{name.removeprefix('_')}", data)
    return path


def edited(path, old: bytes, new: bytes):
    """Write an archive of torch.save again with another pickle."""
    with zipfile.ZipFile(path) as archive:
        parts = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(path, "w") as archive:
        for name, data in parts.items():
            if name.endswith("data.pkl"):
                assert old in data
                data = data.replace(old, new)
            archive.writestr(name, data)
    return path


def refused(path, kind=ValueError):
    began = time.monotonic()
    tracemalloc.start()
    try:
        with pytest.raises(kind):
            load_archive(path)
        assert tracemalloc.get_traced_memory()[1] < 2e8
    finally:
        tracemalloc.stop()
    assert time.monotonic() - began < 20  # about a second, on a machine with nothing else to do


def test_tensors_and_plain_values_come_back(tmp_path):
    shared = torch.arange(6.0)
    content = {
        "a": shared.reshape(2, 3).T,
        "b": shared,
        "half": torch.ones(3, dtype=torch.bfloat16),
        "empty": torch.zeros(0, 4),
        "one": torch.tensor(5),
        "flags": torch.tensor([True, False]),
        "parameter": torch.nn.Parameter(torch.ones(2)),
        "plain": [1, 2.5, None, True, "text", (1, 2), OrderedDict(x=2**64), torch.Size([1, 2])],
    }
    found = load_archive(save(tmp_path / "file", content))
    for name, value in content.items():
        assert torch.equal(found[name], value) if isinstance(value, torch.Tensor) else found[name] == value
    state = torch.nn.BatchNorm1d(3).state_dict()
    assert load_archive(save(tmp_path / "file", state))._metadata == state._metadata


def test_a_number_stretched_to_any_shape_is_refused(tmp_path):
    refused(save(tmp_path / "file", {"x": torch.zeros(1).expand(30_000, 30_000)}))
    numbers = torch.zeros(10_000)
    refused(save(tmp_path / "file", [numbers[index:] for index in range(1000)]))


@pytest.mark.parametrize(
    "content",
    [
        b"\x80\x02cbuiltins\nbytearray\n\x8a\x05\x00\x00\x00\x00\x02\x85R.",
        b"\x80\x02ctorch\nTensor\nK\x04J\x00\x00\x00\x10\x86R.",
        b"\x80\x02ctorch\nFloatStorage\nJ\x00\x00\x00\x40\x85R.",
        b"\x80\x05\x96\x00\x00\x00\x00\x02\x00\x00\x00.",
        b"\x80\x02cos\nsystem\nX\x04\x00\x00\x00true\x85R.",
        pickle.dumps(np.zeros(4), protocol=2),
    ],
)
def test_what_is_no_tensor_is_neither_made_nor_run(tmp_path, content):
    refused(with_pickle(tmp_path / "file", content), (pickle.UnpicklingError, ValueError))


def test_lists_of_the_same_lists_are_refused(tmp_path):
    node = ["x"]
    for _ in range(25):
        node = [node] * 10
    refused(save(tmp_path / "file", node))
    node = [1]
    node.append(node)
    refused(save(tmp_path / "file", node))
    node = []
    for _ in range(150):
        node = [node]
    refused(save(tmp_path / "file", node))


@pytest.mark.parametrize(
    "content",
    [
        b"\x80\x02]r\xff\xff\xff\x7f.",  # a list under the number 2**31 - 1
        b"\x80\x02" + b"]q\x00" * 1_000_000 + b".",
        b"\x80\x02}(" + b"".join(b"\x8a\x0a" + struct.pack("<QH", 0, i) + b"N" for i in range(9999)) + b"u.",
        b"\x80\x02",
        b"",
        b"\x80\x02X\xff\xff\xff\x7fabc.",
        b"\x80\x02ccollections\nOrderedDict\nN\x85R.",
        b"\x80\x02ctorch._utils\n_rebuild_tensor_v2\n}b.",
        b"\x80\x02ctorch._utils\n_rebuild_tensor_v2\nN}\x86b.",
        b"\x80\x02ctorch._utils\n_rebuild_tensor_v2\n(NNNNtR.",
        b"\x80\x02K\x05Q.",
    ],
)
def test_pickles_that_no_program_writes_are_refused(tmp_path, content):
    refused(with_pickle(tmp_path / "file", content), (pickle.UnpicklingError, ValueError))


def test_a_tensor_may_not_read_beyond_its_numbers(tmp_path):
    path = save(tmp_path / "file", torch.arange(77.0))
    refused(edited(path, b"K\x4dt", b"K\x4et"))  # of the storage: PyTorch would read another program's memory
    path = save(tmp_path / "file", torch.arange(77.0))
    refused(edited(path, b"K\x4d\x85", b"K\x4e\x85"))  # of the shape


def test_archives_that_two_readers_may_read_otherwise_are_refused(tmp_path):
    path = save(tmp_path / "file", {"x": torch.arange(77.0)})
    whole = path.read_bytes()
    for changed in (b"#!/bin/sh\n" + whole, whole + b"\0", whole[:-2] + b"\1\0x", whole + whole):
        path.write_bytes(changed)
        refused(path)
    path.write_bytes(whole)
    with zipfile.ZipFile(path, "a") as archive, pytest.warns(UserWarning, match="Duplicate name"):
        archive.writestr("file/data.pkl", b"\x80\x02N.")
    refused(path)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("archive/data.pkl", b"\x80\x02N.")
    refused(path, pickle.UnpicklingError)


def test_parts_that_lie_over_each_other_are_refused(tmp_path):
    """A thousand names of one part cost a thousand times its bytes to read."""
    path = with_pickle(tmp_path / "file", b"\x80\x02N.", _0=b"x" * 10**6)
    whole = path.read_bytes()
    with zipfile.ZipFile(path) as archive:
        start = archive.start_dir
    directory = whole[start:-22]
    entry = directory[directory.rindex(b"PK\1\2") :]
    directory += b"".join(entry[:-1] + bytes([65 + index]) for index in range(50))
    end = struct.pack("<4s4H2IH", b"PK\5\6", 0, 0, 54, 54, len(directory), start, 0)
    path.write_bytes(whole[:start] + directory + end)
    refused(path)


def in_the_old_form(path, content):
    torch.save(content, path, _use_new_zipfile_serialization=False)
    return path


def test_files_from_before_pytorch_1_6_are_read(tmp_path):
    state = torch.nn.BatchNorm1d(3).state_dict()
    found = load_stream(in_the_old_form(tmp_path / "file", state))
    assert all(torch.equal(found[name], value) for name, value in state.items())


@pytest.mark.parametrize(
    "content",
    [
        {"x": torch.zeros(1).expand(10**10)},
        {"x": bytearray(5)},
        {"x": np.zeros(3)},
        {"x": torch.Generator},
    ],
)
def test_files_of_the_old_form_that_claim_more_than_they_hold_are_refused(tmp_path, content):
    with pytest.raises((ValueError, pickle.UnpicklingError)):
        load_stream(in_the_old_form(tmp_path / "file", content))


def test_files_of_the_old_form_that_are_cut_or_changed_are_refused(tmp_path):
    path = in_the_old_form(tmp_path / "file", {"x": torch.arange(77.0)})
    whole = path.read_bytes()
    larger = whole.replace(b"K\x4dN", b"J\xff\xff\xff\x7fN")
    assert larger != whole
    for changed in (b"", whole[:1], whole[:100], whole[:-50], larger):
        path.write_bytes(changed)
        with pytest.raises((ValueError, pickle.UnpicklingError)):
            load_stream(path)
