# SPDX-License-Identifier: Apache-2.0
"""Tiny scans, CAD models and annotations in the layout of the real data sets."""

from __future__ import annotations

import json
import zlib
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from raytran.data.rooms.generate import generate_rooms

from .scan_forms import INTRINSICS, encode_color, encode_sens, look_along_x, write_form

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


@pytest.fixture(scope="session")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The root of a data set with one furnished room of 20 frames."""
    root = tmp_path_factory.mktemp("furnished") / "room"
    generate_rooms(
        root,
        num_train=1,
        num_val=0,
        seed=3,
        frames=20,
        image_size=(180, 240),
        min_objects=4,
        max_objects=6,
        room_size=((3.0, 4.0), (3.0, 4.0)),
        processes=1,
        progress=False,
    )
    return root


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
        poses = np.array([look_along_x(n / 100) for n in range(frames)]).reshape(-1, 4, 4)
        poses[list(lost)] = -np.inf
        path.write_bytes(encode_sens(color, depth, poses))
        return path

    return write


@pytest.fixture
def scan_in_form(write_scan, tmp_path: Path) -> Callable[..., Path]:
    """Write the scan of ``write_scan`` to a folder in one of the exported forms."""

    def write(form: str, folder: Path, frames: Sequence[int] = (0, 10, 20, 100)) -> Path:
        plain = tmp_path / f"plain-{folder.parent.name}-{form}"
        write_form(form, write_scan(folder.name, frames, root=plain), folder)
        return folder

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
