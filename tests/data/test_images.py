# SPDX-License-Identifier: Apache-2.0
"""Reading, resizing, and what happens with damaged images."""

from __future__ import annotations

import importlib.util
import io
import logging
import subprocess
import sys
import warnings

import numpy as np
import pytest
import torch
from PIL import Image, ImageOps

from raytran.data.images import (
    FILL,
    IMAGE_ENDINGS,
    MAX_SIDE,
    ImageHeader,
    OrientationTags,
    _register_heif,
    box_within,
    decode_image,
    fill_up,
    image_headers,
    is_turned,
    kept_bytes,
    open_image,
    read_frames,
    read_header,
    resize,
    stored_size,
    turned_image,
    white_level,
)
from raytran.errors import ConfigError, DataError, RaytranError

from ..scan_forms import write_claiming_png


@pytest.fixture
def paths(tmp_path):
    """Six plain grey images, 10·n bright."""
    folder = tmp_path / "scan" / "color"
    folder.mkdir(parents=True)
    for n in range(6):
        Image.new("RGB", (16, 8), (10 * n,) * 3).save(folder / f"{n}.jpg")
    return [folder / f"{n}.jpg" for n in range(6)]


def read_image(path, image_size, stored=None):
    return decode_image(path, name=str(path), image_size=image_size, stored=stored)


def read_images(paths, chosen, **sizes):
    return read_frames(
        lambda position: read_image(paths[position], **sizes), len(paths), chosen, where=paths[0].parent
    )


def cut(path) -> None:
    path.write_bytes(path.read_bytes()[:-40])


def test_colours_and_axes(tmp_path) -> None:
    pixels = np.zeros((4, 6, 3), dtype=np.uint8)
    pixels[1, 5] = (200, 100, 50)
    Image.fromarray(pixels).save(tmp_path / "a.png")
    image = read_image(tmp_path / "a.png", (4, 6))
    assert image.dtype == torch.uint8
    assert image.shape == (3, 4, 6)
    assert image[:, 1, 5].tolist() == [200, 100, 50]
    assert image.sum() == 350


def test_resize_averages_and_need_not_keep_the_aspect(tmp_path) -> None:
    pixels = np.zeros((8, 8, 3), dtype=np.uint8)
    pixels[:, 4:] = 200
    Image.fromarray(pixels).save(tmp_path / "a.png")
    image = read_image(tmp_path / "a.png", (4, 16))
    assert image.shape == (3, 4, 16)
    assert (image[:, :, :6] == 0).all()
    assert (image[:, :, 10:] == 200).all()


@pytest.mark.parametrize("size", [(968, 1296), (720, 1280)])
def test_large_jpeg_keeps_its_geometry(tmp_path, size) -> None:
    """Decoding at half size must not shift the picture: a bright right half stays the right half."""
    pixels = np.zeros((*size, 3), dtype=np.uint8)
    pixels[:, size[1] // 2 :] = 255
    Image.fromarray(pixels).save(tmp_path / "a.jpg", quality=95)
    row = read_image(tmp_path / "a.jpg", (480, 640))[0, 240].float()
    edge = 640 - row.sum() / 255
    assert abs(edge - 320) < 0.75


def test_grey_and_alpha_become_rgb(tmp_path) -> None:
    Image.new("L", (4, 4), 70).save(tmp_path / "grey.jpg")
    Image.new("RGBA", (4, 4), (1, 2, 3, 4)).save(tmp_path / "alpha.png")
    assert read_image(tmp_path / "grey.jpg", (4, 4))[:, 0, 0].tolist() == [70, 70, 70]
    assert read_image(tmp_path / "alpha.png", (4, 4))[:, 0, 0].tolist() == [1, 2, 3]


def test_an_image_in_memory_is_read_as_its_file(paths) -> None:
    content = paths[3].read_bytes()
    assert torch.equal(decode_image(content, name="a"), read_image(paths[3], (8, 16)))
    assert torch.equal(decode_image(content, name="a", image_size=(4, 4)), read_image(paths[3], (4, 4)))
    with pytest.raises(DataError, match="cannot read the image frame 7"):
        decode_image(content[:-40], name="frame 7")
    with pytest.raises(DataError, match="frame 7 is 16x8, not 48x32"):
        decode_image(content, name="frame 7", stored=(32, 48))


def test_pixels_are_resized_as_images_are(tmp_path) -> None:
    pixels = np.random.default_rng(0).integers(256, size=(12, 18, 3), dtype=np.uint8)
    Image.fromarray(pixels).save(tmp_path / "a.png")
    expected = read_image(tmp_path / "a.png", (5, 7)).permute(1, 2, 0)
    np.testing.assert_array_equal(resize(pixels, (5, 7)), expected)


def test_an_image_that_claims_gigapixels_is_refused(paths) -> None:
    """The size in a JPEG's start-of-frame segment is changed to 65535×65535."""
    content = paths[0].read_bytes()
    at = content.index(b"\xff\xc0") + 5
    with pytest.raises(DataError, match="cannot read the image bomb"):
        decode_image(content[:at] + b"\xff" * 4 + content[at + 4 :], name="bomb")


def test_truncated_image_and_wrong_size_name_the_file(paths) -> None:
    cut(paths[2])
    with pytest.raises(DataError, match=r"2\.jpg"):
        read_image(paths[2], (8, 16))
    with pytest.raises(DataError, match=r"1\.jpg is 16x8, not 48x32"):
        read_image(paths[1], (8, 16), stored=(32, 48))


def test_unreadable_image_is_replaced_by_its_neighbour_and_counted(paths, caplog) -> None:
    cut(paths[2])
    with caplog.at_level(logging.WARNING):
        images, used = read_images(paths, [0, 2, 4], image_size=(8, 16), stored=(8, 16))
    assert used == [0, 1, 4]
    assert images[:, 0, 4, 8].tolist() == [0, 10, 40]
    assert images.is_contiguous()
    assert "skipped 1 unreadable" in caplog.text
    assert "2.jpg" in caplog.text


def test_replacement_may_be_unreadable_too(paths) -> None:
    for n in (1, 2, 3):
        cut(paths[n])
    _, used = read_images(paths, [0, 2, 4], image_size=(8, 16), stored=(8, 16))
    assert used == [0, 4, 5]


def test_readable_image_comes_twice_when_none_is_left(paths) -> None:
    cut(paths[5])
    images, used = read_images(paths, [0, 1, 2, 3, 4, 5], image_size=(8, 16), stored=(8, 16))
    assert used == [0, 1, 2, 3, 4, 4]
    assert images[:, 0, 4, 8].tolist() == [0, 10, 20, 30, 40, 40]


def test_too_few_readable_images(paths) -> None:
    for n in range(1, 6):
        cut(paths[n])
    with pytest.raises(DataError, match=r"only 1 of 6 usable frames .* 2 are needed"):
        read_images(paths, [0, 2, 4], image_size=(8, 16), stored=(8, 16))


def test_none_readable(paths) -> None:
    for path in paths:
        path.write_bytes(b"no image")
    with pytest.raises(DataError, match="only 0 of 6"):
        read_images(paths, [0, 2], image_size=(8, 16), stored=(8, 16))
    with pytest.raises(DataError, match="no image in"):
        stored_size(paths)


def test_stored_size_is_height_and_width(paths) -> None:
    paths[0].write_bytes(b"no image")
    assert stored_size(paths) == (8, 16)


@pytest.mark.parametrize("side", [9_000, 100_000])
def test_an_image_that_claims_too_many_pixels_is_not_decoded(tmp_path, side) -> None:
    """A few bytes, whose header promises a picture that would fill the memory."""
    write_claiming_png(tmp_path / "a.png", side)
    with pytest.raises(DataError, match=r"claims 9000x9000 pixels, and at most 8192|exceeds limit"):
        read_image(tmp_path / "a.png", (8, 16))
    with pytest.raises(DataError, match=r"pixels, and at most 8192|can be read"):
        stored_size([tmp_path / "a.png"])


@pytest.mark.parametrize(
    ("size", "canvas", "box"),
    [
        ((480, 640), (480, 640), (0, 0, 640, 480)),
        ((960, 1280), (480, 640), (0, 0, 640, 480)),
        ((478, 640), (480, 640), (0, 0, 640, 480)),
        ((640, 480), (480, 640), (140, 0, 500, 480)),
        ((300, 300), (480, 640), (80, 0, 560, 480)),
        ((100, 640), (480, 640), (0, 190, 640, 290)),
        ((1, 8000), (480, 640), (0, 239, 640, 240)),
    ],
)
def test_images_of_another_shape_are_put_into_the_middle(size, canvas, box) -> None:
    assert box_within(size, canvas) == box


def test_what_is_turned_is_no_square() -> None:
    assert is_turned((640, 480), (480, 640))
    assert not is_turned((480, 640), (480, 640))
    assert not is_turned((300, 300), (480, 640))
    assert not is_turned((300, 300), (500, 500))


@pytest.mark.parametrize("image_size", [None, (48, 64), (31, 50), (96, 128), (7, 9)])
def test_a_picture_keeps_its_place_to_a_fraction_of_a_pixel(image_size) -> None:
    """A ramp over 30×20 pixels in columns 17 to 49 of 64: its values tell the place of what is shown."""
    ramp = np.repeat((np.arange(20) * 12.0 + 6)[None, :, None], 30, axis=0).repeat(3, axis=2).astype(np.uint8)
    height, width = image_size or (48, 64)
    filled = fill_up(ramp, (17, 0, 49, 48), (48, 64), image_size)
    assert filled.shape == (height, width, 3)
    is_fill = (filled == np.array(FILL)).all(axis=2)
    left, right = 17 * width / 64, 49 * width / 64
    shown = np.flatnonzero(~is_fill[height // 2])
    assert (shown[0], shown[-1] + 1) == (np.ceil(left), np.floor(right))
    column = np.arange(width) + 0.5
    expected = np.interp((column - left) / (right - left) * 20 - 0.5, np.arange(20), ramp[0, :, 0])
    inner = shown[1:-1]
    np.testing.assert_allclose(filled[height // 2, inner, 0], expected[inner], atol=4 if width > 20 else 9)


def test_a_picture_narrower_than_a_pixel_shows_nothing() -> None:
    filled = fill_up(np.zeros((400, 1, 3), np.uint8), (319, 0, 320, 480), (480, 640), (12, 16))
    assert (filled == np.array(FILL)).all()


def test_the_stored_size_is_that_of_most_images(paths) -> None:
    """Whichever comes first."""
    for path, size in zip(paths, [(9, 9), (16, 8), (8, 16), (16, 8), (16, 8), (8, 16)], strict=True):
        Image.new("RGB", size).save(path)
    write_claiming_png(paths[2], 100_000)
    paths[5].write_bytes(b"no image")
    assert stored_size(paths) == (8, 16)
    assert [each and each.size for each in image_headers(paths)] == [
        (9, 9),
        (8, 16),
        None,
        (8, 16),
        (8, 16),
        None,
    ]


GREY = np.add.outer(10 * np.arange(12), np.arange(18)).astype(np.uint8)
"""``(12, 18)`` pixels, all of them different from their neighbours."""


def encoded(pixels, kind, **options) -> bytes:
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, kind, **options)
    return file.getvalue()


def rgb_of(content: bytes, **options) -> np.ndarray:
    return decode_image(content, name="a", **options).permute(1, 2, 0).numpy()


@pytest.mark.parametrize("kind", ["PNG", "TIFF", "BMP", "WEBP"])
def test_every_kind_without_loss_is_read_to_the_bit_whatever_its_name(tmp_path, kind) -> None:
    pixels = np.random.default_rng(0).integers(256, size=(12, 18, 3), dtype=np.uint8)
    content = encoded(pixels, kind, **({"lossless": True} if kind == "WEBP" else {}))
    for ending in IMAGE_ENDINGS:
        (tmp_path / f"a{ending}").write_bytes(content)
        np.testing.assert_array_equal(read_image(tmp_path / f"a{ending}", None).permute(1, 2, 0), pixels)
        assert read_header(tmp_path / f"a{ending}") == ImageHeader((12, 18))
        assert stored_size([tmp_path / f"a{ending}"]) == (12, 18)


@pytest.mark.parametrize("kind", ["EPS", "GIF", "TGA", "PPM", "ICO", "PDF", "JPEG2000", "SGI", "PCX"])
def test_a_file_of_another_kind_reaches_no_decoder(tmp_path, monkeypatch, kind) -> None:
    content = encoded(np.zeros((12, 18, 3), np.uint8), kind)
    for module in ("EpsImagePlugin", "GifImagePlugin", "PpmImagePlugin"):
        monkeypatch.setitem(sys.modules, f"PIL.{module}", None)
    started = []
    monkeypatch.setattr(subprocess, "Popen", lambda *command, **_: started.append(command))
    for name in ("a.jpg", "a.png", "a.tif"):
        (tmp_path / name).write_bytes(content)
        for read in (lambda path: read_image(path, (8, 16)), read_header, lambda path: stored_size([path])):
            with pytest.raises(DataError, match=r"export (it|them) again"):
                read(tmp_path / name)
    assert not started


def test_ghostscript_is_not_started_by_a_picture_named_jpg(tmp_path, monkeypatch) -> None:
    (tmp_path / "a.jpg").write_bytes(
        b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 20 20\n%%EndComments\n(x) run\nshowpage\n%%EOF\n"
    )
    monkeypatch.setattr("PIL.EpsImagePlugin.Ghostscript", lambda *_, **__: pytest.fail("it was started"))
    with pytest.raises(DataError, match="its first bytes are those of no JPEG, PNG, WEBP, TIFF, BMP or HEIC"):
        read_image(tmp_path / "a.jpg", None)


def test_the_decoder_must_be_one_that_was_asked_for(tmp_path) -> None:
    (tmp_path / "a.pgm").write_bytes(encoded(GREY, "PPM"))
    with open_image(tmp_path / "a.pgm", kinds=("PNG", "PPM")) as image:
        np.testing.assert_array_equal(np.asarray(image), GREY)
    with pytest.raises(OSError, match="no PNG"), open_image(encoded(GREY, "JPEG"), kinds=("PNG", "PPM")):
        pass


@pytest.mark.parametrize("kind", ["PNG", "TIFF"])
def test_grey_of_16_bits_becomes_its_upper_byte(kind) -> None:
    content = encoded(GREY.astype(np.uint16) * 257, kind)
    np.testing.assert_array_equal(rgb_of(content), np.repeat(GREY[..., None], 3, axis=2))
    assert rgb_of(content, image_size=(6, 9)).shape == (6, 9, 3)
    assert abs(rgb_of(content, image_size=(6, 9)).mean() - GREY.mean()) < 1


def test_grey_of_16_bits_in_the_other_byte_order() -> None:
    file = io.BytesIO()
    Image.frombytes("I;16B", (18, 12), (GREY.astype(">u2") * 257).tobytes()).save(file, "TIFF")
    np.testing.assert_array_equal(rgb_of(file.getvalue())[..., 0], GREY)


@pytest.mark.parametrize(("bits", "brightest"), [(8, 200), (10, 1000), (12, 2600), (14, 16000), (16, 20000)])
def test_cameras_of_fewer_bits_are_scaled_by_one_gain_for_the_whole_scan(tmp_path, bits, brightest) -> None:
    """The dark image of a 12-bit camera has the values of a 10-bit one, and is as dark as it was."""
    ramp = np.linspace(0, 1, 12 * 18).reshape(12, 18)
    paths = []
    for n, part in enumerate((1.0, 0.2, 0.05)):
        paths.append(tmp_path / f"{n}.png")
        paths[n].write_bytes(encoded((ramp * part * brightest).astype(np.uint16), "PNG"))
    white = white_level(paths)
    assert white == 2**bits - 1
    for path, part in zip(paths, (1.0, 0.2, 0.05), strict=True):
        grey = rgb_of(path.read_bytes(), white=lambda: white)[..., 0]
        assert abs(int(grey.max()) - 255 * part * brightest / white) <= 1


def test_images_of_8_bits_have_no_part_in_the_white_level(tmp_path) -> None:
    paths = [tmp_path / f"{n}.png" for n in range(3)]
    paths[0].write_bytes(encoded(GREY, "PNG"))
    paths[1].write_bytes(b"damaged")
    paths[2].write_bytes(encoded(GREY.astype(np.uint16) * 16, "PNG"))
    assert white_level(paths) == 4095
    assert white_level(paths[:2]) == 65535


@pytest.mark.parametrize("dtype", [np.float32, np.int32])
def test_numbers_whose_white_is_not_known_are_refused(dtype) -> None:
    with pytest.raises(
        DataError, match="numbers of 32 bits, of which none is known to be white: export it with"
    ):
        rgb_of(encoded(GREY.astype(dtype), "TIFF"))


@pytest.mark.parametrize("mode", ["1", "L", "LA", "P", "PA", "RGBA", "CMYK", "YCbCr"])
def test_other_modes_are_those_that_they_were(mode) -> None:
    image = Image.fromarray(np.random.default_rng(0).integers(256, size=(12, 18, 3), dtype=np.uint8)).convert(
        mode
    )
    file = io.BytesIO()
    image.save(file, "TIFF" if mode in ("CMYK", "YCbCr", "PA") else "PNG")
    file.seek(0)
    expected = np.asarray(Image.open(file).convert("RGB"))
    np.testing.assert_array_equal(rgb_of(file.getvalue()), expected)


@pytest.mark.parametrize("size", [(480, 640), (100, 130), (37, 50)])
def test_jpegs_are_decoded_as_before(size) -> None:
    pixels = np.random.default_rng(0).integers(256, size=(60, 80, 3), dtype=np.uint8)
    content = encoded(np.asarray(Image.fromarray(pixels).resize((1280, 960))), "JPEG", quality=95)
    with Image.open(io.BytesIO(content)) as image:
        image.draft("RGB", size[::-1])
        expected = np.asarray(image.resize(size[::-1], Image.Resampling.BILINEAR))
    np.testing.assert_array_equal(rgb_of(content, image_size=size), expected)


@pytest.mark.parametrize("tag", range(1, 9))
def test_exif_orientations_turn_and_mirror_when_they_are_applied(tmp_path, tag) -> None:
    exif = Image.Exif()
    exif[0x0112] = tag
    colors = np.random.default_rng(0).integers(256, size=(12, 18, 3), dtype=np.uint8)
    content = encoded(colors, "PNG", exif=exif)
    (tmp_path / "a.png").write_bytes(content)
    expected = np.asarray(ImageOps.exif_transpose(Image.open(io.BytesIO(content))))
    np.testing.assert_array_equal(turned_image(colors, tag), expected)
    header = read_header(tmp_path / "a.png")
    assert header == ImageHeader((12, 18), tag)
    assert header.shown_size == expected.shape[:2]
    np.testing.assert_array_equal(rgb_of(content), colors)
    np.testing.assert_array_equal(rgb_of(content, orientation=tag, stored=header.shown_size), expected)
    smaller = tuple(side // 2 for side in header.shown_size)
    assert rgb_of(content, orientation=tag, image_size=smaller).shape == (*smaller, 3)
    with pytest.raises(DataError, match="is 18x12, not"):
        rgb_of(content, orientation=tag, stored=(5, 7))


@pytest.mark.parametrize("tag", [0, 9, 65535])
def test_an_orientation_that_there_is_not_is_none(tmp_path, tag) -> None:
    exif = Image.Exif()
    exif[0x0112] = tag
    (tmp_path / "a.jpg").write_bytes(encoded(GREY, "JPEG", exif=exif))
    assert read_header(tmp_path / "a.jpg").orientation == 1
    (tmp_path / "b.jpg").write_bytes(encoded(GREY, "JPEG", exif=b"Exif\0\0MM\0*damaged"))
    assert read_header(tmp_path / "b.jpg").orientation == 1


def test_a_tiff_is_shown_as_its_orientation_asks_for_by_its_decoder(tmp_path) -> None:
    Image.fromarray(GREY).save(tmp_path / "a.tif", tiffinfo={274: 6})
    assert read_header(tmp_path / "a.tif") == ImageHeader((18, 12), 1)
    np.testing.assert_array_equal(read_image(tmp_path / "a.tif", None)[0], np.rot90(GREY, -1))


def test_tags_say_what_is_up_and_which_of_them_nothing_decides() -> None:
    tags = OrientationTags((1, 3, 6, 8), (False, False, False, True))
    assert tags.sides == (0, 2, 3, 0)
    assert [tags.turn(n) for n in range(4)] == [1, 1, 1, 8]
    assert tags.reversed([(48, 64)] * 4).applied == (False, True, False, True)
    assert tags.reversed([(64, 64)] * 4).applied == (False, True, True, False)
    assert OrientationTags((1, 6), (False, False)).reversed([(48, 64)] * 2) is None


def test_the_first_picture_of_an_animation_is_taken() -> None:
    frames = [Image.new("RGB", (18, 12), (level,) * 3) for level in (50, 200)]
    for kind in ("WEBP", "PNG", "TIFF"):
        file = io.BytesIO()
        options = {"lossless": True} if kind == "WEBP" else {}
        frames[0].save(file, kind, save_all=True, append_images=frames[1:], **options)
        assert (rgb_of(file.getvalue()) == 50).all()


def test_files_of_several_pictures_of_phones_are_jpegs() -> None:
    """MPO: the JPEG of a phone with a second one, a preview or depth, behind it."""
    file = io.BytesIO()
    first = Image.fromarray(np.repeat(GREY[..., None], 3, axis=2))
    first.save(file, "MPO", save_all=True, append_images=[Image.new("RGB", (9, 6))], quality=95)
    assert np.abs(rgb_of(file.getvalue())[..., 0].astype(int) - GREY).max() < 8


@pytest.mark.parametrize("kind", ["JPEG", "PNG", "WEBP", "TIFF", "BMP"])
def test_damage_of_any_kind_is_a_sentence(kind) -> None:
    pixels = np.random.default_rng(0).integers(256, size=(12, 18, 3), dtype=np.uint8)
    content = encoded(pixels, kind)
    generator = np.random.default_rng(1)
    for _ in range(150):
        damaged = bytearray(content[: generator.integers(len(content)) if generator.random() < 0.4 else None])
        for at in generator.integers(max(len(damaged), 1), size=4):
            damaged[at : at + 1] = bytes([generator.integers(256)])
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            try:
                assert max(rgb_of(bytes(damaged)).shape[:2]) <= MAX_SIDE
            except RaytranError as error:
                assert "a" in str(error)  # noqa: PT017


def test_an_image_of_no_pixels_is_refused() -> None:
    content = bytearray(encoded(GREY, "BMP"))
    content[22:26] = bytes(4)
    with pytest.raises(DataError, match=r"is of 18x0 pixels, so it shows nothing|cannot read the image"):
        rgb_of(bytes(content))


def test_only_pixels_that_are_used_as_they_are_keep_their_bytes() -> None:
    for kind, is_kept in (("JPEG", True), ("PNG", True), ("WEBP", False), ("TIFF", False), ("BMP", False)):
        assert (kept_bytes(encoded(GREY, kind)) is not None) == is_kept
    assert kept_bytes(encoded(GREY.astype(np.uint16), "PNG")) is None


HEIC_START = b"\0\0\0\x18ftypheic\0\0\0\0mif1heic"


def test_heic_without_its_decoder_says_what_to_install(tmp_path, monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "pillow_heif", None)
    _register_heif.cache_clear()
    (tmp_path / "a.heic").write_bytes(HEIC_START)
    for read in (read_header, lambda path: read_image(path, None), lambda path: stored_size([path])):
        with pytest.raises(ConfigError, match=r"pip install 'raytran\[heic\]', or export the images as JPEG"):
            read(tmp_path / "a.heic")


@pytest.mark.skipif(importlib.util.find_spec("pillow_heif") is None, reason="pillow-heif is not installed")
def test_heic_is_read_by_its_extra(tmp_path) -> None:
    import pillow_heif

    _register_heif.cache_clear()
    pixels = np.repeat(GREY[..., None], 3, axis=2).repeat(8, axis=0).repeat(8, axis=1)
    pillow_heif.from_pillow(Image.fromarray(pixels)).save(tmp_path / "a.jpg", quality=95)
    assert read_header(tmp_path / "a.jpg") == ImageHeader((96, 144))
    image = read_image(tmp_path / "a.jpg", None).permute(1, 2, 0).numpy().astype(int)
    assert np.abs(image - pixels).mean() < 3
    (tmp_path / "b.heic").write_bytes(HEIC_START)
    with pytest.raises(DataError, match="cannot read the image"):
        read_image(tmp_path / "b.heic", None)
