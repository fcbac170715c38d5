# SPDX-License-Identifier: Apache-2.0
"""Packed recordings are read as unpacked ones are; what an archive claims is not believed."""

from __future__ import annotations

import json
import shutil
import stat
import zipfile
from pathlib import Path

import numpy as np
import pytest

from raytran.capture.open import open_scene
from raytran.capture.orientation import WorldSettings
from raytran.capture.packed import unpack
from raytran.errors import DataError

from .forms import check_frames, write_colmap, write_transforms
from .test_arkit import write_polycam
from .test_record3d import metadata

KEPT = WorldSettings(check=False, up="+z")
BLIND = WorldSettings(check=False)


def pack(folder: Path, path: Path, *, inside: str = "") -> Path:
    """Pack a folder, with the files that macOS adds."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for file in sorted(folder.rglob("*")):
            name = f"{inside}{file.relative_to(folder).as_posix()}"
            archive.write(file, name)
            if file.is_file():
                archive.writestr(f"__MACOSX/{Path(name).parent}/._{file.name}", b"Mac OS X")
    return path


@pytest.fixture
def unpacked(monkeypatch, tmp_path):
    """The folder in which archives are unpacked."""
    folder = tmp_path / "unpacked"
    folder.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(folder))
    return folder


def test_a_recording_of_record3d(walk, unpacked):
    folder = walk.folder / "packed"
    (folder / "rgbd").mkdir(parents=True)
    (folder / "metadata").write_text(json.dumps(metadata(walk)))
    for name in walk.names:
        shutil.copy(walk.folder / "images" / name, folder / "rgbd" / name)
        (folder / "rgbd" / name).with_suffix(".depth").write_bytes(b"lzfse")
    path = pack(folder, walk.folder / "walk.r3d")
    with open_scene(path, settings=KEPT) as scan:
        assert (scan.scene_id, scan.path, scan.dropped) == ("walk", path, {})
        check_frames(scan, walk)
        assert scan.color_bytes(3) == (walk.folder / "images" / "3.png").read_bytes()
        assert not list(unpacked.rglob("*.depth"))
        assert not list(unpacked.rglob("._*"))
    assert not list(unpacked.iterdir())


@pytest.mark.parametrize("inside", ["", "walk/", "export/of/it/"])
def test_any_format_and_the_folders_around_it(walk, unpacked, inside):
    write_colmap(walk, walk.folder / "sparse" / "0", binary=True)
    with open_scene(pack(walk.folder, walk.folder.parent / "a.zip", inside=inside), settings=KEPT) as scan:
        check_frames(scan, walk)


def test_polycams_raw_data(walk, unpacked):
    folder = write_polycam(walk, walk.folder.parent / "log")
    with open_scene(pack(folder, walk.folder.parent / "room.zip"), settings=BLIND) as scan:
        np.testing.assert_allclose(scan.world_from_camera.numpy(), walk.poses, atol=1e-6)


def archive_of(path, *members, compression=zipfile.ZIP_DEFLATED):
    with zipfile.ZipFile(path, "w", compression) as archive:
        for name, content in members:
            archive.writestr(name, content)
    return path


@pytest.mark.parametrize(
    "name", ["/evil.json", "C:/evil.json", "a//evil.json", "\\evil.json", "a/../../evil.json"]
)
def test_nothing_is_written_outside(walk, unpacked, name):
    path = archive_of(walk.folder / "a.zip", ("transforms.json", "{}"), (name, "evil"))
    with pytest.raises(DataError):
        open_scene(path)
    assert not list(unpacked.iterdir())
    assert not list(walk.folder.parent.rglob("evil*"))


def test_a_link_is_no_link(walk, unpacked):
    secret = walk.folder.parent / "secret.json"
    write_transforms(walk).rename(secret)
    member = zipfile.ZipInfo("transforms.json")
    member.external_attr = (stat.S_IFLNK | 0o777) << 16
    path = archive_of(walk.folder / "a.zip", (member, str(secret)))
    with pytest.raises(DataError, match="no valid JSON"):
        open_scene(path)


def test_an_archive_that_claims_more_than_it_holds_is_refused(walk, unpacked):
    path = archive_of(walk.folder / "a.zip", *((f"{n}.png", bytes(2**20)) for n in range(80)))
    with pytest.raises(DataError, match=r"claims to hold 80 MB, which no recording does: unpack it yourself"):
        open_scene(path)
    assert not list(unpacked.iterdir())


@pytest.mark.parametrize("damage", ["cut", "empty", "text", "twice", "bzip2", "list"])
def test_damaged_and_foreign_archives_are_one_sentence(walk, unpacked, damage):
    path = archive_of(walk.folder / "a.zip", *((f"images/{n}.png", bytes(1000)) for n in range(9)))
    content = path.read_bytes()
    if damage == "cut":
        path.write_bytes(content[: len(content) // 2])
    elif damage == "empty":
        path.write_bytes(b"")
    elif damage == "text":
        path.write_text("no archive" * 100)
    elif damage == "twice":
        with pytest.warns(UserWarning, match="Duplicate name"):
            archive_of(path, ("a.json", "1"), ("a.json", "2"))
    elif damage == "bzip2":
        archive_of(path, ("a.json", "1"), compression=zipfile.ZIP_BZIP2)
    else:
        path.write_bytes(content[:-10] + b"\xff\xff\xff\x7f" + content[-6:])
    with pytest.raises(DataError, match=r"cannot unpack .*a\.zip .*: unpack it yourself and give the folder"):
        unpack(path)
    assert not list(unpacked.iterdir())
