# SPDX-License-Identifier: Apache-2.0
"""Fixtures for all tests."""

from __future__ import annotations

import gc
import json
import logging
import math
import os
import sys
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

if not torch.cuda.is_available():
    # Without a GPU Triton's kernels run in its interpreter. Triton reads this when it is first imported.
    os.environ["TRITON_INTERPRET"] = "1"

from raytran.checkpoints.file import write_checkpoint
from raytran.checkpoints.metadata import checkpoint_metadata
from raytran.classes import PAPER_CLASSES
from raytran.geometry.camera import Cameras
from raytran.geometry.rotation import rotation_from_yaw, yaw_from_rotation
from raytran.ops.pairs import PairList
from raytran.rooms.generate import generate_rooms
from raytran.run.entry import compose
from raytran.run.train.build import build_model, plain
from raytran.structs import ObjectSet, RawObjects

from .commands import Commands
from .factories import Trained
from .scan_forms import INTRINSICS, encode_color, encode_sens, look_along_x, write_form

PROJECT_ROOT = Path(__file__).resolve().parents[1]


def pytest_collection_finish() -> None:
    """Let the garbage collector leave out the million objects of torch, Lightning and pytest from now on."""
    gc.collect()
    gc.freeze()


@pytest.fixture(scope="session")
def project_root() -> Path:
    return PROJECT_ROOT


@pytest.fixture(scope="session")
def shared_dir() -> Path:
    """The folder of reference material beside the project; tests that read it skip when it is absent."""
    folder = PROJECT_ROOT.parent / "shared"
    if not (folder / "realdata").is_dir():
        pytest.skip(f"reference data not found at {folder / 'realdata'}")
    return folder


@pytest.fixture(scope="session")
def command() -> Iterator[Commands]:
    """Run ``python -m raytran.<name> …`` in a folder."""
    commands = Commands()
    yield commands
    commands.close()


@pytest.fixture(autouse=True)
def log_levels_are_left_alone() -> Iterator[None]:
    """What one test silences, others would wait for in vain."""
    log = logging.getLogger("raytran")
    before = log.level, log.disabled
    yield
    after = log.level, log.disabled
    log.setLevel(before[0])
    log.disabled = before[1]
    assert after == before, "the test leaves the logger of raytran changed"


@pytest.fixture
def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


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


@pytest.fixture(scope="session")
def small_rooms(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The root of a data set with a room to train on and one to validate, of four frames of 32 × 32."""
    root = tmp_path_factory.mktemp("small") / "rooms"
    generate_rooms(
        root,
        num_train=1,
        num_val=1,
        frames=4,
        image_size=(32, 32),
        min_objects=3,
        max_objects=3,
        room_size=((3.0, 3.5), (3.0, 3.5)),
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


@pytest.fixture(scope="session")
def trained(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    settings = [
        "preset=tiny",
        "model.grid_resolution=[8,8,4]",
        "model.backbone.num_blocks=1",
        "views.image_size=[32,48]",
        "model.backbone.encoder.weights=/home/me/resnet.pth",
    ]
    config = compose("train", [*settings, "data.root=/home/me/rooms", f"output_dir={folder}"])
    model = build_model(config, pretrained=False)
    parent = {"path": "/home/me/stage2/last.ckpt", "stage": "stage2", "step": 3, "scores": {"val/loss": 1.0}}
    metadata = checkpoint_metadata(stage="stage3", preset="tiny", config=plain(config), parent=parent)
    state = {f"model.{name}": value for name, value in model.state_dict().items()}
    scores = {"val/objects/f1_0.25": 0.5, "val/objects/f1_0.25/chair": 0.7}
    more = {"scores": scores, "global_step": 40, "optimizer_states": [{}]}
    path = folder / "last.ckpt"
    write_checkpoint(path, {**metadata, **more, "state_dict": {**state, "loss.scale": torch.ones(1)}})
    return Trained(path, model)


@pytest.fixture
def mylab(tmp_path, monkeypatch):
    """A package of the user's own, with networks and other things in it."""
    (tmp_path / "mylab").mkdir()
    (tmp_path / "mylab" / "__init__.py").write_text(
        "from torch.nn import Linear\nfrom mylab.nets import Head, MyBackbone\n"
        "def run(**_): raise SystemExit('run')\nclass Settings:\n    def __init__(self, **_): run()\n"
    )
    (tmp_path / "mylab" / "nets.py").write_text(
        "from raytran.backbone.backbone import Backbone\nfrom raytran.heads.shape import ShapeHead\n"
        "class MyBackbone(Backbone): pass\n"
        "class Head(ShapeHead):\n"
        "    def __init__(self, *, attention, weights, **settings):\n"
        "        super().__init__(**settings)\n        self.told = attention, weights\n"
    )
    (tmp_path / "broken.py").write_text("import no_such_package\n")
    monkeypatch.syspath_prepend(tmp_path)
    yield
    for name in [name for name in sys.modules if name.partition(".")[0] in ("mylab", "broken")]:
        del sys.modules[name]


@pytest.fixture
def random_pairs(generator: torch.Generator) -> Callable[[int, int, float], PairList]:
    """Make pairs at random; the first and the last pixel and voxel have none."""

    def make(num_pixels: int, num_voxels: int, density: float) -> PairList:
        joined = torch.rand(num_pixels, num_voxels, generator=generator) < density
        if num_pixels > 2 and num_voxels > 2:
            joined[[0, -1]] = False
            joined[:, [0, -1]] = False
        index = joined.nonzero()
        return PairList(index[:, 0], index[:, 1], num_pixels, num_voxels)

    return make


@pytest.fixture
def random_cameras(generator: torch.Generator) -> Callable[..., Cameras]:
    """Make cameras with any orientation, at normally distributed positions of a given spread in metres."""

    def make(*lead: int, spread: float) -> Cameras:
        rotation = torch.linalg.qr(torch.randn(*lead, 3, 3, generator=generator, dtype=torch.float64)).Q
        rotation = rotation * torch.linalg.det(rotation)[..., None, None]
        pose = torch.eye(4, dtype=torch.float64).repeat(*lead, 1, 1)
        pose[..., :3, :3] = rotation
        pose[..., :3, 3] = spread * torch.randn(*lead, 3, generator=generator, dtype=torch.float64)
        intrinsics = torch.tensor([[50.0, 0.0, 41.0], [0.0, 47.0, 29.0], [0.0, 0.0, 1.0]])
        return Cameras(intrinsics.double().expand(*lead, 3, 3), pose, (60, 80))

    return make


@pytest.fixture
def shaped_pairs(random_pairs: Callable[[int, int, float], PairList]) -> Callable[..., PairList]:
    """Make pairs at random between views ``(n, h, w)`` and grids ``(B, X, Y, Z)``; the ends have none."""

    def make(
        pixel_shape: tuple[int, int, int], voxel_shape: tuple[int, int, int, int], density: float
    ) -> PairList:
        plain = random_pairs(math.prod(pixel_shape), math.prod(voxel_shape), density)
        return replace(plain, pixel_shape=pixel_shape, voxel_shape=voxel_shape)

    return make


@pytest.fixture
def make_objects() -> Callable[[int, int], ObjectSet]:
    def make(count: int, seed: int = 0) -> ObjectSet:
        g = torch.Generator().manual_seed(seed)
        return ObjectSet(
            label=torch.randint(0, len(PAPER_CLASSES), (count,), generator=g),
            center=4 * torch.rand(count, 3, generator=g) - 2,
            size=torch.rand(count, 3, generator=g) + 0.3,
            rotation=rotation_from_yaw(6 * torch.rand(count, generator=g) - 3),
            symmetry=torch.ones(count, dtype=torch.long),
            score=torch.ones(count),
            shape=torch.rand(count, 5, 5, 5, generator=g) > 0.5,
        )

    return make


@pytest.fixture
def make_perfect() -> Callable[..., RawObjects]:
    def make(objects: ObjectSet, slots: torch.Tensor, num_queries: int) -> RawObjects:
        logits = torch.full((1, num_queries, len(PAPER_CLASSES) + 1), -20.0)
        logits[0, :, len(PAPER_CLASSES)] = 20.0
        logits[0, slots, len(PAPER_CLASSES)] = -20.0
        logits[0, slots, objects.label] = 20.0
        center, log_size = 9 * torch.ones(1, num_queries, 3), torch.zeros(1, num_queries, 3)
        center[0, slots], log_size[0, slots] = objects.center, objects.size.log()
        yaw_vector = torch.ones(1, num_queries, 2)
        yaw = yaw_from_rotation(objects.rotation)
        yaw_vector[0, slots] = 2 * torch.stack([yaw.sin(), yaw.cos()], dim=-1)
        embedding = torch.arange(num_queries, dtype=torch.float32)[None, :, None].expand(1, -1, 4)
        leaves = (logits, center, log_size, yaw_vector, embedding.clone())
        return RawObjects(*(leaf.requires_grad_() for leaf in leaves))

    return make
