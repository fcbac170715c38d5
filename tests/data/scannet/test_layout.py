# SPDX-License-Identifier: Apache-2.0
"""Every exported form is recognised, and what is not a scan is described."""

from __future__ import annotations

import shutil

import numpy as np
import pytest
import torch
from PIL import Image

from raytran.data.scannet.layout import FORMS, INNER_FOLDERS, Listing, find_layout, recognise
from raytran.data.scannet.scan import load_views, read_scan
from raytran.errors import DataError


@pytest.mark.parametrize("form", FORMS)
def test_every_form_reads_as_the_same_scan(scan_in_form, write_scan, tmp_path, form) -> None:
    folder = scan_in_form(form, tmp_path / "scans" / "scene0001_00")
    layout = find_layout(folder)
    assert layout.form == form
    assert layout.num_images() == 4
    scan, expected = read_scan(folder), read_scan(write_scan())
    assert scan.scene_id == "scene0001_00"
    assert [int(name) for name in scan.frame_id] == [0, 10, 20, 100]
    assert scan.dropped == {}
    torch.testing.assert_close(scan.world_from_camera, expected.world_from_camera, rtol=0, atol=0)
    torch.testing.assert_close(scan.intrinsics, expected.intrinsics, rtol=0, atol=0)
    assert scan.image_size == (32, 48)
    for index in range(4):
        assert scan.color_bytes(index) == expected.color_bytes(index)
        np.testing.assert_array_equal(scan.read_color(index), expected.read_color(index))
    views, frame_id = load_views(folder, image_size=(16, 24), num_views=2)
    assert [int(name) for name in frame_id] == [10, 100]
    assert views.images[0, :, 0, 8, 12].tolist() == [10, 100]


@pytest.mark.parametrize("form", FORMS)
def test_lost_poses_and_missing_files_in_every_form(scan_in_form, tmp_path, form) -> None:
    folder = scan_in_form(form, tmp_path / "scans" / "scene0001_00")
    layout = find_layout(folder)
    poses, images = layout.poses(), layout.images()
    names = sorted(poses, key=int)
    assert sorted(images, key=int) == names
    np.savetxt(poses[names[0]], np.full((4, 4), -np.inf))
    poses[names[1]].unlink()
    images[names[2]].unlink()
    assert read_scan(folder).dropped == {
        names[0]: "pose is not finite or out of bounds",
        names[1]: "no pose",
        names[2]: "no image",
    }


@pytest.mark.parametrize("inner", INNER_FOLDERS)
def test_frames_may_lie_in_a_folder_of_the_scan(scan_in_form, tmp_path, inner) -> None:
    scan_in_form("cpp", tmp_path / "scene0001_00")
    (tmp_path / "scene0002_00").mkdir()
    shutil.move(tmp_path / "scene0001_00", tmp_path / "scene0002_00" / inner)
    scan = read_scan(tmp_path / "scene0002_00")
    assert scan.scene_id == "scene0002_00"
    assert len(scan) == 4


@pytest.mark.parametrize(
    "name",
    [
        "intrinsic/intrinsic_color.txt",
        "intrinsics/intrinsic_color.txt",
        "intrinsics_color.txt",
        "intrinsic.txt",
    ],
)
@pytest.mark.parametrize("side", [3, 4])
def test_intrinsics_at_any_place_as_3x3_or_4x4(scan_in_form, tmp_path, name, side) -> None:
    folder = scan_in_form("exporter", tmp_path / "scene0001_00")
    matrix = np.loadtxt(folder / "intrinsic" / "intrinsic_color.txt")
    shutil.rmtree(folder / "intrinsic")
    (folder / name).parent.mkdir(exist_ok=True)
    np.savetxt(folder / name, matrix[:side, :side])
    np.testing.assert_array_equal(read_scan(folder).intrinsics[0].numpy(), matrix[:3, :3])


def test_intrinsics_of_odam_may_lie_outside_the_frames(scan_in_form, tmp_path) -> None:
    folder = scan_in_form("odam", tmp_path / "scene0001_00")
    shutil.move(folder / "frames" / "intrinsic", folder / "intrinsic")
    assert read_scan(folder).intrinsics[0, 0, 0] == 40


def test_info_file_without_intrinsics(scan_in_form, tmp_path) -> None:
    folder = scan_in_form("cpp", tmp_path / "scene0001_00")
    (folder / "_info.txt").write_text("m_colorWidth = 48\n")
    with pytest.raises(DataError, match=r"_info\.txt does not hold a 4x4 or 3x3 camera matrix"):
        read_scan(folder)
    (folder / "_info.txt").unlink()
    with pytest.raises(DataError, match=r"intrinsic_color\.txt is missing: write fx, fy, cx, cy"):
        read_scan(folder)


def test_depth_maps_beside_the_images_are_no_frames(scan_in_form, tmp_path) -> None:
    """Some exports in mmdetection3d's form keep ``<n>.png`` depth and its intrinsics in the same folder."""
    folder = scan_in_form("mmdetection3d", tmp_path / "scene0001_00")
    for number in (0, 7):
        Image.new("I;16", (8, 6)).save(folder / f"{number:05d}.png")
    np.savetxt(folder / "depth_intrinsic.txt", np.eye(4))
    scan = read_scan(folder)
    assert scan.frame_id == ("00000", "00010", "00020", "00100")
    assert scan.dropped == {}
    assert {path.suffix for path in scan.image_path} == {".jpg"}


def test_a_jpeg_goes_before_a_png_and_hidden_files_are_nothing(scan_in_form, tmp_path) -> None:
    folder = scan_in_form("exporter", tmp_path / "scene0001_00")
    Image.new("RGB", (48, 32)).save(folder / "color" / "0.png")
    (folder / "color" / "._10.jpg").write_bytes(b"left by another system")
    (folder / "color" / "Thumbs.db").write_bytes(b"")
    scan = read_scan(folder)
    assert scan.frame_id == ("0", "10", "20", "100")
    assert scan.image_path[0].name == "0.jpg"


def test_a_half_scan_is_recognised_and_its_missing_half_named(scan_in_form, tmp_path) -> None:
    folder = scan_in_form("exporter", tmp_path / "scene0001_00")
    shutil.rmtree(folder / "pose")
    assert recognise(Listing.of(folder)) is not None
    with pytest.raises(DataError, match="scene0001_00 has no folder pose: wanted are"):
        read_scan(folder)


def test_what_is_no_scan_is_described(tmp_path) -> None:
    for name in ("a.ply", "b.ply", "c.txt"):
        (tmp_path / name).write_text("")
    (tmp_path / "label").mkdir()
    with pytest.raises(
        DataError, match=r"holds the folder label, 2 files \.ply, 1 files \.txt, so no frames"
    ):
        find_layout(tmp_path)
    with pytest.raises(DataError, match=r"there is no scan folder .*nowhere"):
        find_layout(tmp_path / "nowhere")
