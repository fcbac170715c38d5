# SPDX-License-Identifier: Apache-2.0
"""Writers of ScanNet's forms, byte for byte as its own tools write them."""

from __future__ import annotations

import shutil
import struct
import zlib
from collections.abc import Sequence
from io import BytesIO
from pathlib import Path

import numpy as np
from PIL import Image

INTRINSICS = np.array([[40.0, 0, 24, 0], [0, 40, 16, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
"""For images of 48×32."""


def look_along_x(x: float) -> np.ndarray:
    """A camera at (x, 0, 1) that looks along the world's +x, upright."""
    pose = np.eye(4)
    pose[:3, :3] = np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]], dtype=float)
    pose[:3, 3] = (x, 0, 1)
    return pose


def encode_color(pixels: np.ndarray, kind: str) -> bytes:
    """Pack ``(H, W, 3)`` pixels as a recording of colour ``kind`` does."""
    if kind == "raw":
        return pixels.tobytes()
    stream = BytesIO()
    Image.fromarray(pixels).save(stream, format=kind)
    return stream.getvalue()


def encode_sens(
    color: Sequence[bytes],
    depth: Sequence[bytes],
    poses: np.ndarray,
    *,
    color_kind: int = 2,
    depth_kind: int = 1,
    color_size: tuple[int, int] = (32, 48),
    depth_size: tuple[int, int] = (6, 8),
    intrinsics: np.ndarray = INTRINSICS,
    imu: bool = True,
    stated: int | None = None,
    name: bytes = b"StructureSensor",
    version: int = 4,
) -> bytes:
    """Put together a ``.sens`` file of version 4, field by field as ScanNet's sensorData.h writes it."""
    out = bytearray(struct.pack("<IQ", version, len(name)) + name)
    for matrix in (intrinsics, np.eye(4), np.diag([5.0, 5, 1, 1]), np.eye(4)):
        out += matrix.astype("<f4").tobytes()
    out += struct.pack("<ii", color_kind, depth_kind)
    out += struct.pack("<IIII", *color_size[::-1], *depth_size[::-1])
    out += struct.pack("<fQ", 1000.0, len(color) if stated is None else stated)
    for number, (color_blob, depth_blob, pose) in enumerate(zip(color, depth, poses, strict=True)):
        out += pose.astype("<f4").tobytes()
        out += struct.pack("<QQQQ", number * 33333, number * 33333 + 7, len(color_blob), len(depth_blob))
        out += color_blob + depth_blob
    if imu:
        out += struct.pack("<Q", 2) + bytes(2 * 128)
    return bytes(out)


def write_form(form: str, source: Path, folder: Path) -> None:
    """Copy a scan in the Python exporter's form to ``folder`` in another form, frame numbers kept."""
    color, pose, intrinsic = _NAMES[form]
    for path in (source / "color").iterdir():
        _copy(path, folder / color.format(int(path.stem)))
    for path in (source / "pose").iterdir():
        _copy(path, folder / pose.format(int(path.stem)))
    matrix = np.loadtxt(source / "intrinsic" / "intrinsic_color.txt")
    target = folder / intrinsic
    target.parent.mkdir(parents=True, exist_ok=True)
    if form == "cpp":
        words = " ".join(f"{value:g}" for value in matrix.ravel())
        target.write_text(
            "m_versionNumber = 4\nm_sensorName = StructureSensor\nm_colorWidth = 48\nm_colorHeight = 32\n"
            f"m_depthShift = 1000\nm_calibrationColorIntrinsic = {words} \n"
            f"m_calibrationDepthIntrinsic = 5 0 0 0 0 5 0 0 0 0 1 0 0 0 0 1 \nm_frames.size = 4\n"
        )
    else:
        np.savetxt(target, matrix)


def _copy(source: Path, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    shutil.copy(source, target)


_NAMES = {
    "exporter": ("color/{}.jpg", "pose/{}.txt", "intrinsic/intrinsic_color.txt"),
    "cpp": ("frame-{:06d}.color.jpg", "frame-{:06d}.pose.txt", "_info.txt"),
    "odam": ("frames/color/{}.jpg", "frames/pose/{}.txt", "frames/intrinsic/intrinsic_color.txt"),
    "mmdetection3d": ("{:05d}.jpg", "{:05d}.txt", "intrinsic.txt"),
    "frames_25k": ("color/{:06d}.jpg", "pose/{:06d}.txt", "intrinsics_color.txt"),
}
"""Names of image and pose of frame n and of the intrinsics, in each form."""


def write_claiming_png(path: Path, side: int) -> None:
    """Write a picture of a few bytes whose header claims ``side × side`` pixels."""
    Image.new("RGB", (16, 8)).save(path, format="png")
    content = bytearray(path.read_bytes())
    content[16:24] = struct.pack(">II", side, side)
    content[29:33] = struct.pack(">I", zlib.crc32(content[12:29]))
    path.write_bytes(content)
