# SPDX-License-Identifier: Apache-2.0
"""Scans and splits are found however a ScanNet root is nested."""

from __future__ import annotations

import logging
import os
import pickle
import shutil

import numpy as np
import pytest

from raytran.data.scannet.find import SOURCE_FORMS, find_scans, read_splits
from raytran.data.scannet.layout import FORMS
from raytran.errors import DataError


def forms(root) -> dict[str, list[str]]:
    return {name: [source.form for source in sources] for name, sources in find_scans(root).items()}


def write_header(folder, shift: float) -> None:
    matrix = np.eye(4)
    matrix[0, 3] = shift
    text = " ".join(f"{value:f}" for value in matrix.ravel())
    (folder / f"{folder.name}.txt").write_text(f"axisAlignment = {text}\n")


@pytest.fixture
def release(scan_in_form, write_sens, tmp_path):
    """A ScanNet root with recordings, test scans, posed images, the 25k frames, and meshes without frames."""
    root = tmp_path / "scannet"
    for name in ("scene0000_00", "scene0000_01"):
        write_sens(name, root=tmp_path)
        write_header(root / "scans" / name, 1.0)
    scan_in_form("exporter", root / "scans_test" / "scene0707_00")
    scan_in_form("mmdetection3d", root / "posed_images" / "scene0000_01")
    scan_in_form("frames_25k", root / "tasks" / "scannet_frames_25k" / "scene0000_01")
    scan_in_form("frames_25k", root / "tasks" / "scannet_frames_25k" / "scene0002_00")
    (root / "scans" / "scene0002_00" / "label-filt").mkdir(parents=True)
    (root / "scans" / "scene0002_00" / "scene0002_00_vh_clean_2.ply").write_text("ply")
    write_header(root / "scans" / "scene0002_00", 2.0)
    return root


def test_all_parts_of_a_release_are_found_the_best_source_first(release) -> None:
    expected = {
        "scene0000_00": ["sens"],
        "scene0000_01": ["sens", "mmdetection3d", "frames_25k"],
        "scene0002_00": ["frames_25k"],
        "scene0707_00": ["exporter"],
    }
    found = forms(release)
    assert found == expected
    assert list(found) == sorted(expected)
    assert forms(release.parent) == expected
    assert forms(release / "scans") == {"scene0000_00": ["sens"], "scene0000_01": ["sens"]}
    assert forms(release / "scans" / "scene0000_00") == {"scene0000_00": ["sens"]}
    assert forms(release / "scans" / "scene0000_00" / "scene0000_00.sens") == {"scene0000_00": ["sens"]}
    assert forms(release / "tasks") == {"scene0000_01": ["frames_25k"], "scene0002_00": ["frames_25k"]}
    assert forms(release / "scans_test" / "scene0707_00") == {"scene0707_00": ["exporter"]}


def test_the_header_may_lie_with_the_meshes(release) -> None:
    scans = find_scans(release)
    for name, shift in (("scene0002_00", 2.0), ("scene0000_01", 1.0), ("scene0707_00", 0.0)):
        for source in scans[name]:
            with source.open() as scan:
                assert scan.scene_id == name
                assert scan.axis_alignment[0, 3] == shift
    assert scans["scene0707_00"][0].header is None


def test_sources_open_read_and_count(release) -> None:
    for sources in find_scans(release).values():
        for source in pickle.loads(pickle.dumps(sources)):
            assert source.num_frames == 4
            with source.open() as scan:
                assert len(scan) == 4
                assert scan.read_color(3).shape == (32, 48, 3)
                assert scan.read_color(3, (16, 24)).shape == (16, 24, 3)
                assert (scan.color_bytes(0) or b"")[:2] == b"\xff\xd8"


@pytest.mark.parametrize("form", FORMS)
def test_one_scan_in_each_form_is_a_root_too(scan_in_form, tmp_path, form) -> None:
    folder = scan_in_form(form, tmp_path / "walks" / "my lounge")
    for root in (folder, folder.parent):
        assert forms(root) == {"my lounge": [form]}
    assert SOURCE_FORMS.index("frames_25k") == len(FORMS)


def test_frames_in_any_folder_of_a_scan_belong_to_it(scan_in_form, tmp_path) -> None:
    folder = scan_in_form("cpp", tmp_path / "scans" / "scene0001_00" / "unpacked")
    write_header(folder.parent, 3.0)
    (source,) = find_scans(tmp_path / "scans")["scene0001_00"]
    assert source.path == folder
    with source.open() as scan:
        assert (scan.scene_id, scan.axis_alignment[0, 3]) == ("scene0001_00", 3.0)


def test_recording_and_export_in_one_folder_are_two_sources(scan_in_form, write_sens, tmp_path) -> None:
    write_sens("scene0001_00", root=tmp_path)
    scan_in_form("exporter", tmp_path / "scannet" / "scans" / "scene0001_00")
    assert forms(tmp_path) == {"scene0001_00": ["sens", "exporter"]}


def test_recordings_need_no_folders_of_their_own(write_sens, tmp_path) -> None:
    flat = tmp_path / "flat"
    flat.mkdir()
    for name in ("scene0001_00", "scene0002_00"):
        shutil.move(write_sens(name), flat / f"{name}.sens")
    (flat / "scene0002_00.txt").write_text("axisAlignment = 1 0 0 5 0 1 0 0 0 0 1 0 0 0 0 1\n")
    scans = find_scans(flat)
    assert list(scans) == ["scene0001_00", "scene0002_00"]
    with scans["scene0002_00"][0].open() as scan:
        assert scan.axis_alignment[0, 3] == 5


def test_links_to_scans_count_and_links_back_up_do_not(scan_in_form, tmp_path) -> None:
    real = scan_in_form("exporter", tmp_path / "store" / "scene0001_00")
    scans = tmp_path / "root" / "scans"
    scans.mkdir(parents=True)
    (scans / "scene0001_00").symlink_to(real)
    (scans / "scene0002_00").symlink_to(real)
    (scans / "up").symlink_to(tmp_path / "root")
    (scans / "broken").symlink_to(tmp_path / "nowhere")
    assert forms(tmp_path / "root") == {"scene0001_00": ["exporter"], "scene0002_00": ["exporter"]}


@pytest.mark.parametrize("inside", [".", "frames"])
def test_a_folder_that_may_not_be_read_is_skipped_and_named(
    scan_in_form, tmp_path, monkeypatch, caplog, inside
) -> None:
    """The system refuses root nothing, so the refusal is acted."""
    scan_in_form("exporter", tmp_path / "scans" / "scene0001_00")
    locked = tmp_path / "scans" / "scene0002_00" / inside
    locked.mkdir(parents=True)
    scandir = os.scandir

    def refuse(path):
        if path == locked:
            raise PermissionError(13, "Permission denied", str(path))
        return scandir(path)

    monkeypatch.setattr("raytran.data.scannet.layout.os.scandir", refuse)
    with caplog.at_level(logging.WARNING):
        assert forms(tmp_path / "scans") == {"scene0001_00": ["exporter"]}
    assert f"cannot read the folder {locked} (Permission denied)" in caplog.text


def test_nothing_to_find(tmp_path) -> None:
    with pytest.raises(DataError, match=r"there is no folder .*nowhere: check the path of ScanNet"):
        find_scans(tmp_path / "nowhere")
    (tmp_path / "meshes").mkdir()
    with pytest.raises(DataError, match="holds the folder meshes, so no scans that can be read: wanted are"):
        find_scans(tmp_path)


def test_a_damaged_source_fails_only_when_opened(scan_in_form, write_sens, tmp_path) -> None:
    scan_in_form("exporter", tmp_path / "scannet" / "scans" / "scene0001_00")
    shutil.rmtree(tmp_path / "scannet" / "scans" / "scene0001_00" / "pose")
    write_sens("scene0002_00").write_bytes(b"an error page")
    scans = find_scans(tmp_path)
    with pytest.raises(DataError, match="scene0001_00 has no folder pose"):
        scans["scene0001_00"][0].open()
    with pytest.raises(DataError, match=r"scene0002_00\.sens is no \.sens recording"):
        scans["scene0002_00"][0].open()
    with pytest.raises(DataError, match=r"scene0002_00\.sens is no \.sens recording"):
        _ = scans["scene0002_00"][0].num_frames


@pytest.mark.parametrize("place", [".", "scannet", "scannet/meta_data", "scannet/tasks/benchmark"])
@pytest.mark.parametrize("root", [".", "scannet", "scannet/scans"])
def test_splits_below_and_beside_a_root(tmp_path, place, root) -> None:
    (tmp_path / "scannet" / "scans").mkdir(parents=True)
    (tmp_path / place).mkdir(parents=True, exist_ok=True)
    (tmp_path / place / "scannetv2_train.txt").write_text("scene0001_00\r\nscene0000_00\nscene0001_00\n\n")
    (tmp_path / place / "scannetv2_val.txt").write_text("scene0002_00")
    assert read_splits(tmp_path / root) == {
        "train": ["scene0001_00", "scene0000_00"],
        "val": ["scene0002_00"],
    }


def test_splits_that_are_missing_mixed_or_unreadable(tmp_path) -> None:
    root = tmp_path / "a" / "scannet"
    root.mkdir(parents=True)
    assert read_splits(root) == {}
    (root / "scannetv2_train.txt").write_text("scene0001_00\nscene0002_00\n")
    (root / "scannetv2_test.txt").write_text("scene0002_00\n")
    with pytest.raises(
        DataError, match=r"1 scans, the first is scene0002_00, are in the train split and in .*_test"
    ):
        read_splits(root)
    for content in (b"\xff\xfe\x00", b"scene\xff", b"s" * 1000, b"scene\x1b[2J"):
        (root / "scannetv2_test.txt").write_bytes(content)
        with pytest.raises(DataError, match=r"scannetv2_test\.txt"):
            read_splits(root)


def test_real_root(shared_dir) -> None:
    scans = find_scans(shared_dir / "realdata" / "scene0470_00")
    assert list(scans) == ["scene0470_00"]
    (source,) = scans["scene0470_00"]
    assert (source.form, source.num_frames) == ("exporter", 62)
    with source.open() as scan:
        assert sorted(scan.dropped) == ["255", "605"]
        assert scan.axis_alignment[0, 1].item() == 0.075005
