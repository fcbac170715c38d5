# SPDX-License-Identifier: Apache-2.0
"""Arrays on disk: round trip, damage, writers at once."""

from __future__ import annotations

import os
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pytest

from raytran.data.cache import MaskCache, digest, file_digest
from raytran.errors import DataError

MASK = np.random.default_rng(0).random((7, 9)) > 0.5


def files(folder: Path) -> list[Path]:
    return [path for path in folder.rglob("*") if path.is_file()]


def test_what_was_written_is_read(tmp_path) -> None:
    cache = MaskCache(folder=tmp_path)
    assert cache.read("foreground", "ab12", (7, 9)) is None
    cache.write("foreground", "ab12", MASK)
    stored = cache.read("foreground", "ab12", (7, 9))
    assert stored.dtype == bool
    np.testing.assert_array_equal(stored, MASK)
    assert cache.read("shape", "ab12", (7, 9)) is None


@pytest.mark.parametrize("damage", [lambda b: b[: len(b) // 2], lambda b: b"", lambda b: b[:-1] + b"\x00"])
def test_damaged_entry_counts_as_missing(tmp_path, damage) -> None:
    cache = MaskCache(folder=tmp_path)
    cache.write("shape", "ab12", MASK)
    (path,) = files(tmp_path)
    path.write_bytes(damage(path.read_bytes()))
    assert cache.read("shape", "ab12", (7, 9)) is None
    cache.write("shape", "ab12", MASK)
    np.testing.assert_array_equal(cache.read("shape", "ab12", (7, 9)), MASK)


def test_entry_of_another_size_counts_as_missing(tmp_path) -> None:
    cache = MaskCache(folder=tmp_path)
    cache.write("shape", "ab12", MASK)
    assert cache.read("shape", "ab12", (70, 9)) is None


def test_a_stack_names_what_is_missing_or_damaged(tmp_path) -> None:
    cache = MaskCache(folder=tmp_path)
    cache.write("foreground", "aa", MASK)
    cache.write("foreground", "bb", ~MASK)
    cache.write("foreground", "dd", MASK[:2])
    cache.write("foreground", "ee", MASK[:1, :1])
    arrays, missing = cache.read_stack("foreground", ["bb", "cc", "aa", "dd", "ee"], (7, 9))
    assert missing == [1, 3, 4]
    np.testing.assert_array_equal(arrays[[0, 2]], [~MASK, MASK])
    assert not arrays[missing].any()
    assert arrays.dtype == bool
    none, missing = cache.read_stack("foreground", [], (7, 9))
    assert none.shape == (0, 7, 9)
    assert missing == []


def write_often(folder: Path) -> None:
    for _ in range(50):
        MaskCache(folder=folder).write("shape", "ab12", MASK)


def test_several_writers_and_a_reader(tmp_path) -> None:
    write_often(tmp_path)
    writers = [get_context("fork").Process(target=write_often, args=(tmp_path,)) for _ in range(3)]
    for writer in writers:
        writer.start()
    for _ in range(100):
        np.testing.assert_array_equal(MaskCache(folder=tmp_path).read("shape", "ab12", (7, 9)), MASK)
    for writer in writers:
        writer.join()
        assert writer.exitcode == 0
    assert len(files(tmp_path)) == 1


def test_folder_that_cannot_be_written(tmp_path) -> None:
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(DataError, match=r"data\.dataset\.cache_dir="):
        MaskCache(folder=tmp_path / "file").write("shape", "ab12", MASK)


def test_digest_tells_values_shapes_and_types_apart() -> None:
    a = np.arange(6, dtype=np.float32)
    same = digest(1, a, "x")
    assert digest(1, a.copy(), "x") == same
    others = [
        digest(2, a, "x"),
        digest(1, a + 1, "x"),
        digest(1, a.reshape(2, 3), "x"),
        digest(1, a.astype(float), "x"),
    ]
    assert same not in others
    assert len(set(others)) == 4


def test_file_digest_follows_the_content_not_the_name(tmp_path) -> None:
    first, second = tmp_path / "a.obj", tmp_path / "b.obj"
    first.write_text("v 1 2 3")
    second.write_text("v 1 2 3")
    before = file_digest(first)
    assert before == file_digest(second)
    first.write_text("v 1 2 4")
    os.utime(first, ns=(1, 1))
    assert file_digest(first) != before


def test_file_digest_of_a_missing_file(tmp_path) -> None:
    with pytest.raises(DataError, match=r"a\.obj"):
        file_digest(tmp_path / "a.obj")
