# SPDX-License-Identifier: Apache-2.0
"""A small ScanNet + ShapeNet + Scan2CAD to prepare."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path

import pytest

from raytran.data.prepare import PrepareSettings, Released, prepare_scan2cad

SETTINGS = PrepareSettings(image_size=(16, 24), max_frames=3)


@pytest.fixture
def released(write_scan, write_cube, write_annotations, cube_entry, tmp_path: Path) -> Path:
    """Three scans of four frames with a cube each; the third is for validation."""
    root = tmp_path / "released"
    scans = [f"scene000{n}_00" for n in range(3)]
    for scan in scans:
        write_scan(scan, root=root)
    write_cube(root=root)
    write_annotations(
        {scan: [cube_entry(translation=(3.0 + n / 2, 0, 1))] for n, scan in enumerate(scans)}, root
    )
    (root / "scannet" / "scannetv2_train.txt").write_text("scene0001_00\nscene0000_00\n")
    (root / "scannet" / "scannetv2_val.txt").write_text("scene0002_00\n")
    return root


@pytest.fixture
def prepare() -> Callable:
    """Call ``prepare_scan2cad`` on such a folder, small and in this process."""

    def call(released: Path, output: Path, **options):
        paths = {name: released / name for name in ("scannet", "shapenet", "scan2cad")}
        given = {field.name for field in fields(Released)} & options.keys()
        source = Released(**(paths | {name: options.pop(name) for name in given}))
        defaults = {"settings": SETTINGS, "processes": 1, "progress": False}
        return prepare_scan2cad(output, source, **(defaults | options))

    return call


@pytest.fixture
def digests() -> Callable[[Path], dict[str, str]]:
    """Return the content of every file below a folder, by its name."""

    def read(root: Path) -> dict[str, str]:
        return {
            str(path.relative_to(root)): hashlib.sha256(path.read_bytes()).hexdigest()
            for path in sorted(root.rglob("*"))
            if path.is_file()
        }

    return read
