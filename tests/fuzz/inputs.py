# SPDX-License-Identifier: Apache-2.0
"""Small valid inputs of every kind that is read, who reads each, and what must hold of the result."""

from __future__ import annotations

import copy
import importlib.util
import json
import random
import shutil
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
from PIL import Image
from scipy.spatial.transform import Rotation

from raytran.backbone.encoder_weights import read_state
from raytran.capture.boxes.arkitscenes import ArkitScan
from raytran.capture.boxes.box_list import boxed_objects, read_box_list
from raytran.capture.boxes.categories import Categories
from raytran.capture.open import open_scene
from raytran.capture.orientation import WorldSettings
from raytran.capture.render_cameras import read_render_cameras
from raytran.checkpoints.file import PREFIX, write_checkpoint, write_weights
from raytran.checkpoints.load import load_model, prediction_settings
from raytran.checkpoints.metadata import checkpoint_metadata
from raytran.checkpoints.runs import read_finished
from raytran.checkpoints.sweeps import read_record
from raytran.classes import PAPER_CLASSES, Classes
from raytran.data.cache import MaskCache
from raytran.data.files import SettingsRecord
from raytran.data.prepare.annotation import read_usable
from raytran.data.prepare.boxed_mesh import box_mesh
from raytran.data.prepare.boxed_objects import BoxedObjects
from raytran.data.prepare.boxed_scan import obj_text
from raytran.data.prepare.scan import read_facts as read_prepared_facts
from raytran.data.scan2cad import read_annotations, scene_alignments, scene_objects
from raytran.data.scannet.find import read_splits
from raytran.data.scannet.scan import read_scan
from raytran.data.scannet.sens import SensFile
from raytran.data.scannet.text import read_frame_cameras
from raytran.data.scene_list import read_split
from raytran.data.shapenet.meshes import read_binvox, read_face_colors, read_obj, write_binvox
from raytran.data.shapenet.models import BOXED, read_facts, read_mesh
from raytran.data.targets import scan_surface, shape_grids
from raytran.export import read_scene_json, write_prediction
from raytran.export.read import BOXER_COLUMNS, read_alignments_csv, read_predictions, read_roca_csv
from raytran.rooms.library import read_library
from raytran.rooms.sweethome3d.catalogue import FurnitureLibrary
from raytran.rooms.sweethome3d.mesh import read_piece
from raytran.run.entry import compose
from raytran.run.evaluate.results import read_curves
from raytran.run.evaluate.score import evaluate_predictions
from raytran.run.sweep.folder import last_value
from raytran.run.train.build import build_model, plain
from raytran.structs import ObjectSet, ScenePrediction
from raytran.viewer.data import VoxelVolume, read_viewer_scene, write_viewer_data
from raytran.viewer.truth import read_truth

from ..capture.forms import OPENGL, Walk, write_colmap, write_transforms, write_tum, write_video
from ..factories import make_views
from ..scan_forms import INTRINSICS, encode_color, encode_sens, look_along_x, write_form
from .mutations import json_text, mutate_file, mutated_json, with_raw_values

Reader = Callable[[Path], None]


class NonsenseError(Exception):
    """A damaged input was read, and what came out cannot be."""


@dataclass(frozen=True)
class Input:
    """A kind of input.

    Attributes:
        name: of the kind.
        plain: folder with a valid one.
        read: reads one in a folder, and raises ``NonsenseError`` for a result that cannot be.
        files: patterns of the files that are changed.
        change: changes the folder itself, in place of the usual changes of one or two files.
    """

    name: str
    plain: Path
    read: Reader
    files: tuple[str, ...] = ("**/*",)
    change: Callable[[Path, random.Random], None] | None = None

    def write(self, folder: Path) -> None:
        """Write the valid input."""
        shutil.copytree(self.plain, folder)

    def mutate(self, folder: Path, rng: random.Random) -> None:
        """Change it."""
        if self.change is not None and rng.random() < 0.7:
            self.change(folder, rng)
            return
        files = sorted({path for glob in self.files for path in folder.glob(glob) if path.is_file()})
        # Big files are changed no more often than small ones, text as often as pictures.
        endings = sorted({path.suffix for path in files})
        for _ in range(rng.choice((1, 1, 1, 2))):
            ending = rng.choice(endings)
            path = rng.choice([path for path in files if path.suffix == ending])
            kind = rng.random()
            if not path.is_file():
                continue
            if kind < 0.03:
                path.unlink()
                if kind < 0.01:
                    path.mkdir()
            else:
                mutate_file(path, rng)


def within(values: Any, low: float, high: float, what: str) -> None:
    """Raise unless all numbers lie between two bounds."""
    array = values.detach().double().numpy() if isinstance(values, torch.Tensor) else np.asarray(values)
    array = array.astype(np.float64)
    if array.size and not ((array >= low) & (array <= high)).all():
        raise NonsenseError(f"{what} of {array.min():g} to {array.max():g}")


def check_objects(objects: ObjectSet) -> None:
    """Raise unless objects can be."""
    within(objects.center, -1e6, 1e6, "centres")
    within(objects.size, 1e-9, 1e5, "sizes")
    within(objects.rotation, -1.01, 1.01, "rotations")
    within(objects.score, -1e6, 1e6, "scores")


def check_scan(scan: Any) -> None:
    """Raise unless the cameras of an open scan can be; read two images."""
    height, width = scan.image_size
    within([height, width], 1, 8192, "image size")
    if not len(scan):
        raise NonsenseError("a scan without frames")
    poses = scan.world_from_camera.double()
    within(poses, -1e9, 1e9, "poses")
    turns = poses[:, :3, :3]
    within(turns.mT @ turns - torch.eye(3, dtype=torch.float64), -0.05, 0.05, "RᵀR - 1")
    matrices = torch.as_tensor(scan.intrinsics).double().reshape(-1, 3, 3)
    within(matrices[:, [0, 1], [0, 1]], 1e-2, 1e7, "focal lengths")
    # Of a part of a larger picture it may lie outside.
    within(matrices[:, 0, 2] / width, -3.0, 4.0, "principal point")
    within(matrices[:, 1, 2] / height, -3.0, 4.0, "principal point")
    for index in {0, len(scan) - 1}:
        image = np.asarray(scan.read_color(index, (32, 48)))
        if image.shape != (32, 48, 3):
            raise NonsenseError(f"an image of {image.shape}")


def read_scene(format: str, folder: Path, *, name: str = "") -> None:
    """Open a scan as ``predict`` does, without matching points between its images."""
    with open_scene(
        folder / name if name else folder, format=format, settings=WorldSettings(check=False)
    ) as scan:
        check_scan(scan)


# ---------------------------------------------------------------- scans


def make_walk(folder: Path, count: int = 4) -> Walk:
    """A few level cameras that turn about while they go."""
    (folder / "images").mkdir(parents=True)
    poses = np.tile(np.eye(4), (count, 1, 1))
    generator = np.random.default_rng(0)
    for n, pose in enumerate(poses):
        yaw = 0.9 * n
        forward = np.array([np.cos(yaw), np.sin(yaw), 0.1])
        forward /= np.linalg.norm(forward)
        right = np.array([np.sin(yaw), -np.cos(yaw), 0.0])
        pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
        pose[:3, 3] = [0.3 * n, 0.5 * np.cos(n), 1.5]
        pixels = generator.integers(0, 255, (6, 8, 3), dtype=np.uint8).repeat(8, 0).repeat(8, 1)
        Image.fromarray(pixels).save(folder / "images" / f"{n}.png")
    names = tuple(f"{n}.png" for n in range(count))
    return Walk(folder, names, poses, (48, 64), (50.0, 51.0, 31.0, 25.0))


def image_of(walk: Walk, n: int) -> bytes:
    return (walk.folder / "images" / walk.names[n]).read_bytes()


def make_polycam(folder: Path, walk: Walk) -> None:
    fx, fy, cx, cy = walk.camera
    for part in ("cameras", "images"):
        (folder / "keyframes" / part).mkdir(parents=True)
    for n, pose in enumerate(walk.poses):
        matrix = pose @ OPENGL
        content = {f"t_{row}{column}": matrix[row, column] for row in range(3) for column in range(4)}
        content |= {"fx": fx, "fy": fy, "cx": cx, "cy": cy, "width": 64, "height": 48}
        (folder / "keyframes" / "cameras" / f"{1000 + n}.json").write_text(json.dumps(content))
        (folder / "keyframes" / "images" / f"{1000 + n}.png").write_bytes(image_of(walk, n))


def make_scanner(folder: Path, walk: Walk) -> None:
    fx, fy, cx, cy = walk.camera
    folder.mkdir(parents=True)
    for n, pose in enumerate(walk.poses):
        content = {"cameraPoseARFrame": (pose @ OPENGL).ravel().tolist()}
        content |= {"intrinsics": [fx, 0, cx, 0, fy, cy, 0, 0, 1], "time": n / 10}
        (folder / f"frame_{n:05d}.json").write_text(json.dumps(content))
        (folder / f"frame_{n:05d}.png").write_bytes(image_of(walk, n))
    (folder / "info.json").write_text("{}")


def make_arkitscenes(folder: Path, walk: Walk) -> None:
    fx, fy, cx, cy = walk.camera
    for part in ("lowres_wide", "lowres_wide_intrinsics"):
        (folder / part).mkdir(parents=True)
    rows = []
    for n, pose in enumerate(walk.poses):
        time, inverse = 3211.4 + n / 10, np.linalg.inv(pose)
        turn = Rotation.from_matrix(inverse[:3, :3]).as_rotvec()
        rows.append(" ".join(str(value) for value in (time, *turn, *inverse[:3, 3])))
        (folder / "lowres_wide" / f"in_{time:.3f}.png").write_bytes(image_of(walk, n))
        lens = f"64 48 {fx} {fy} {cx} {cy}"
        (folder / "lowres_wide_intrinsics" / f"in_{time:.3f}.pincam").write_text(lens)
    (folder / "lowres_wide.traj").write_text("\n".join(rows) + "\n")


def make_record3d(folder: Path, walk: Walk) -> None:
    opengl = walk.poses @ OPENGL
    turns = Rotation.from_matrix(opengl[:, :3, :3]).as_quat()
    fx, fy, cx, cy = walk.camera
    content = {"poses": np.c_[turns, opengl[:, :3, 3]].tolist(), "K": [fx, 0, 0, 0, fy, 0, cx, cy, 1]}
    content |= {"w": 64, "h": 48, "fps": 30}
    (folder / "rgb").mkdir(parents=True)
    for n in range(len(walk.names)):
        (folder / "rgb" / f"{n}.png").write_bytes(image_of(walk, n))
    (folder / "metadata.json").write_text(json.dumps(content))


def make_scannet(folder: Path) -> None:
    for part in ("color", "pose", "intrinsic"):
        (folder / part).mkdir(parents=True)
    for n in (0, 10, 20):
        Image.new("RGB", (48, 32), (n, 2 * n, 90)).save(folder / "color" / f"{n}.jpg")
        np.savetxt(folder / "pose" / f"{n}.txt", look_along_x(n / 100))
    np.savetxt(folder / "intrinsic" / "intrinsic_color.txt", INTRINSICS)
    (folder / f"{folder.name}.txt").write_text(
        "axisAlignment = 1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1 \n"
        "colorHeight = 32\ncolorWidth = 48\nnumColorFrames = 3\n"
    )


def make_sens(path: Path) -> None:
    color = [encode_color(np.full((32, 48, 3), 60 * n, np.uint8), "jpeg") for n in range(3)]
    depth = [zlib.compress(np.full((6, 8), 1000 + n, "<u2").tobytes()) for n in range(3)]
    path.write_bytes(encode_sens(color, depth, np.array([look_along_x(n / 100) for n in range(3)])))


def read_sens_file(folder: Path) -> None:
    path = folder / "scene0000_00.sens"
    with SensFile(path) as file:
        for index in range(min(len(file), 3)):
            file.read_color(index)
            file.read_depth(index)
    read_scene("scannet", folder, name=path.name)


def scans(root: Path) -> list[Input]:
    """Return recordings in all formats."""
    walk = make_walk(root / "walk")
    found = []

    def add(name: str, format: str, make: Callable[[Path], None], **more: Any) -> None:
        folder = root / name / "scene0000_00"
        make(folder)
        found.append(Input(name, folder, partial(read_scene, format), **more))

    def nerfstudio(folder: Path, **changes: Any) -> None:
        shutil.copytree(walk.folder, folder)
        moved = Walk(folder, walk.names, walk.poses, walk.image_size, walk.camera)
        write_transforms(moved, **changes)

    def colmap(folder: Path, *, binary: bool) -> None:
        shutil.copytree(walk.folder, folder)
        write_colmap(walk, folder / "sparse" / "0", binary=binary)

    transform = {"applied_transform": np.eye(4)[:3].tolist(), "k1": 0.0, "applied_scale": 1.0}
    add("nerfstudio", "nerfstudio", nerfstudio, files=("*.json", "*.json", "images/*"))
    add("nerfstudio-applied", "nerfstudio", lambda folder: nerfstudio(folder, **transform), files=("*.json",))
    add("colmap-text", "colmap", lambda folder: colmap(folder, binary=False), files=("sparse/**/*",))
    add("colmap-binary", "colmap", lambda folder: colmap(folder, binary=True), files=("sparse/**/*",))
    times = [0.1 * n for n in range(4)]
    add("tum", "tum", lambda folder: write_tum(walk, folder, times), files=("*.txt",))
    add("polycam", "arkit", lambda folder: make_polycam(folder, walk))
    add("scanner-app", "arkit", lambda folder: make_scanner(folder, walk))
    add("arkitscenes", "arkit", lambda folder: make_arkitscenes(folder, walk))
    add("record3d", "record3d", lambda folder: make_record3d(folder, walk))
    add("scannet", "scannet", make_scannet)
    for form in ("cpp", "odam", "mmdetection3d", "frames_25k"):
        add(
            f"scannet-{form}",
            "scannet",
            lambda folder, form=form: write_form(form, root / "scannet" / "scene0000_00", folder),
        )
    (root / "sens").mkdir()
    make_sens(root / "sens" / "scene0000_00.sens")
    found.append(Input("sens", root / "sens", read_sens_file))
    (root / "pictures").mkdir()
    for kind in ("exporter",):
        make_scannet(root / f"pictures-{kind}" / "scene0000_00")
    found.append(
        Input(
            "pictures",
            root / "pictures-exporter" / "scene0000_00",
            partial(read_scene, "scannet"),
            ("color/*",),
        )
    )
    if importlib.util.find_spec("av"):
        folder = root / "video"
        folder.mkdir()
        write_video(walk, folder / "walk.mp4")
        times = np.arange(4) / 10
        rows = [
            f"{time} {' '.join(map(str, pose[:3, 3]))} 0.5 0.5 0.5 0.5"
            for time, pose in zip(times, walk.poses, strict=True)
        ]
        (folder / "walk.txt").write_text("\n".join(rows))
        (folder / "walk.intrinsics.txt").write_text(" ".join(map(str, walk.camera)))
        found.append(Input("video", folder, partial(read_scene, "video")))
    return found


# ---------------------------------------------------------------- annotations, lists, CAD models

TRS = {"translation": [0.5, 1.0, 0.0], "rotation": [1.0, 0.0, 0.0, 0.0], "scale": [1.0, 1.0, 1.0]}


def annotation(scene_id: str, count: int = 2) -> dict[str, Any]:
    model = {"trs": TRS, "bbox": [0.5, 0.4, 0.3], "center": [0.0, 0.1, 0.0], "sym": "__SYM_NONE"}
    models = [model | {"catid_cad": "03001627", "id_cad": f"cube{n}"} for n in range(count)]
    return {
        "id_scan": scene_id,
        "trs": TRS,
        "n_aligned_models": count,
        "aligned_models": copy.deepcopy(models),
    }


def read_annotation_file(folder: Path) -> None:
    path = folder / "full_annotations.json"
    usable = read_usable(path)
    for scene in read_annotations(path).values():
        check_objects(scene_objects(scene))
        alignments = scene_alignments(scene)
        within(alignments.translation, -1e6, 1e6, "translations")
        within(alignments.scale, 0, 1e6, "scales")
    if any(len(part.reason) > 300 for part in usable.left_out):
        raise NonsenseError("a reason of more than 300 characters")


def read_lists(folder: Path) -> None:
    splits = read_splits(folder)
    for split in ("train", "val", "test"):
        names = read_split(folder, split) or []
        if any(len(name) > 200 or not name.isprintable() for name in [*names, *splits.get(split, ())]):
            raise NonsenseError("a name of a scan that is none")


CUBE = "".join(f"v {x} {y} {z}\n" for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5))


def make_model(folder: Path) -> None:
    models = folder / "03001627" / "cube" / "models"
    models.mkdir(parents=True)
    faces = "usemtl red\nf 1 2 4 3\nf 5/1/1 6/1/1 8/1/1\nusemtl blue\nf -1 -2 -3 -4\nf 1 2 6\nl 1 2\n"
    (models / "model_normalized.obj").write_text(
        f"# cube\nmtllib model_normalized.mtl\n{CUBE}vn 0 0 1\n{faces}"
    )
    (models / "model_normalized.mtl").write_text(
        "newmtl red\nKd 1 0 0\nnewmtl blue\nKd 0 0 1\nmap_Kd ../images/t.png\n"
    )
    (folder / "03001627" / "cube" / "images").mkdir()
    Image.new("RGB", (8, 8), (1, 2, 3)).save(folder / "03001627" / "cube" / "images" / "t.png")
    facts = {"id": "cube", "numVertices": 8, "min": [-0.5] * 3, "max": [0.5] * 3, "centroid": [0.0] * 3}
    (models / "model_normalized.json").write_text(json.dumps(facts))
    write_binvox(models / "model_normalized.solid.binvox", np.ones((4, 4, 4), dtype=bool), (0, 0, 0), 1.0)


def read_model(folder: Path) -> None:
    vertices, faces = read_obj(folder / "03001627" / "cube" / "models" / "model_normalized.obj")
    within(vertices, -1e9, 1e9, "vertices")
    within(faces, 0, len(vertices) - 1, "faces")
    index, colors = read_face_colors(
        folder / "03001627" / "cube" / "models" / "model_normalized.obj", len(faces)
    )
    within(colors, 0, 1, "colours")
    within(index, 0, len(colors) - 1, "indices of colours")
    within(read_mesh(folder, "03001627", "cube").vertices, -1e9, 1e9, "vertices")
    facts = read_facts(folder, "03001627", "cube")
    within([facts.low, facts.high, facts.centroid], -1e9, 1e9, "facts")
    cells, translate, scale = read_binvox(
        folder / "03001627" / "cube" / "models" / "model_normalized.solid.binvox"
    )
    within(cells.shape, 1, 512, "cells")
    within([*translate, scale], -1e9, 1e9, "place of voxels")


def make_model_v1(folder: Path) -> None:
    (folder / "03001627" / "cube").mkdir(parents=True)
    (folder / "03001627" / "cube" / "model.obj").write_text(CUBE + "f 1 2 4\nf 5 6 8\n")


def read_model_v1(folder: Path) -> None:
    mesh = read_mesh(folder, "03001627", "cube")
    within(mesh.vertices, -10, 10, "normalised vertices")


def read_scan_mesh(name: str, folder: Path) -> None:
    vertices, faces = scan_surface(folder / name, "")
    within(vertices, -1e9, 1e9, "vertices")
    within(faces, 0, len(vertices) - 1, "faces")


def read_library_file(folder: Path) -> None:
    library = read_library(folder / "library.json", folder)
    for model in library.models:
        within(model.size_m, 1e-6, 1e4, "sizes")


def read_furniture(folder: Path) -> None:
    with FurnitureLibrary(folder / "pieces.sh3f") as library:
        library.licence_text()
        for piece in list(library.pieces.values())[:3]:
            mesh = read_piece(library, piece)
            within(mesh.vertices, -1e6, 1e6, "vertices")


def make_furniture(path: Path) -> None:
    catalogue = (
        "name=Pieces\nlicense=CC\nid#1=one\nname#1=Chair\ncategory#1=Living\ncontent#1=/chair/chair.obj\n"
        "icon#1=/i.png\nwidth#1=50\ndepth#1=60\nheight#1=70\nmovable#1=true\ndoorOrWindow#1=false\ncreator#1=A\n"
        "model#1=/chair/chair.obj\nmultiPartModel#1=true\nelevation#1=0\n"
    )
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("PluginFurnitureCatalog.properties", catalogue)
        archive.writestr("LICENSE.TXT", "free")
        archive.writestr("chair/chair.obj", CUBE + "f 1 2 4 3\nf 5 6 8\nf 1 2 6\n")


def data(root: Path) -> list[Input]:
    """Return annotations, lists and CAD models."""
    names = (
        "annotations",
        "lists",
        "model-v2",
        "model-v1",
        "scan-mesh",
        "library",
        "furniture",
        "facts",
        "records",
        "cache",
        "frame-cameras",
    )
    folders = {name: root / name for name in names}
    for name in set(names) - {"model-v2", "model-v1"}:
        folders[name].mkdir()
    (folders["annotations"] / "full_annotations.json").write_text(
        json.dumps([annotation("scene0000_00"), annotation("scene0001_00", 0), annotation("scene0002_00", 1)])
    )
    for split in ("train", "val", "test"):
        (folders["lists"] / f"scannetv2_{split}.txt").write_text(f"{split}_00\n{split}_01\n")
    make_model(folders["model-v2"])
    make_model_v1(folders["model-v1"])
    box = trimesh.creation.box()
    for ending in ("ply", "obj"):
        box.export(folders["scan-mesh"] / f"mesh.{ending}")
    (folders["scan-mesh"] / "ascii.ply").write_bytes(box.export(file_type="ply", encoding="ascii"))
    model = {"catid": "03001627", "model_id": "cube", "category": "chair", "kind": "chair", "symmetry": 1}
    library = {
        "models": [model | {"size_m": [1.0, 1.0, 1.0], "split": "train"}],
        "left_out": {},
        "digest": "abc",
    }
    (folders["library"] / "library.json").write_text(json.dumps(library))
    make_furniture(folders["furniture"] / "pieces.sh3f")
    facts = folders["facts"] / "scannet" / "scans" / "scene0000_00"
    facts.mkdir(parents=True)
    (facts / "prepared.json").write_text(
        json.dumps({"frames": ["0", "10"], "image_size": [32, 48], "dropped": {}})
    )
    (folders["records"] / "rooms.json").write_text(
        json.dumps({"seed": 0, "frames": 20, "image_size": [180, 240]})
    )
    MaskCache(folder=folders["cache"]).write("masks", "abcdef", np.ones((4, 8), dtype=bool))

    def read_record_file(folder: Path) -> None:
        record = SettingsRecord(folder / "rooms.json")
        record.begin({"seed": 0, "frames": 20, "image_size": [180, 240]})

    def read_cache(folder: Path) -> None:
        MaskCache(folder=folder).read("masks", "abcdef", (4, 8))

    def read_frame_lenses(folder: Path) -> None:
        matrices, picture = read_frame_cameras(folder / "frames.txt", ["0", "a 1"])
        within(matrices[:, [0, 1], [0, 1]], 1e-2, 1e7, "focal lengths")
        within(matrices[:, :2, 2], -1e6, 1e6, "principal points")
        if picture is not None:
            within(picture[:, 2:] - picture[:, :2], 0, 2e6, "sides of pictures")

    (folders["frame-cameras"] / "frames.txt").write_text(
        "0\t40.5 41 24 16 0 0 48 32\na 1\t40 41 24 16 8 0 40 32\n"
    )
    meshes = [
        Input(f"scan-mesh-{name}", folders["scan-mesh"], partial(read_scan_mesh, name), (name,))
        for name in ("mesh.ply", "ascii.ply", "mesh.obj")
    ]
    return [
        Input("annotations", folders["annotations"], read_annotation_file),
        Input("lists", folders["lists"], read_lists),
        Input("model-v2", folders["model-v2"], read_model),
        Input("model-v1", folders["model-v1"], read_model_v1),
        *meshes,
        Input("library", folders["library"], read_library_file),
        Input("furniture", folders["furniture"], read_furniture),
        Input("facts", folders["facts"], lambda folder: read_prepared_facts(folder, "scene0000_00") and None),
        Input("records", folders["records"], read_record_file),
        Input("cache", folders["cache"], read_cache),
        Input("frame-cameras", folders["frame-cameras"], read_frame_lenses),
    ]


# ---------------------------------------------------------------- predictions, results and runs


def make_objects(count: int = 2) -> ObjectSet:
    return ObjectSet(
        label=torch.arange(count),
        center=torch.rand(count, 3),
        size=torch.rand(count, 3) + 0.2,
        rotation=torch.eye(3).repeat(count, 1, 1),
        symmetry=torch.ones(count, dtype=torch.int64),
        score=torch.linspace(0.9, 0.6, count),
    )


ROW = "03001627,cube0,1,2,0.5,1,0,0,0,1,1,1"


def read_predicted(folder: Path) -> None:
    check_objects(read_scene_json(folder / "scene.json").objects)
    check_objects(read_truth(folder / "scene.json", "scene0000_00"))


def read_csv_of_scan(folder: Path) -> None:
    cads = read_alignments_csv(folder / "scene0000_00.csv")
    within(cads.translation, -1e6, 1e6, "translations")
    within(cads.scale, 1e-6, 1e6, "scales")


def read_csv_of_all(folder: Path) -> None:
    for cads in read_roca_csv(folder / "roca.csv").values():
        within(cads.translation, -1e6, 1e6, "translations")
        within(cads.score, -1e6, 1e6, "scores")


def read_evaluation(folder: Path) -> None:
    evaluation = evaluate_predictions(
        folder / "predictions",
        folder / "full_annotations.json",
        "all",
        split=folder / "split.txt",
        num_resamples=5,
        volume_extent=[9.0, 9.0, 3.5],
    )
    json.dumps(evaluation.metrics, allow_nan=False)
    read_predictions(folder / "predictions", ["scene0000_00"], {})


def read_map_evaluation(folder: Path) -> None:
    evaluation = evaluate_predictions(
        folder / "predictions", folder / "truth", "map", boxes="axis_aligned", num_resamples=5
    )
    json.dumps(evaluation.metrics, allow_nan=False)


def read_result(folder: Path) -> None:
    scene = read_viewer_scene(folder)
    check_objects(scene.objects)
    for objects in (scene.objects, scene.truth):
        if objects is not None:
            within(objects.label, 0, len(objects.classes) - 1, "labels")
    within(scene.cameras.world_from_camera, -1e6, 1e6, "poses")
    within(scene.cameras.intrinsics, -1e7, 1e7, "intrinsics")
    for volume in scene.volumes:
        within(volume.grid.center, -1e6, 1e6, "centre of a grid")
        volume.voxel_at(np.zeros(3))
        if volume.reads is not None:
            for voxel in range(0, volume.grid.num_voxels, 7):
                x, rest = divmod(voxel, volume.grid.resolution[1] * volume.grid.resolution[2])
                y, z = divmod(rest, volume.grid.resolution[2])
                pixels = volume.pixels_of((x, y, z))
                within(pixels.view, 0, len(scene.frame_ids) - 1, "views of a voxel")


def make_result(folder: Path) -> None:
    objects = replace(make_objects(), classes=Classes(("drill", "lathe")))
    prediction = ScenePrediction("scene0000_00", objects, torch.zeros(3))
    meshes = [trimesh.creation.icosphere(subdivisions=1), None]
    write_prediction(folder, prediction, meshes)
    from raytran.geometry.camera import Cameras
    from raytran.geometry.grid import VoxelGrid
    from raytran.ops.traverse import trace_pairs
    from raytran.viewer.attention import pack_reads

    views = make_views()
    grid = VoxelGrid((4, 4, 2), (4.0, 4.0, 2.0), torch.zeros(3))
    cameras = Cameras(views.intrinsics[0], views.world_from_camera[0], views.image_size)
    pairs = trace_pairs(cameras, grid, (2, 3))
    counts = pairs.pixels_per_voxel()
    reads = pack_reads(torch.repeat_interleave(1 / counts[counts > 0], counts[counts > 0]), pairs, (2, 3))
    volume = VoxelVolume(grid, [0, 1], torch.rand(4, 4, 2), torch.ones(4, 4, 2, dtype=torch.int64), reads)
    write_viewer_data(folder, views, ["0", "1"], volumes=[volume], truth=objects)


def change_about(folder: Path, rng: random.Random) -> None:
    """Change what the viewer's file says of itself."""
    path = folder / "viewer.npz"
    with np.load(path) as file:
        arrays = dict(file)
    text = json_text(mutated_json(json.loads(arrays["about"].tobytes()), rng))
    arrays["about"] = np.frombuffer(text.encode("utf-8", "surrogatepass"), np.uint8)
    if rng.random() < 0.3:
        name = rng.choice(sorted(arrays))
        arrays[name] = rng.choice(
            (
                arrays[name].astype(np.float64) * 1e300,
                arrays[name][:1],
                np.zeros((3, 0)),
                np.array(5),
                arrays[name][None],
            )
        )
    np.savez_compressed(path, **arrays)


def read_cameras(folder: Path) -> None:
    cameras = read_render_cameras(folder / "cameras.json")
    within(cameras.world_from_camera, -1e6, 1e6, "poses")
    for lens in cameras.lenses:
        within(lens.size, 1, 8192, "image size")
        within(lens.matrix[[0, 1], [0, 1]], 1e-2, 1e7, "focal lengths")


def make_run(folder: Path) -> None:
    folder.mkdir(parents=True)
    mark = {
        "stage": "stage1",
        "preset": "tiny",
        "experiment": "stage1",
        "checkpoint": "checkpoints/last.ckpt",
    }
    (folder / "finished.json").write_text(json.dumps(mark | {"steps": 4, "time": "2026-01-01", "data": None}))
    job = {"overrides": ["seed=1"], "folder": "0"}
    (folder / "sweep.json").write_text(json.dumps({"command": ["train", "seed=1"], "jobs": [job]}))
    (folder / "metrics.csv").write_text("step,epoch,val/iou,loss\n0,0,0.5,1.5\n10,0,,1.25\n20,0,0.7,nan\n")
    curve = {"threshold": [0.1, 0.2], "class_average": [0.3, 0.4]}
    curves = dict.fromkeys(("translation", "rotation", "scale", "joint"), curve)
    (folder / "metrics.json").write_text(json.dumps({"strict": {"curves": curves}}))


def read_run(folder: Path) -> None:
    mark = read_finished(folder)
    if mark is not None and Path(mark.checkpoint).is_absolute():
        raise NonsenseError("a checkpoint elsewhere")
    for job in read_record(folder)["jobs"] if (folder / "sweep.json").is_file() else []:
        if ".." in Path(job["folder"]).parts:
            raise NonsenseError("a folder elsewhere")
    last_value(folder, "val/iou")
    read_curves([folder])


def results(root: Path) -> list[Input]:
    """Return predictions, results of commands, and records of runs."""
    folders = {
        name: root / name
        for name in ("scene", "csv", "roca", "evaluate", "map", "cameras", "render", "run", "viewer")
    }
    for name in ("csv", "roca", "cameras", "render"):
        folders[name].mkdir()
    prediction = ScenePrediction("scene0000_00", make_objects(), torch.zeros(3))
    write_prediction(folders["scene"], prediction, [None, None])
    (folders["csv"] / "scene0000_00.csv").write_text(f"{ROW}\n{ROW}\n")
    header = "id_scan,objectCategory,alignedModelId,tx,ty,tz,qw,qx,qy,qz,sx,sy,sz,object_score"
    (folders["roca"] / "roca.csv").write_text(
        f"{header}\nscene0000_00,3001627,{ROW.partition(',')[2]},0.9\n" * 1
    )
    inner = folders["evaluate"] / "predictions"
    inner.mkdir(parents=True)
    (inner / "scene0000_00.csv").write_text(f"{ROW}\n{ROW}\n")
    shutil.copy(folders["scene"] / "scene.json", inner / "scene0002_00.json")
    text = (inner / "scene0002_00.json").read_text().replace("scene0000_00", "scene0002_00")
    (inner / "scene0002_00.json").write_text(text)
    (folders["evaluate"] / "full_annotations.json").write_text(
        json.dumps([annotation("scene0000_00"), annotation("scene0002_00")])
    )
    (folders["evaluate"] / "split.txt").write_text("scene0000_00\nscene0002_00\n")
    for name in ("truth", "predictions"):
        (folders["map"] / name).mkdir(parents=True)
    shutil.copy(inner / "scene0002_00.json", folders["map"] / "truth")
    rows = [f"0,1,2,0.5,1,0,0,0,1,1,1,{name},0,32,0.9\n" for name in ("bathtub", "coffee table")]
    boxer = folders["map"] / "predictions" / "scene0002_00.csv"
    boxer.write_text("".join([",".join(BOXER_COLUMNS) + "\n", *rows]))
    pose = look_along_x(0.0).tolist()
    view = {"world_from_camera": pose, "name": "a"}
    views = {
        "views": [view, view | {"name": "b"}],
        "intrinsics": [40.0, 40.0, 24.0, 16.0],
        "image_size": [32, 48],
    }
    (folders["cameras"] / "cameras.json").write_text(json.dumps(views))
    frames = {
        "frames": [{"transform_matrix": pose}],
        "fl_x": 40,
        "fl_y": 40,
        "cx": 24,
        "cy": 16,
        "w": 48,
        "h": 32,
    }
    (folders["render"] / "cameras.json").write_text(json.dumps(frames))
    make_run(folders["run"])
    make_result(folders["viewer"])
    return [
        Input("scene.json", folders["scene"], read_predicted),
        Input("csv", folders["csv"], read_csv_of_scan),
        Input("roca-csv", folders["roca"], read_csv_of_all),
        Input("evaluate", folders["evaluate"], read_evaluation),
        Input("evaluate-map", folders["map"], read_map_evaluation),
        Input("viewer", folders["viewer"], read_result, ("*",), change_about),
        Input("viewer-mesh", folders["viewer"], read_result, ("meshes/*",)),
        Input("cameras", folders["cameras"], read_cameras),
        Input("render-cameras", folders["render"], read_cameras),
        Input("run", folders["run"], read_run),
    ]


# ---------------------------------------------------------------- boxes


CATEGORIES = Categories(PAPER_CLASSES, unknown_left_out=True)


def check_boxed(objects: BoxedObjects) -> None:
    """Raise unless objects that were annotated by boxes can be."""
    within(objects.center, -1e6, 1e6, "centres")
    within(objects.size, 1e-6, 1e6, "sizes")
    turns = objects.rotation
    within(turns.swapaxes(1, 2) @ turns - np.eye(3), -0.05, 0.05, "RᵀR - 1")
    within(np.linalg.det(turns), 0.9, 1.1, "determinants")
    for mesh in (*objects.mesh, objects.scan_mesh):
        if mesh is not None:
            within(mesh[0], -1e9, 1e9, "vertices")
    if not len(objects):
        raise NonsenseError("an annotation without objects")


def read_listed(folder: Path) -> None:
    listed = read_box_list(folder / "boxes.json")
    check_boxed(boxed_objects(listed, CATEGORIES, world_from_input=None, scan_mesh=None))


def read_arkit_boxes(folder: Path) -> None:
    scan = ArkitScan(folder / "1", None, CATEGORIES)
    with read_scan(folder / "scan") as frames:
        check_boxed(scan.read_objects(frames))


def read_boxed_mesh(folder: Path) -> None:
    grid = shape_grids(("chair/a.000",), shapenet_root=folder, cache=MaskCache(folder=folder / "cache"))
    within(grid.double(), 0, 1, "cells")


def boxes(root: Path) -> list[Input]:
    """Return annotations by boxes, and the mesh in one."""
    for name in ("boxes", "arkit-boxes/1", "boxed/chair/a.000/models"):
        (root / name).mkdir(parents=True)
    box = trimesh.creation.box((0.5, 0.5, 0.9))
    box.export(root / "boxes" / "chair.ply")
    entry = {"category": "chair", "center": [1.0, 0, 0.4], "size": [0.5, 0.9, 0.5], "yaw": 0.5}
    turn = {"yaw": None, "rotation": [[1, 0, 0], [0, 0, -1], [0, 1, 0]], "symmetry": 2}
    others = [entry | {"mesh": "chair.ply"}, entry | turn]
    content = {"format": "raytran.scene/1", "split": "val", "objects": [entry, *others]}
    content |= {"capture": {"scale": 1.0}, "unit": "m"}
    (root / "boxes" / "boxes.json").write_text(json.dumps(content))
    axes = [0.8, 0.6, 0, -0.6, 0.8, 0, 0, 0, 1]
    segments = {
        "obbAligned": {"centroid": [1, 2, 0.4], "axesLengths": [0.5, 0.6, 0.9], "normalizedAxes": axes}
    }
    data = [{"label": label, "segments": segments} for label in ("chair", "lamp", "table")]
    folder = root / "arkit-boxes"
    (folder / "1" / "1_3dod_annotation.json").write_text(json.dumps({"data": data, "skipped": False}))
    box.export(folder / "1" / "1_3dod_mesh.ply")
    make_scannet(folder / "scan")
    (root / "boxed" / "chair" / "a.000" / "models" / BOXED).write_text(obj_text(box_mesh()))
    return [
        Input("boxes", root / "boxes", read_listed),
        Input("arkit-boxes", folder, read_arkit_boxes, ("1/*",)),
        Input("boxed-mesh", root / "boxed", read_boxed_mesh),
    ]


# ---------------------------------------------------------------- checkpoints


def read_weights_of(name: str, folder: Path) -> None:
    settings = prediction_settings(folder / name)
    within(settings.image_size, 1, 8192, "image size")
    within(settings.num_views, 1, 1e5, "views")
    model = load_model(folder / name)
    within(model.grid_resolution, 1, 2048, "voxels")
    within(model.grid_extent, 1e-6, 1e4, "sizes of the grid")
    for value in model.state_dict().values():
        within(value, -3.5e38, 2**63, "weights")


def change_content(content: dict[str, Any], name: str, folder: Path, rng: random.Random) -> None:
    """Write a checkpoint whose description, facts or tensors are changed."""
    state = dict(content["state_dict"])
    rest = copy.deepcopy({key: value for key, value in content.items() if key != "state_dict"})
    if rng.random() < 0.3:
        key = rng.choice(sorted(state))
        value = state[key]
        bad = value.clone().double().reshape(-1)
        bad[rng.randrange(len(bad))] = rng.choice((float("nan"), float("inf"), 1e300))
        state[key] = rng.choice(
            (
                bad.reshape(value.shape),
                value.reshape(-1)[:1].expand(1_000_000_000),
                value[..., None],
                value.reshape(-1)[:0],
                torch.zeros(3, dtype=torch.int8),
                value.to(torch.complex64),
            )
        )
    else:
        plain = json.loads(json.dumps(rest))
        for part in rng.sample(("model", "views", "model", "model", ""), 1):
            if part:
                plain[part] = mutated_json(plain[part], rng)
            else:
                plain = mutated_json(plain, rng)
        rest = with_raw_values(plain)
    path = folder / name
    if path.suffix == ".ckpt":
        write_checkpoint(path, {**rest, "state_dict": state})
    else:
        weights = {key.removeprefix(PREFIX): value for key, value in state.items()}
        weights = {key: value if value.numel() < 10**6 else value[:3] for key, value in weights.items()}
        write_weights(path, rest, weights)


def read_encoder(folder: Path) -> None:
    read_state(folder / "encoder.pth", name="ResNet-18", remedy="get it")


def checkpoints(root: Path) -> list[Input]:
    """Return checkpoints in both kinds of files, and weights of an image encoder."""
    settings = ["preset=tiny", "model.grid_resolution=[8,8,4]", "model.backbone.num_blocks=1"]
    settings += ["model.heads.objects.num_layers=1", "model.backbone.channels=24"]
    config = compose("train", [*settings, "views.image_size=[32,48]", "output_dir=unused"])
    metadata = checkpoint_metadata(stage="stage2", preset="tiny", config=plain(config), parent=None)
    model = build_model(config, pretrained=False)
    state = {f"{PREFIX}{name}": value for name, value in model.state_dict().items()}
    content = {**metadata, "global_step": 4, "scores": {"val/loss": 1.0}, "state_dict": state}
    for name in ("ckpt", "safetensors", "encoder"):
        (root / name).mkdir()
    write_checkpoint(root / "ckpt" / "last.ckpt", content)
    write_weights(root / "safetensors" / "w.safetensors", metadata, model.state_dict())
    torch.save(torch.nn.Linear(2, 3).state_dict(), root / "encoder" / "encoder.pth")
    return [
        Input(
            "ckpt",
            root / "ckpt",
            partial(read_weights_of, "last.ckpt"),
            change=partial(change_content, content, "last.ckpt"),
        ),
        Input(
            "safetensors",
            root / "safetensors",
            partial(read_weights_of, "w.safetensors"),
            change=partial(change_content, {**metadata, "state_dict": state}, "w.safetensors"),
        ),
        Input("encoder", root / "encoder", read_encoder),
    ]


def all_inputs(root: Path) -> list[Input]:
    """Write a valid input of every kind below a folder, and return them; each is read once as it is."""
    root.mkdir(parents=True)
    torch.manual_seed(0)
    return [*scans(root), *data(root), *results(root), *boxes(root), *checkpoints(root)]
