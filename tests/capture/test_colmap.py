# SPDX-License-Identifier: Apache-2.0
"""COLMAP models, binary and text, whole and damaged."""

from __future__ import annotations

import shutil
from dataclasses import replace

import numpy as np
import pytest

from raytran.capture.colmap import find_model, read_colmap
from raytran.capture.recording import open_recording
from raytran.errors import ConfigError, DataError

from .forms import check_frames, write_colmap


@pytest.mark.parametrize("binary", [True, False])
def test_cameras_and_images_are_those_that_were_written(walk, binary):
    write_colmap(walk, walk.folder / "sparse" / "0", binary=binary)
    scan = open_recording(read_colmap(walk.folder))
    assert scan.scene_id == "walk"
    assert scan.frame_id == tuple(str(n) for n in range(12))
    np.testing.assert_allclose(scan.world_from_camera.numpy(), walk.poses, atol=1e-12)
    assert scan.intrinsics[0].numpy()[[0, 1, 0, 1], [0, 1, 2, 2]].tolist() == list(walk.camera)
    assert scan.image_size == (48, 64)
    assert scan.read_color(7)[0, 0].tolist() == [140] * 3
    assert scan.color_bytes(7) == (walk.folder / "images" / "7.png").read_bytes()


@pytest.mark.parametrize("binary", [True, False])
def test_pycolmap_reads_the_same(walk, binary, tmp_path):
    pycolmap = pytest.importorskip("pycolmap", reason="pycolmap, the oracle, is not installed")
    folder = walk.folder / "sparse" / "0"
    write_colmap(
        walk, folder, binary=binary, model="OPENCV", parameters=[*walk.camera, -0.1, 0.02, 0.001, 0.002]
    )
    for ending in ("bin", "txt"):
        (folder / f"points3D.{ending}").write_bytes(b"\0" * 8 if ending == "bin" else b"")
    # Its own reader, and what its own writer writes, in the form of its release (with rigs and frames).
    model = pycolmap.Reconstruction(str(folder))
    (tmp_path / "again").mkdir()
    (model.write_text if binary else model.write_binary)(str(tmp_path / "again"))
    for place in (folder, tmp_path / "again"):
        frames = {frame.image.name: frame for frame in read_colmap(place).frames}
        assert len(frames) == len(model.images) == 12
        for image in model.images.values():
            inverse = np.linalg.inv(frames[image.name].world_from_camera)[:3]
            np.testing.assert_allclose(inverse, image.cam_from_world().matrix(), atol=1e-9)


def test_the_model_is_found_where_tools_put_it(walk):
    for place in ("sparse/0", "colmap/sparse/0", "sparse"):
        write_colmap(walk, walk.folder / place, binary=True)
        assert find_model(walk.folder) == walk.folder / place
        # The folder of the model itself may be given: images are found above it.
        assert len(open_recording(read_colmap(walk.folder / place))) == 12
        shutil.rmtree(walk.folder / place.split("/")[0])
    assert find_model(walk.folder) is None


def test_of_several_models_the_largest_is_read(walk):
    few = replace(walk, names=walk.names[:3], poses=walk.poses[:3])
    write_colmap(few, walk.folder / "sparse" / "0", binary=True)
    write_colmap(walk, walk.folder / "sparse" / "1", binary=True)
    assert len(read_colmap(walk.folder).frames) == 12


def test_images_without_poses_and_poses_without_images_are_counted(walk):
    write_colmap(walk, walk.folder / "sparse" / "0", binary=True)
    (walk.folder / "images" / "3.png").unlink()
    shutil.copy(walk.folder / "images" / "4.png", walk.folder / "images" / "99.png")
    scan = open_recording(read_colmap(walk.folder))
    assert scan.dropped == {"3": "no image", "99": "no pose"}
    assert len(scan) == 11


def test_smaller_copies_of_the_images_scale_the_lens(walk):
    large = replace(walk, image_size=(96, 128), camera=tuple(2 * value for value in walk.camera))
    write_colmap(large, walk.folder / "sparse" / "0", binary=False)
    scan = open_recording(read_colmap(walk.folder))
    assert scan.image_size == (48, 64)
    assert scan.intrinsics[0, 0, 0].item() == pytest.approx(walk.camera[0])


def test_a_lens_that_distorts_is_resampled(walk):
    write_colmap(
        walk, walk.folder / "sparse" / "0", binary=True, model="SIMPLE_RADIAL", parameters=[50, 31, 25, 0.2]
    )
    scan = open_recording(read_colmap(walk.folder))
    assert scan.color_bytes(0) is None
    assert scan.read_color(5, (24, 32)).shape == (24, 32, 3)
    assert scan.intrinsics[0, 0, 0].item() > 50


@pytest.mark.parametrize("binary", [True, False])
@pytest.mark.parametrize(
    ("model", "params"),
    [
        ("OPENCV_FISHEYE", [50, 50, 32, 24, 0.1, 0, 0, 0]),
        ("SIMPLE_RADIAL_FISHEYE", [50, 32, 24, 0.1]),
        ("RAD_TAN_THIN_PRISM_FISHEYE", [50, 50, 32, 24, 0.1, *[0.001] * 11]),
    ],
)
def test_fisheyes_are_resampled(walk, binary, model, params):
    write_colmap(walk, walk.folder / "sparse" / "0", binary=binary, model=model, parameters=params)
    scan = open_recording(read_colmap(walk.folder))
    assert scan.color_bytes(0) is None
    assert scan.read_color(5)[24, 32].tolist() == [100] * 3
    # A fisheye of the same focal length sees more than a pinhole, so no corner is empty without zooming.
    assert scan.intrinsics[0, 0, 0].item() == 50


@pytest.mark.parametrize("binary", [True, False])
def test_the_cameras_of_a_rig_get_poses_of_their_own(walk, binary, tmp_path):
    """Four frames of a rig with two cameras, as pycolmap writes it: the second looks to the side."""
    pycolmap = pytest.importorskip("pycolmap")
    rig = pycolmap.Rig(rig_id=1)
    model = pycolmap.Reconstruction()
    for number in (1, 2):
        camera = pycolmap.Camera(
            camera_id=number, model="PINHOLE", width=64, height=48, params=list(walk.camera)
        )
        model.add_camera(camera)
    side_from_front = np.c_[np.array([[0.0, 0, -1], [0, 1, 0], [1, 0, 0]]), [0.1, 0.0, 0.05]]
    rig.add_ref_sensor(model.cameras[1].sensor_id)
    rig.add_sensor(model.cameras[2].sensor_id, pycolmap.Rigid3d(side_from_front))
    model.add_rig(rig)
    expected = {}
    (walk.folder / "images" / "side").mkdir()
    for n in range(4):
        frame = pycolmap.Frame(frame_id=n + 1, rig_id=1)
        names = (f"{n}.png", f"side/{n}.png")
        images = [
            pycolmap.Image(image_id=2 * n + k, name=names[k], camera_id=k + 1, frame_id=n + 1) for k in (0, 1)
        ]
        for image in images:
            frame.add_data_id(image.data_id)
        front = np.linalg.inv(walk.poses[n])
        frame.rig_from_world = pycolmap.Rigid3d(front[:3])
        model.add_frame(frame)
        for image in images:
            model.add_image(image)
        model.register_frame(n + 1)
        shutil.copy(walk.folder / "images" / names[0], walk.folder / "images" / names[1])
        expected[f"{n}"] = walk.poses[n]
        expected[f"side_{n}"] = np.linalg.inv(np.vstack([side_from_front, [0, 0, 0, 1]]) @ front)
    folder = walk.folder / "sparse" / "0"
    folder.mkdir(parents=True)
    (model.write_binary if binary else model.write_text)(str(folder))
    assert (folder / f"rigs.{'bin' if binary else 'txt'}").is_file()
    scan = open_recording(read_colmap(walk.folder))
    assert set(scan.frame_id) == set(expected)
    for name, pose in zip(scan.frame_id, scan.world_from_camera.numpy(), strict=True):
        np.testing.assert_allclose(pose, expected[name], atol=1e-9)


def test_every_cut_of_a_binary_file_is_one_sentence(walk):
    folder = walk.folder / "sparse" / "0"
    write_colmap(walk, folder, binary=True)
    for name in ("cameras.bin", "images.bin"):
        whole = (folder / name).read_bytes()
        for length in (0, 7, 8, 11, 40, len(whole) // 2, len(whole) - 1):
            (folder / name).write_bytes(whole[:length])
            with pytest.raises(DataError, match=f"{name} ends early or is damaged: export the model again"):
                read_colmap(walk.folder)
        (folder / name).write_bytes(whole)
    # A count that no file can hold is not believed.
    (folder / "images.bin").write_bytes(b"\xff" * 7 + whole[7:])
    with pytest.raises(DataError, match="ends early"):
        read_colmap(walk.folder)


def test_random_damage_is_one_sentence_or_another_model(walk):
    rng = np.random.default_rng(0)
    folder = walk.folder / "sparse" / "0"
    lens = {"model": "OPENCV_FISHEYE", "parameters": [50, 50, 32, 24, 0.01, 0.01, 0.01, 0.01]}
    refused: list[str] = []
    for case in range(60):
        write_colmap(walk, folder, binary=case % 3 > 0, **lens)
        path = sorted(folder.iterdir())[int(rng.integers(2))]
        content = bytearray(path.read_bytes())
        for at in rng.integers(len(content), size=4):
            content[at] = rng.integers(256)
        path.write_bytes(content)
        try:
            read_colmap(walk.folder)
        except DataError as error:
            refused.append(str(error))
        shutil.rmtree(folder)
    assert len(refused) > 20
    assert not any("\n" in message for message in refused)


@pytest.mark.parametrize("binary", [True, False])
@pytest.mark.usefixtures("without_pycolmap")
def test_pinholes_are_read_without_pycolmap_and_others_ask_for_it(walk, binary):
    write_colmap(walk, walk.folder / "sparse" / "0", binary=binary)
    assert len(open_recording(read_colmap(walk.folder))) == 12
    lens = {"model": "SIMPLE_RADIAL", "parameters": [50, 31, 25, 0.2]}
    write_colmap(walk, walk.folder / "other", binary=binary, **lens)
    with pytest.raises(ConfigError, match=r"not installed: pip install 'raytran\[colmap\]'$"):
        read_colmap(walk.folder / "other")


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("cameras.txt", "1 PINHOLE 64 48 50 51\n", "2 parameters for PINHOLE, not 4"),
        ("cameras.txt", "one PINHOLE 64 48 50 51 31 25\n", "line 1 of .*cameras.txt is no camera"),
        ("cameras.txt", "2 PINHOLE 64 48 50 51 31 25\n", "camera 1, which cameras.txt does not have"),
        ("cameras.txt", "1 PINHOLE 100000 100000 50 51 50000 50000\n", "images of 100000x100000"),
        ("images.txt", "1 1 0 0 0 0 0 x 1 0.png\n\n", "line 1 of .*images.txt is no image"),
        ("images.txt", "1 1 0 0 0 0 0 0 1\n\n", "line 1 of .*images.txt is no image"),
        ("images.txt", "# nothing\n", "holds no images: COLMAP registered none"),
        ("images.txt", "1 1 0 0 0 0 0 0 1 ../../secret.png\n\n", "which is outside .*relative paths"),
        ("images.txt", "1 1 0 0 0 0 0 0 1 /etc/secret.png\n\n", "which is outside .*relative paths"),
    ],
)
def test_what_is_wrong_in_text_is_named(walk, name, text, message):
    folder = walk.folder / "sparse" / "0"
    write_colmap(walk, folder, binary=False)
    (folder / name).write_text(text)
    with pytest.raises(DataError, match=message):
        open_recording(read_colmap(walk.folder))


def test_no_model_and_no_images(walk):
    with pytest.raises(DataError, match="holds no COLMAP model: wanted are cameras and images"):
        read_colmap(walk.folder)
    write_colmap(walk, walk.folder / "sparse" / "0", binary=True)
    shutil.rmtree(walk.folder / "images")
    with pytest.raises(DataError, match=r"none of the 12 frames .*\(12 no image\): check that its images"):
        open_recording(read_colmap(walk.folder))


def test_images_of_another_shape_are_refused(walk):
    write_colmap(
        replace(walk, image_size=(64, 48), camera=(50, 51, 25, 31)), walk.folder / "sparse", binary=True
    )
    with pytest.raises(
        DataError, match=r"image 0 is 64x48 and its intrinsics .* for 48x64, turned by 90°: give"
    ):
        open_recording(read_colmap(walk.folder))


def test_a_focal_length_that_is_off_is_its_own(walk):
    """A camera per image, as COLMAP makes them by default; one has found another focal length."""
    folder = walk.folder / "sparse" / "0"
    write_colmap(walk, folder, binary=False, model="SIMPLE_RADIAL", parameters=[50, 32, 24, 0], cameras=12)
    lines = (
        (folder / "cameras.txt")
        .read_text()
        .replace("\n7 SIMPLE_RADIAL 64 48 50.0", "\n7 SIMPLE_RADIAL 64 48 56.0")
    )
    (folder / "cameras.txt").write_text(lines)
    scan = open_recording(read_colmap(walk.folder))
    assert scan.dropped == {}
    assert scan.intrinsics[:, 0, 0].tolist() == [56.0 if n == 6 else 50.0 for n in range(12)]
    assert all(scan.color_bytes(n) is not None for n in range(12))


@pytest.mark.parametrize(
    ("place", "images"),
    [
        ("sparse/0/models/1", "images"),
        ("sparse/1", "images"),
        ("dense/0/sparse", "dense/0/images"),
        ("dense/sparse", "dense/images"),
        ("colmap/sparse/0", "images"),
        ("models/2", "images"),
        ("0/sparse", "0/images"),
    ],
)
@pytest.mark.parametrize("binary", [True, False])
def test_models_and_images_where_programs_put_them(walk, place, images, binary):
    few = replace(walk, names=walk.names[:2], poses=walk.poses[:2])
    if place == "sparse/0/models/1":
        write_colmap(few, walk.folder / "sparse" / "0", binary=binary)
    write_colmap(walk, walk.folder / place, binary=binary)
    if images != "images":
        shutil.copytree(walk.folder / "images", walk.folder / images)
        for path in (walk.folder / "images").iterdir():
            path.write_bytes(b"distorted, so not of this model")
    scan = open_recording(read_colmap(walk.folder))
    assert (scan.scene_id, len(scan)) == ("walk", 12)
    check_frames(scan, walk)


def test_the_largest_model_is_that_of_most_images(walk):
    few = replace(walk, names=walk.names[:2], poses=walk.poses[:2])
    write_colmap(few, walk.folder / "sparse" / "0", binary=False)
    # Observed points make a list long, not a model large.
    listed = walk.folder / "sparse" / "0" / "images.txt"
    listed.write_text(listed.read_text().replace("7\n", "7" + " 1.5 2.5 -1" * 5000 + "\n"))
    write_colmap(walk, walk.folder / "sparse" / "1", binary=True)
    assert len(read_colmap(walk.folder).frames) == 12
    write_colmap(walk, walk.folder / "sparse" / ".ipynb_checkpoints", binary=True)
    assert find_model(walk.folder) == walk.folder / "sparse" / "1"


def test_text_without_its_empty_lines_loses_no_frame(walk):
    write_colmap(walk, walk.folder / "sparse" / "0", binary=False)
    listed = walk.folder / "sparse" / "0" / "images.txt"
    lines = listed.read_text().splitlines()
    for kept in (
        [line for line in lines if line],  # only the empty ones are gone
        [line for line in lines if line.endswith(".png")],
        [line for line in lines if line.endswith(".png") or "7" in line][:-1],
    ):
        listed.write_text("\n".join(kept) + "\n")
        check_frames(open_recording(read_colmap(walk.folder)), walk)


def test_points_are_no_images_and_names_may_be_numbers(walk):
    for n in range(12):
        (walk.folder / "images" / f"{n}.png").rename(walk.folder / "images" / f"{n:04d}.png")
    write_colmap(
        replace(walk, names=tuple(f"{n:04d}" for n in range(12))), walk.folder / "sparse", binary=False
    )
    listed = walk.folder / "sparse" / "images.txt"
    listed.write_text(listed.read_text().replace("1.5 2.5 -1 3.0 4.0 7", "15 25 -1 30 40 7 1 2 3 4 5 6"))
    check_frames(open_recording(read_colmap(walk.folder)), walk)


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
def test_text_of_windows_programs(walk, encoding):
    write_colmap(walk, walk.folder / "sparse" / "0", binary=False)
    for name in ("cameras.txt", "images.txt"):
        path = walk.folder / "sparse" / "0" / name
        path.write_text(path.read_text().partition("\n")[2].replace("\n", "\r\n"), encoding=encoding)
    check_frames(open_recording(read_colmap(walk.folder)), walk)


def test_a_model_of_a_windows_machine(walk, caplog):
    caplog.set_level("INFO")
    (walk.folder / "images" / "cam0").mkdir()
    for name in walk.names:
        (walk.folder / "images" / name).rename(walk.folder / "images" / "cam0" / name.replace(".png", ".PNG"))
    moved = replace(walk, names=tuple(f"cam0\\{name}" for name in walk.names))
    write_colmap(moved, walk.folder / "sparse" / "0", binary=True)
    scan = open_recording(read_colmap(walk.folder))
    assert scan.frame_id[11] == "cam0_11"
    check_frames(scan, walk)
    assert r"12 images were found under other spellings than it gives, e.g. cam0/11.PNG for cam0\11.png" in (
        caplog.text
    )


def test_frames_of_two_folders_get_unlike_names(walk):
    for folder in ("left_1", "left"):
        (walk.folder / "images" / folder).mkdir()
    names = tuple(f"left_1/{n // 2}.png" if n % 2 else f"left/1_{n // 2}.png" for n in range(12))
    for old, new in zip(walk.names, names, strict=True):
        (walk.folder / "images" / old).rename(walk.folder / "images" / new)
    write_colmap(replace(walk, names=names), walk.folder / "sparse" / "0", binary=True)
    scan = open_recording(read_colmap(walk.folder))
    assert len({name.lower() for name in scan.frame_id}) == 12
    check_frames(scan, walk)


def test_damage_to_one_frame_leaves_that_one_out(walk):
    write_colmap(walk, walk.folder / "sparse" / "0", binary=False, cameras=12)
    cameras, images = (walk.folder / "sparse" / "0" / f"{name}.txt" for name in ("cameras", "images"))
    lines = cameras.read_text().splitlines()
    lines[3] = lines[3].replace("50.0", "-50.0")  # camera 3, of image 2
    lines[5] = "5 PINHOLE wide"  # camera 5, of image 4
    cameras.write_text("\n".join(lines))
    rows = images.read_text().splitlines()
    at = next(i for i, row in enumerate(rows) if row.endswith(" 7.png"))
    rows[at] = rows[at].replace(rows[at].split()[2], "north")
    images.write_text("\n".join(rows))
    scan = open_recording(read_colmap(walk.folder))
    assert scan.dropped == {
        "2": "focal lengths and centre not positive and finite",
        "4": "impossible intrinsics",
        "7": "no pose",
        f"line {at + 1}": "entry is damaged",
    }
    check_frames(scan, walk, [0, 1, 3, 5, 6, 8, 9, 10, 11])


def test_typed_intrinsics_come_first(walk):
    write_colmap(walk, walk.folder / "sparse" / "0", binary=True, model="OPENCV_FISHEYE", parameters=[9] * 8)
    scan = open_recording(read_colmap(walk.folder, walk.camera))
    assert scan.lens[3].focal == (50.0, 51.0)
    check_frames(scan, walk)


@pytest.mark.parametrize("binary", [True, False])
def test_names_in_the_letters_of_windows(walk, binary):
    (walk.folder / "images" / "3.png").rename(walk.folder / "images" / "küche.png")
    names = tuple("k#che.png" if name == "3.png" else name for name in walk.names)
    write_colmap(replace(walk, names=names), walk.folder / "sparse" / "0", binary=binary)
    for path in (walk.folder / "sparse" / "0").iterdir():
        path.write_bytes(path.read_bytes().replace(b"k#che", "küche".encode("cp1252")))
    check_frames(open_recording(read_colmap(walk.folder)), walk)


def test_a_name_that_is_too_long_for_a_file_has_no_image(walk):
    names = ("9" * 300 + ".png", "9" * 300 + "/1.png", *walk.names[2:])
    write_colmap(replace(walk, names=names), walk.folder / "sparse" / "0", binary=True)
    scan = open_recording(read_colmap(walk.folder))
    check_frames(scan, walk, range(2, 12))
    assert sorted(scan.dropped.values()) == ["no image", "no image", "no pose", "no pose"]
