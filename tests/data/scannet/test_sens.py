# SPDX-License-Identifier: Apache-2.0
"""Recordings: every compression comes back exactly; cut, damaged and hostile files."""

from __future__ import annotations

import contextlib
import itertools
import struct
import tracemalloc
import zlib

import numpy as np
import pytest
from PIL import Image

from raytran.data.scannet.sens import SensFile
from raytran.errors import DataError

from ...scan_forms import INTRINSICS, encode_color, encode_sens

COLOR = {"raw": 0, "png": 1, "jpeg": 2}
DEPTH = {"raw": 0, "zlib": 1, "occi": 2}


@pytest.fixture
def frames():
    """Three frames of random colour and depth, and random poses in single precision."""
    rng = np.random.default_rng(0)
    color = rng.integers(256, size=(3, 32, 48, 3), dtype=np.uint8)
    depth = rng.integers(65536, size=(3, 6, 8), dtype=np.uint16)
    return color, depth, rng.normal(size=(3, 4, 4)).astype(np.float32)


@pytest.fixture
def write(tmp_path, frames):
    """Write the frames with any of the format's fields changed."""

    def write_file(color_kind="jpeg", depth_kind="zlib", color_blobs=None, depth_blobs=None, **fields):
        color, depth, poses = frames
        packers = {"raw": bytes, "zlib": zlib.compress, "occi": bytes}
        content = encode_sens(
            color_blobs or [encode_color(pixels, color_kind) for pixels in color],
            depth_blobs or [packers[depth_kind](pixels.astype("<u2").tobytes()) for pixels in depth],
            poses,
            color_kind=fields.pop("color_code", COLOR[color_kind]),
            depth_kind=fields.pop("depth_code", DEPTH[depth_kind]),
            **fields,
        )
        path = tmp_path / "scene0000_00.sens"
        path.write_bytes(content)
        return path

    return write_file


@pytest.mark.parametrize(
    ("color_kind", "depth_kind", "imu"), list(itertools.product(COLOR, ("raw", "zlib"), (True, False)))
)
def test_every_compression_comes_back_exactly(write, frames, color_kind, depth_kind, imu) -> None:
    color, depth, poses = frames
    with SensFile(write(color_kind, depth_kind, imu=imu)) as file:
        assert len(file) == file.num_stated == file.num_frames_at_most == 3
        assert file.damage is None
        assert (file.color_compression, file.depth_compression) == (color_kind, depth_kind)
        assert (file.color_size, file.depth_size, file.depth_shift) == ((32, 48), (6, 8), 1000.0)
        np.testing.assert_array_equal(file.color_intrinsics, INTRINSICS)
        np.testing.assert_array_equal(file.depth_intrinsics, np.diag([5, 5, 1, 1]))
        assert file.world_from_camera.dtype == np.float64
        np.testing.assert_array_equal(file.world_from_camera, poses)
        for index in (2, 0, 1):
            np.testing.assert_array_equal(file.read_depth(index), depth[index])
            stored = encode_color(color[index], color_kind)
            if color_kind == "raw":
                assert file.color_bytes(index) is None
            else:
                assert file.color_bytes(index) == stored
            if color_kind != "jpeg":
                np.testing.assert_array_equal(file.read_color(index), color[index])
    assert file.read_color.__self__._file.closed


def test_jpeg_is_decoded_as_by_any_reader(write, frames, tmp_path) -> None:
    Image.fromarray(frames[0][1]).save(tmp_path / "1.jpg")
    with SensFile(write()) as file:
        np.testing.assert_array_equal(file.read_color(1), np.asarray(Image.open(tmp_path / "1.jpg")))


@pytest.mark.parametrize("kind", ["raw", "png"])
def test_resized_colour_does_not_depend_on_how_it_is_packed(write, frames, kind) -> None:
    with SensFile(write(kind)) as file:
        resized = file.read_color(0, (16, 24))
    expected = Image.fromarray(frames[0][0]).resize((24, 16), Image.Resampling.BILINEAR)
    np.testing.assert_array_equal(resized, np.asarray(expected))


@pytest.mark.parametrize("missing", [1, 60, 900])
def test_cut_file_gives_the_frames_before(write, frames, missing) -> None:
    """The cut goes through the last depth map, the last image, and the second frame."""
    path = write("raw", "raw", imu=False)
    whole = path.read_bytes()
    frame = 96 + 32 * 48 * 3 + 96
    cut = {1: len(whole) - 1, 60: len(whole) - 96 - 60, 900: len(whole) - frame - 900}[missing]
    path.write_bytes(whole[:cut])
    left = 1 if missing == 900 else 2
    with SensFile(path) as file:
        assert len(file) == left
        assert f"ends after {left} of the 3 frames that its header promises" in (file.damage or "")
        assert "scene0000_00.sens" in (file.damage or "")
        np.testing.assert_array_equal(file.read_color(left - 1), frames[0][left - 1])


def test_cut_in_the_header_of_a_frame(write, frames) -> None:
    path = write("raw", "raw", imu=False)
    path.write_bytes(path.read_bytes()[: -(32 * 48 * 3 + 96) - 10])
    with SensFile(path) as file:
        assert len(file) == 2


@pytest.mark.parametrize("num_bytes", [0, 3, 11, 12, 40, 300])
def test_cut_in_the_header_of_the_file(write, num_bytes) -> None:
    path = write()
    path.write_bytes(path.read_bytes()[:num_bytes])
    with pytest.raises(DataError, match=r"scene0000_00\.sens (is no \.sens|ends within its header)"):
        SensFile(path)


def test_other_files_and_versions(write, tmp_path) -> None:
    with pytest.raises(DataError, match=r"cannot open .*nowhere"):
        SensFile(tmp_path / "nowhere.sens")
    with pytest.raises(DataError, match="cannot open"):
        SensFile(tmp_path)
    with pytest.raises(DataError, match=r"is no \.sens recording of version 4"):
        SensFile(write(version=3))
    with pytest.raises(DataError, match="colour of kind -1 and depth of kind 1"):
        SensFile(write(color_code=-1))
    with pytest.raises(DataError, match="frames of 0x32"):
        SensFile(write(color_size=(32, 0)))


def test_occipital_depth_is_refused_but_colour_is_read(write, frames) -> None:
    with SensFile(write("png", "occi")) as file:
        np.testing.assert_array_equal(file.read_color(0), frames[0][0])
        with pytest.raises(DataError, match=r"Occipital's closed codec: export the scan"):
            file.read_depth(0)


def test_depth_without_a_unit_is_refused(write) -> None:
    path = write()
    path.write_bytes(path.read_bytes().replace(struct.pack("<f", 1000.0), struct.pack("<f", 0.0), 1))
    with SensFile(path) as file, pytest.raises(DataError, match=r"states 0\.0 depth units in a metre"):
        file.read_depth(0)


def test_frames_without_depth_or_colour(write, frames) -> None:
    blob = encode_color(frames[0][0], "png")
    with SensFile(write("png", color_blobs=[blob, b"", blob], depth_blobs=[b"", b"", b""])) as file:
        assert file.read_depth(0) is None
        assert file.num_color_bytes.tolist() == [len(blob), 0, len(blob)]
        np.testing.assert_array_equal(file.read_color(2), frames[0][0])
        with pytest.raises(DataError, match=r"frame 1 of .*\.sens has 0 bytes of png colour"):
            file.read_color(1)


def test_damaged_blobs_name_the_frame(write, frames) -> None:
    good = encode_color(frames[0][0], "jpeg")
    other = encode_color(np.zeros((8, 8, 3), np.uint8), "jpeg")
    depth = [b"no zlib", zlib.compress(bytes(95)), zlib.compress(bytes(97))]
    with SensFile(write(color_blobs=[good[: len(good) // 2], b"no image", other], depth_blobs=depth)) as file:
        for index in (0, 1):
            with pytest.raises(DataError, match=rf"cannot read the image frame {index} of .*\.sens"):
                file.read_color(index)
        with pytest.raises(DataError, match=r"frame 2 of .*\.sens is 8x8, not 48x32"):
            file.read_color(2)
        with pytest.raises(DataError, match=r"depth of frame 0 of .*\.sens is damaged"):
            file.read_depth(0)
        for index in (1, 2):
            with pytest.raises(DataError, match=rf"depth of frame {index} of .*\.sens is not 8x6"):
                file.read_depth(index)


@pytest.mark.parametrize("value", [0x00, 0xFF])
def test_any_changed_byte_gives_frames_or_one_sentence(write, value) -> None:
    """Every byte of the header, every 16th of its matrices, and the first frame's header and image."""
    path = write("png")
    whole = path.read_bytes()
    matrices, first = 12 + len("StructureSensor"), whole.index(struct.pack("<f", 1000.0)) + 12
    for offset in (*range(matrices), *range(matrices, first, 16), *range(first - 44, first + 120)):
        path.write_bytes(whole[:offset] + bytes([value]) + whole[offset + 1 :])
        with contextlib.suppress(DataError), SensFile(path) as file:
            for index in range(min(len(file), 3)):
                with contextlib.suppress(DataError):
                    assert file.read_color(index).shape == (*file.color_size, 3)
                with contextlib.suppress(DataError):
                    file.read_depth(index)


def peak_of(action) -> int:
    tracemalloc.start()
    try:
        action()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def test_absurd_counts_cost_nothing(write) -> None:
    """2^60 frames, a sensor name of 2^60 bytes, and blobs of exabytes are claimed, not there."""
    path = write(stated=2**60, imu=False)
    whole = path.read_bytes()

    def read_all() -> None:
        with SensFile(path) as file:
            assert len(file) == 3
            assert file.num_frames_at_most < 1000
            assert "of the 1152921504606846976 frames that its header promises" in (file.damage or "")
        path.write_bytes(whole[:4] + struct.pack("<Q", 2**60) + whole[12:])
        with pytest.raises(DataError, match=r"is no \.sens"):
            SensFile(path)
        first = whole.index(struct.pack("<f", 1000.0)) + 12
        for claim in (struct.pack("<QQ", 2**63, 2**63), struct.pack("<QQ", 2**64 - 1, 2**64 - 1)):
            path.write_bytes(whole[: first + 80] + claim + whole[first + 96 :])
            with SensFile(path) as file:
                assert len(file) == 0
                assert "ends after 0" in (file.damage or "")

    assert peak_of(read_all) < 1_000_000


def test_gigabytes_that_are_there_are_not_read(write, frames, tmp_path) -> None:
    """A sparse file whose one image really has 4 GB, and a depth map that unpacks to 64 MB."""
    path = write(color_blobs=[b"x", b"x", b"x"], depth_blobs=[b"", b"", zlib.compress(bytes(64_000_000))])
    whole = path.read_bytes()
    first = whole.index(struct.pack("<f", 1000.0)) + 12
    huge = tmp_path / "huge.sens"
    with huge.open("wb") as file:
        file.write(whole[: first + 80] + struct.pack("<QQ", 2**32, 0) + b"x")
        file.truncate(first + 96 + 2**32)

    def read_all() -> None:
        with SensFile(huge) as sens:
            assert len(sens) == 1
            with pytest.raises(DataError, match=r"frame 0 of .*claims 4294967296 bytes of colour"):
                sens.read_color(0)
        with SensFile(path) as sens, pytest.raises(DataError, match="is not 8x6"):
            sens.read_depth(2)

    assert peak_of(read_all) < 1_000_000


def test_index_of_a_long_recording_is_small(tmp_path) -> None:
    """6000 frames of 4 kB: the file is 25 MB, what is held of it less than 2 MB."""
    path = tmp_path / "long.sens"
    count, blob = 6000, bytes(4000)
    path.write_bytes(encode_sens([blob] * count, [b""] * count, np.tile(np.eye(4), (count, 1, 1))))

    def read_all() -> None:
        with SensFile(path) as file:
            assert len(file) == count
            assert file.color_bytes(count - 1) == blob

    assert peak_of(read_all) < 2_500_000
