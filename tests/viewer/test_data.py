# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json
import pickle
import tracemalloc
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from raytran.errors import DataError
from raytran.geometry.grid import VoxelGrid
from raytran.structs import Views
from raytran.viewer.attention_record import observe_attention
from raytran.viewer.data import (
    VoxelVolume,
    find_scenes,
    predicted_volumes,
    read_viewer_scene,
    write_viewer_data,
)

from ..factories import make_model, make_views
from .conftest import make_views as make_room_views
from .conftest import write_result


def predict(model, views, **settings):
    with observe_attention(model) as observed:
        prediction = model.predict(views, with_shapes=False, **settings)
    return prediction, observed


def sums(reads):
    """Return the sum of each voxel's weights, of those that read something."""
    total = np.array([reads.of_voxel(v).weight.sum() for v in range(len(reads.offsets) - 1)])
    return total[total > 0]


@pytest.fixture(scope="module")
def model():
    return make_model()


def test_what_voxels_read_is_told_the_same_in_chunks(model):
    views = make_views(1, 3)
    whole, chunked = (
        predicted_volumes(model, views, *predict(model, views, views_at_once=at_once))[0]
        for at_once in (None, 2)
    )
    assert whole.grid.resolution == tuple(whole.occupancy.shape) == model.grid_resolution
    assert sums(whole.reads) == pytest.approx(1)
    flat = int(whole.grid.flat_index(whole.view_count.nonzero()[0]))
    for voxel in (flat, flat + 1):
        one, other = whole.reads.of_voxel(voxel), chunked.reads.of_voxel(voxel)
        dense = [np.zeros(3 * 2 * 3) for _ in range(2)]
        for array, pixels in zip(dense, (one, other), strict=True):
            array[(pixels.view * 2 + pixels.row) * 3 + pixels.column] = pixels.weight
        np.testing.assert_allclose(*dense, atol=0.01)
    read = np.diff(whole.reads.offsets).reshape(model.grid_resolution) > 0
    assert np.array_equal(whole.view_count.numpy() > 0, read)


def test_volumes_of_a_large_room_each_say_what_they_read(model):
    views = make_views(1, 4)
    centers = [torch.tensor([0.0, 0.0, 0.5]), torch.tensor([0.4, 0.0, 0.5])]
    parts = [(centers[0], [0, 1, 2]), (centers[1], [3, 2])]
    with observe_attention(model) as observed:
        for center, frames in parts:
            some = Views(
                views.images[:, frames], views.intrinsics[:, frames], views.world_from_camera[:, frames]
            )
            prediction = model.predict(some, with_shapes=False, grid_center=center)
    whole, *tiles = predicted_volumes(model, views, prediction, observed, parts=parts)
    assert whole.reads is None
    assert [list(tile.frames) for tile in tiles] == [[0, 1, 2], [3, 2]]
    assert [tile.grid.center.tolist() for tile in tiles] == [center.tolist() for center in centers]
    for tile in tiles:
        assert sums(tile.reads) == pytest.approx(1)


def test_a_network_without_rays_has_voxels_all_the_same(model):
    views = make_views(1, 2)
    prediction, _ = predict(model, views)
    (volume,) = predicted_volumes(model, views, prediction, None)
    assert volume.reads is None


def test_a_result_comes_back_as_it_was_written(result):
    scene = read_viewer_scene(result)
    assert (scene.scene_id, scene.frame_ids[1]) == ("room", "000010")
    assert [image.shape for image in scene.images] == [(48, 64, 3)] * 5
    assert (np.abs(scene.images[2][..., 1].astype(int) - 80) < 3).all()  # see make_views; JPEG rounds
    assert scene.cameras.position[0].tolist() == pytest.approx([3.5, 0.0, 1.6])
    assert scene.cameras.image_size == (48, 64)
    assert [len(mesh.faces) for mesh in scene.meshes] == [320] * 6
    (volume,) = scene.volumes
    assert volume.grid.resolution == (16, 16, 6)
    assert volume.occupancy.unique().tolist() == pytest.approx([0.0, 230 / 255])
    assert volume.view_count.max() == 5
    assert len(scene.truth) == 6
    assert [error.found for error in scene.errors] == [True, *[False] * 5]
    assert [error.translation for error in scene.errors] == pytest.approx([0.0, *[0.3] * 5], abs=1e-6)


def test_pictures_of_filled_up_frames_come_back(tmp_path):
    folder, views = write_result(tmp_path / "room"), make_room_views(5, (48, 64))
    assert read_viewer_scene(folder).cameras.picture is None
    picture = torch.tensor([14.0, 0.0, 50.0, 48.0]).repeat(1, 5, 1)
    write_viewer_data(folder, replace(views, picture=picture), list("abcde"), volumes=[])
    scene = read_viewer_scene(folder)
    assert torch.equal(scene.cameras.picture, picture[0].double())
    assert scene.camera(2).picture.tolist() == [14, 0, 50, 48]


def test_a_voxel_of_a_filled_up_frame_reads_nothing_beside_its_picture(model):
    views = make_views(1, 3)
    part = replace(views, picture=torch.tensor([16.0, 0.0, 32.0, 32.0]).repeat(1, 3, 1))
    (volume,) = predicted_volumes(model, part, *predict(model, part))
    read = np.diff(volume.reads.offsets).reshape(model.grid_resolution) > 0
    assert np.array_equal(volume.view_count.numpy() > 0, read)
    columns = [volume.reads.of_voxel(v).column for v in np.flatnonzero(read.ravel())]
    assert set(np.concatenate(columns).tolist()) == {1}


def test_a_voxel_names_the_pixels_that_read_it(result):
    scene = read_viewer_scene(result)
    volume = scene.volumes[0]
    point = np.array([1.2, -0.3, 0.2])
    voxel = volume.voxel_at(point)
    assert voxel == (10, 7, 1)
    pixels = volume.pixels_of(voxel)
    assert pixels.weight.sum() == pytest.approx(1)
    # Each cell that was read looks at the voxel: it is no further off than cell and voxel are large.
    for view, row, column in zip(pixels.view, pixels.row, pixels.column, strict=True):
        camera = scene.camera(view)
        center = volume.grid.voxel_centers()[voxel]
        (u, v), depth = (value[0] for value in camera.project(center[None]))
        reach = 12 + 0.5 * float(camera.intrinsics[0, 0]) / float(depth)
        assert abs(float(u) - 16 * (column + 0.5)) < reach
        assert abs(float(v) - 16 * (row + 0.5)) < reach
    assert volume.voxel_at(np.array([9.0, 0, 0])) is None


def test_in_a_large_room_the_nearest_volume_tells_what_was_read(tmp_path):
    scene = read_viewer_scene(write_result(tmp_path / "room", in_parts=True))
    assert len(scene.volumes) == 3
    left, right = (scene.volume_at(np.array([x, 0.0, 0.5])) for x in (-2.0, 2.0))
    assert (left, right) == (scene.volumes[1], scene.volumes[2])
    busiest = np.unravel_index(np.diff(right.reads.offsets).argmax(), right.grid.resolution)
    frames = set(right.pixels_of(tuple(int(i) for i in busiest)).view.tolist())
    assert frames
    assert frames <= {2, 3, 4}
    assert scene.volume_at(np.array([0.0, 0.0, 50.0])) is None


def test_a_result_without_the_viewers_file_has_objects_alone(tmp_path):
    scene = read_viewer_scene(write_result(tmp_path / "room", with_viewer=False))
    assert (len(scene.objects), len(scene.meshes), scene.images, scene.volumes) == (6, 6, [], [])
    assert scene.truth is None
    assert scene.errors == [None] * 6


def test_the_same_input_gives_the_same_bytes(tmp_path):
    written = [write_result(tmp_path / name / "room") / "viewer.npz" for name in ("one", "two")]
    assert written[0].read_bytes() == written[1].read_bytes()


def test_frames_are_made_small_and_masks_left_out(tmp_path, generator):
    images = torch.rand(1, 1, 4, 600, 800, generator=generator)
    views = Views(images, torch.eye(3)[None, None], torch.eye(4)[None, None])
    volume = VoxelVolume(VoxelGrid((2, 2, 1), (4.0, 4.0, 2.0), torch.zeros(3)), [0])
    with np.load(write_viewer_data(tmp_path, views, ["a/b"], volumes=[volume])) as file:
        about = json.loads(file["about"].tobytes())
        assert about["format"] == "raytran.viewer/1"
        assert about["frame_ids"] == ["a/b"]
        assert file["frame0"][:2].tobytes() == b"\xff\xd8"
        assert not [name for name in file if name.startswith(("truth", "volume"))]


@pytest.mark.parametrize("damage", [b"", b"PK\x03\x04", b"no archive", "another format", "a missing part"])
def test_a_damaged_file_is_one_sentence(tmp_path, damage):
    folder = write_result(tmp_path / "room")
    path = folder / "viewer.npz"
    if isinstance(damage, bytes):
        path.write_bytes(damage)
    else:
        with np.load(path) as file:
            arrays = dict(file)
        if damage == "another format":
            about = json.loads(arrays["about"].tobytes()) | {"format": "raytran.viewer/9"}
            arrays["about"] = np.frombuffer(json.dumps(about).encode(), dtype=np.uint8)
        else:
            del arrays["volume0_steps"]
        np.savez(path, **arrays)
    with pytest.raises(DataError, match=r"cannot read .*viewer\.npz \(.*\): predict again"):
        read_viewer_scene(folder)


def test_a_damaged_mesh_is_one_sentence(tmp_path):
    folder = write_result(tmp_path / "room")
    (folder / "meshes" / "03.ply").write_bytes(b"ply\n")
    with pytest.raises(DataError, match=r"cannot read the mesh .*03\.ply"):
        read_viewer_scene(folder)


def test_one_result_or_many(tmp_path):
    for name in ("a/room", "b/deep/hall", ".hidden", "a/room/inside"):
        (tmp_path / name).mkdir(parents=True, exist_ok=True)
        (tmp_path / name / "scene.json").write_text("{}")
    assert find_scenes(tmp_path / "a" / "room") == {"room": tmp_path / "a" / "room"}
    assert find_scenes(tmp_path) == {
        "a/room": tmp_path / "a" / "room",
        "b/deep/hall": tmp_path / "b" / "deep" / "hall",
    }


def test_nothing_to_show(tmp_path):
    with pytest.raises(DataError, match=r"nowhere: give the output folder of `raytran predict`"):
        find_scenes(tmp_path / "nowhere")
    with pytest.raises(DataError, match=r"holds no scene\.json"):
        find_scenes(tmp_path)


def replaced(path: Path, name: str, values: object) -> None:
    """Write a viewer file again with another array, or with bytes in place of one."""
    with np.load(path) as file:
        arrays = dict(file)
    if isinstance(values, dict):
        about = json.loads(arrays["about"].tobytes()) | values
        arrays["about"] = np.frombuffer(json.dumps(about).encode(), np.uint8)
    elif not isinstance(values, bytes):
        arrays[name] = np.asarray(values)
    np.savez_compressed(path, **arrays)
    if isinstance(values, bytes):
        with zipfile.ZipFile(path) as archive:
            parts = {part: archive.read(part) for part in archive.namelist()}
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
            for part, content in (parts | {f"{name}.npy": values}).items():
                archive.writestr(part, content)


HUGE = (
    b"\x93NUMPY\x01\x00\x76\x00"
    + b"{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000,), }".ljust(118)
)


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("world_from_camera", HUGE),
        ("frame0", bytes(200_000_000)),
        ("frame0", pickle.dumps({})),
        ("frame0", np.frombuffer(b"GIF89a" + bytes(100), np.uint8)),
        ("intrinsics", np.full((5, 3, 3), np.nan)),
        ("intrinsics", np.zeros((5, 3, 3))),
        ("intrinsics", np.full((5, 3, 3), 1e300)),
        ("world_from_camera", np.zeros((5, 4, 4))),
        ("world_from_camera", np.eye(4)),
        ("world_from_camera", np.array([None])),
        ("volume0_occupancy", np.zeros(7, np.uint8)),
        ("volume0_offsets", np.array([0, 5], np.int32)),
        ("volume0_steps", np.array([-1], np.int32)),
        ("volume0_weights", np.array([1.5])),
        ("about", {"image_size": [0, 10]}),
        ("about", {"image_size": [10**9, 10]}),
        ("about", {"frame_ids": ["a"] * 10}),
        ("about", {"frame_ids": [5] * 5}),
        ("about", {"frame_ids": {"a": 1}}),
        ("about", {"format": "x" * 10**6}),
        ("truth_size", np.full((6, 3), np.nan)),
        ("truth_label", np.full(6, 99)),
        ("truth_score", np.zeros((6, 6))),
        ("about", {"volumes": [{"resolution": [-1, 0, 3], "extent": [1, 1, 1], "center": [0, 0, 0]}]}),
        ("about", {"volumes": [5]}),
        ("about", {"volumes": [{"resolution": [2, 2, 2], "extent": [1, 1, 1], "center": [0, 0, 1e300]}]}),
    ],
)
def test_nonsense_in_the_viewers_file_is_one_short_sentence(tmp_path, name, values):
    result = write_result(tmp_path / "room")
    path = result / "viewer.npz"
    replaced(path, name, values)
    tracemalloc.start()
    try:
        with pytest.raises(DataError, match=r"cannot read .*viewer\.npz \(.*\): predict again") as error:
            read_viewer_scene(result)
        assert tracemalloc.get_traced_memory()[1] < 3e8
    finally:
        tracemalloc.stop()
    assert len(str(error.value).replace(str(path), "PATH")) < 300
