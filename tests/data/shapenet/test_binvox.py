# SPDX-License-Identifier: Apache-2.0
"""Voxel files: order of the cells, round trip, damage and hostile sizes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from raytran.data.shapenet.binvox import read_binvox, write_binvox
from raytran.errors import DataError


def test_binvox_is_read_in_the_order_x_z_y(tmp_path: Path) -> None:
    # Of 2 × 2 × 2 cells, the file's second value is (x, y, z) = (0, 1, 0) and its third (0, 0, 1).
    header = b"#binvox 1\ndim 2 2 2\ntranslate -0.5 0 0.25\nscale 2\ndata\n"
    path = tmp_path / "two.binvox"
    path.write_bytes(header + bytes([0, 1, 1, 1, 0, 6]))
    cells, translate, scale = read_binvox(path)
    assert np.argwhere(cells).tolist() == [[0, 1, 0]]
    assert translate.tolist() == [-0.5, 0.0, 0.25]
    assert scale == 2.0


@pytest.mark.parametrize("share", [0.0, 0.002, 0.5, 1.0])
def test_binvox_round_trip(tmp_path: Path, share: float) -> None:
    cells = np.random.default_rng(0).random((20, 20, 20)) < share
    write_binvox(tmp_path / "a.binvox", cells, (0.1, -0.2, 1 / 3), np.float64(0.7))
    again, translate, scale = read_binvox(tmp_path / "a.binvox")
    np.testing.assert_array_equal(again, cells)
    assert translate.tolist() == [0.1, -0.2, 1 / 3]
    assert scale == 0.7


def test_damaged_voxels_are_named(tmp_path: Path) -> None:
    path = tmp_path / "a.binvox"
    with pytest.raises(DataError, match=r"cannot read the voxels .*a\.binvox"):
        read_binvox(path)
    write_binvox(path, np.ones((8, 8, 8), dtype=bool), (0, 0, 0), 1.0)
    whole = path.read_bytes()
    for content in (whole[:-2], whole[:-1], whole[:20], b"", whole.replace(b"scale", b"scald")):
        path.write_bytes(content)
        with pytest.raises(DataError, match=r"a\.binvox is damaged"):
            read_binvox(path)


@pytest.mark.parametrize("size", ["2 2 3", "3 3 3", "100000 100000 100000", "0 0 0", "-1 -1 -1", "2 2"])
def test_sizes_that_the_runs_do_not_fill_make_no_cells(tmp_path: Path, size: str) -> None:
    path = tmp_path / "a.binvox"
    header = f"#binvox 1\ndim {size}\ntranslate 0 0 0\nscale 1\ndata\n"
    path.write_bytes(header.encode() + bytes([1, 255]) * 2)
    with pytest.raises(DataError, match=r"a\.binvox is damaged \(its runs do not fill"):
        read_binvox(path)


def test_files_of_hostile_size_are_not_read(tmp_path: Path) -> None:
    path = tmp_path / "a.binvox"
    with path.open("wb") as file:  # a sparse file: it takes no room
        file.truncate(65 * 2**20)
    with pytest.raises(DataError, match=r"a\.binvox is damaged \(it is larger than 64 MB\)"):
        read_binvox(path)
