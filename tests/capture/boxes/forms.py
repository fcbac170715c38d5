# SPDX-License-Identifier: Apache-2.0
"""Generated rooms in the forms in which people have them: captures with lists of boxes, and ARKitScenes."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from PIL import Image
from scipy.spatial.transform import Rotation

from raytran.rooms.scene import RoomSettings, make_scene

from ..forms import Walk, words, write_colmap, write_tum, write_video

SETTINGS = RoomSettings(
    seed=3,
    frames=10,
    image_size=(48, 64),
    min_objects=3,
    max_objects=6,
    room_size=((2.8, 3.6), (2.8, 3.6)),
)


@dataclass(frozen=True)
class RoomScan:
    """A furnished room as it was taken: poses are OpenCV, all in one world with +z up, metres."""

    images: list[np.ndarray]
    poses: np.ndarray
    camera: tuple[float, float, float, float]
    category: list[str]
    center: np.ndarray
    size: np.ndarray
    rotation: np.ndarray
    vertices: np.ndarray
    faces: np.ndarray


def room_scan(number: int, settings: RoomSettings = SETTINGS) -> RoomScan:
    """Return one room; the same number gives the same."""
    rng = np.random.default_rng([settings.seed, number])
    scene = make_scene(settings, rng)
    height, width = settings.image_size
    still = np.zeros((height, width, 3), dtype=np.float32)
    intrinsics = scene.cameras[0].intrinsics
    centers, sizes, rotations, triangles = [], [], [], [scene.room.surfaces.triangles]
    for placed in scene.objects:
        middle, half = placed.cad_box
        pose = scene.scan_from_room @ np.block(
            [[placed.rotation, np.asarray(placed.translation)[:, None]], [np.zeros((1, 3)), np.ones((1, 1))]]
        )
        centers.append(pose[:3, :3] @ (middle * placed.scale) + pose[:3, 3])
        sizes.append(2 * half * placed.scale)
        rotations.append(pose[:3, :3])
        triangles.append(placed.triangles())
    corners = np.concatenate(triangles).reshape(-1, 3).astype(np.float64)
    moved = corners @ scene.scan_from_room[:3, :3].T + scene.scan_from_room[:3, 3]
    return RoomScan(
        images=[scene.renderer.render(camera, still) for camera in scene.cameras],
        poses=np.array([scene.scan_from_room @ camera.room_from_camera for camera in scene.cameras]),
        camera=tuple(intrinsics[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()),
        category=[placed.model.category for placed in scene.objects],
        center=np.array(centers),
        size=np.array(sizes),
        rotation=np.array(rotations),
        vertices=moved,
        faces=np.arange(len(moved)).reshape(-1, 3),
    )


def listed(scan: RoomScan, **changes) -> list[dict]:
    """Return the room's boxes as a list."""
    return [
        {
            "category": category,
            "center": center.tolist(),
            "size": size.tolist(),
            "rotation": rotation.tolist(),
            **changes,
        }
        for category, center, size, rotation in zip(
            scan.category, scan.center, scan.size, scan.rotation, strict=True
        )
    ]


def write_mesh(scan: RoomScan, path: Path) -> None:
    """Write the mesh of the whole room."""
    trimesh.Trimesh(scan.vertices, scan.faces, process=False).export(path)


def write_capture(scan: RoomScan, folder: Path, kind: str, boxes: object = None) -> Path:
    """Write a capture of a kind, with its list of boxes, and return its path.

    Args:
        scan: the room.
        folder: of the capture; for ``video file`` a video is written beside it.
        kind: ``colmap``, ``tum``, ``video`` or ``video file``.
        boxes: content of the list; None: the room's boxes.
    """
    raw = folder.parent / f".{folder.name}"
    (raw / "images").mkdir(parents=True)
    names = tuple(f"{n}.png" for n in range(len(scan.images)))
    for name, image in zip(names, scan.images, strict=True):
        Image.fromarray(image).save(raw / "images" / name)
    walk = Walk(raw, names, scan.poses, scan.images[0].shape[:2], scan.camera)
    boxes = listed(scan) if boxes is None else boxes
    if kind == "colmap":
        write_colmap(walk, folder, binary=True)
        (raw / "images").rename(folder / "images")
    elif kind == "tum":
        write_tum(walk, folder, [1e9 + 0.1 * n for n in range(len(names))])
    else:
        target = folder.parent if kind == "video file" else folder
        target.mkdir(exist_ok=True)
        write_video(walk, target / f"{folder.name}.mp4")
        track = [
            f"{0.1 * n:.6f} {words([*pose[:3, 3], *_quaternion(pose)])}" for n, pose in enumerate(scan.poses)
        ]
        (target / f"{folder.name}.txt").write_text("\n".join(track))
        (target / f"{folder.name}.intrinsics.txt").write_text(" ".join(map(str, scan.camera)))
    path = folder.with_name(f"{folder.name}.boxes.json") if kind == "video file" else folder / "boxes.json"
    path.write_text(json.dumps(boxes))
    return folder.with_suffix(".mp4") if kind == "video file" else folder


def _quaternion(pose: np.ndarray) -> list[float]:
    return Rotation.from_matrix(pose[:3, :3]).as_quat().tolist()


def write_arkitscenes(scan: RoomScan, folder: Path, *, quarters: int = 0, with_mesh: bool = True) -> Path:
    """Write a scan as ARKitScenes releases it, its name that of the folder.

    Poses come ten times a second; the times of images, poses and intrinsics differ by milliseconds, and two
    images are of after the last pose. The sensor stays as it is however the phone is held: images of a phone
    held upright lie on their side.

    Args:
        scan: the room.
        folder: ``…/Training/<id>``.
        quarters: quarter turns counter-clockwise by which the phone is held.
        with_mesh: write the mesh.
    """
    name = folder.name
    frames = folder / f"{name}_frames"
    for part in ("lowres_wide", "lowres_wide_intrinsics", "lowres_depth"):
        (frames / part).mkdir(parents=True)
    rng = np.random.default_rng(int(name))
    rows = []
    height, width = scan.images[0].shape[:2]
    fx, fy, cx, cy = scan.camera
    for _ in range(quarters):
        (fx, fy, cx, cy), (height, width) = (fy, fx, cy, width - cx), (width, height)
    turn = Rotation.from_rotvec([0, 0, -np.pi / 2 * quarters]).as_matrix()
    for n, (image, pose) in enumerate(zip(scan.images, scan.poses, strict=True)):
        stored = np.ascontiguousarray(np.rot90(image, quarters))
        held = pose.copy()
        held[:3, :3] = pose[:3, :3] @ turn.T
        time = 3211.4 + n / 10
        inverse = np.linalg.inv(held)
        rotation = Rotation.from_matrix(inverse[:3, :3]).as_rotvec()
        values = [*rotation.tolist(), *inverse[:3, 3].tolist()]
        rows.append(" ".join([f"{time + rng.uniform(-0.002, 0.002):.6f}", *(repr(v) for v in values)]))
        Image.fromarray(stored).save(frames / "lowres_wide" / f"{name}_{time:.3f}.png")
        pincam = (
            frames / "lowres_wide_intrinsics" / f"{name}_{time + rng.choice([-1, 0, 1]) / 1000:.3f}.pincam"
        )
        wobble = 1 + 0.001 * rng.standard_normal()
        pincam.write_text(" ".join(map(str, (width, height, fx * wobble, fy * wobble, cx, cy))))
    (frames / "lowres_wide.traj").write_text("\n".join(rows) + "\n")
    for late in (0.05, 1.0):
        Image.fromarray(stored).save(frames / "lowres_wide" / f"{name}_{time + late:.3f}.png")
    # Axes are rows; their order, and which way each points, tell nothing.
    data = []
    for i, (category, center, size, rotation) in enumerate(
        zip(scan.category, scan.center, scan.size, scan.rotation, strict=True)
    ):
        order = [0, 2, 1] if i % 2 else [2, 0, 1]
        axes = rotation.T[order] * np.array([1.0, -1.0, 1.0])[:, None]
        box = {
            "centroid": center.tolist(),
            "axesLengths": size[order].tolist(),
            "normalizedAxes": axes.ravel().tolist(),
        }
        data.append({"uid": str(i), "label": category, "modelId": "", "segments": {"obbAligned": box}})
    content = {"data": data, "skipped": False, "stats": {}, "comment": ""}
    (folder / f"{name}_3dod_annotation.json").write_text(json.dumps(content))
    if with_mesh:
        write_mesh(scan, folder / f"{name}_3dod_mesh.ply")
    return folder
