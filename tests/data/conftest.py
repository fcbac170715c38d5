# SPDX-License-Identifier: Apache-2.0
"""Tiny scans, CAD models and annotations in the layout of the real data sets."""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Callable, Sequence
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

CUBE_OBJ = """v -0.5 -0.5 -0.5
v 0.5 -0.5 -0.5
v 0.5 0.5 -0.5
v -0.5 0.5 -0.5
v -0.5 -0.5 0.5
v 0.5 -0.5 0.5
v 0.5 0.5 0.5
v -0.5 0.5 0.5
f 1 3 2
f 1 4 3
f 5 6 7
f 5 7 8
f 1 2 6
f 1 6 5
f 4 7 3
f 4 8 7
f 1 5 8
f 1 8 4
f 2 3 7
f 2 7 6
"""

INTRINSICS = np.array([[40.0, 0, 24, 0], [0, 40, 16, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
"""For images of 48×32."""


def look_along_x(x: float) -> np.ndarray:
    """A camera at (x, 0, 1) that looks along the world's +x, upright."""
    pose = np.eye(4)
    pose[:3, :3] = np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]], dtype=float)
    pose[:3, 3] = (x, 0, 1)
    return pose


@pytest.fixture
def write_scan(tmp_path: Path) -> Callable[..., Path]:
    """Write a scan whose frame ``n`` is a plain grey of value ``n`` seen from (n/100, 0, 1)."""

    def write(scene_id: str = "scene0000_00", frames=(0, 10, 20, 100), root: Path = tmp_path) -> Path:
        folder = root / "scannet" / "scans" / scene_id
        for part in ("color", "pose", "intrinsic"):
            (folder / part).mkdir(parents=True)
        for n in frames:
            Image.new("RGB", (48, 32), (n, n, n)).save(folder / "color" / f"{n}.jpg", quality=95)
            np.savetxt(folder / "pose" / f"{n}.txt", look_along_x(n / 100))
        np.savetxt(folder / "intrinsic" / "intrinsic_color.txt", INTRINSICS)
        return folder

    return write


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


@pytest.fixture
def write_sens(tmp_path: Path) -> Callable[..., Path]:
    """Write a JPEG + zlib recording of the scan of ``write_scan``; frames in ``lost`` have a pose of -inf."""

    def write(
        scene_id: str = "scene0000_00", frames: int = 4, lost: Sequence[int] = (), root: Path = tmp_path
    ) -> Path:
        path = root / "scannet" / "scans" / scene_id / f"{scene_id}.sens"
        path.parent.mkdir(parents=True, exist_ok=True)
        color = [encode_color(np.full((32, 48, 3), n, np.uint8), "jpeg") for n in range(frames)]
        depth = [zlib.compress(np.full((6, 8), 1000 + n, "<u2").tobytes()) for n in range(frames)]
        poses = np.stack([look_along_x(n / 100) for n in range(frames)])
        poses[list(lost)] = -np.inf
        path.write_bytes(encode_sens(color, depth, poses))
        return path

    return write


@pytest.fixture
def write_cube(tmp_path: Path) -> Callable[..., Path]:
    """Write a unit cube as a ShapeNet model."""

    def write(catid: str = "03001627", model_id: str = "cube", root: Path = tmp_path) -> Path:
        folder = root / "shapenet" / catid / model_id / "models"
        folder.mkdir(parents=True)
        (folder / "model_normalized.obj").write_text(CUBE_OBJ)
        return folder / "model_normalized.obj"

    return write


@pytest.fixture
def cube_entry() -> Callable[..., dict]:
    """Make an entry of ``aligned_models``: a cube, upright if the annotation frame is the scan's."""

    def entry(translation=(3.0, 0.0, 1.0), scale=(1.0, 1.0, 1.0), **fields) -> dict:
        half = 0.5**0.5
        trs = {"translation": list(translation), "rotation": [half, half, 0, 0], "scale": list(scale)}
        model = {"trs": trs, "bbox": [0.5] * 3, "center": [0.0] * 3, "sym": "__SYM_NONE"}
        return model | {"catid_cad": "03001627", "id_cad": "cube"} | fields

    return entry


@pytest.fixture
def write_annotations(tmp_path: Path) -> Callable[..., Path]:
    """Write ``full_annotations.json`` of scenes given as name and list of models."""

    def write(scenes: dict[str, list[dict]], root: Path = tmp_path) -> Path:
        identity = {"translation": [0, 0, 0], "rotation": [1, 0, 0, 0], "scale": [1, 1, 1]}
        entries = [
            {"id_scan": name, "trs": identity, "n_aligned_models": len(models), "aligned_models": models}
            for name, models in scenes.items()
        ]
        path = root / "scan2cad" / "full_annotations.json"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(entries))
        return path

    return write


@pytest.fixture
def cube_dataset(write_scan, write_cube, write_annotations, cube_entry, tmp_path: Path) -> Path:
    """A whole data set: one scan, one cube 3 m ahead of its cameras."""
    write_scan()
    write_cube()
    write_annotations({"scene0000_00": [cube_entry()]})
    return tmp_path
