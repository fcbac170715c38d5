# SPDX-License-Identifier: Apache-2.0
"""A result folder as predict writes it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pytest
import torch
import trimesh

from raytran.export import write_prediction
from raytran.geometry.camera import Cameras
from raytran.geometry.grid import VoxelGrid
from raytran.geometry.rotation import rotation_from_yaw
from raytran.ops.traverse import count_views, trace_pairs
from raytran.structs import ObjectSet, ScenePrediction, Views
from raytran.viewer.attention import VoxelReads, pack_reads
from raytran.viewer.data import VoxelVolume, write_viewer_data

EXTENT = (8.0, 8.0, 3.0)


def make_objects(count: int) -> ObjectSet:
    """Objects 0.8 m long and 0.6 m high on a lattice of a metre, of all classes in turn, ever weaker."""
    number = torch.arange(count)
    x, y = number % 6 - 2.5, number // 6 - 2.0
    return ObjectSet(
        label=number % 9,
        center=torch.stack([x, y, torch.full((count,), 0.3)], dim=1),
        size=torch.tensor([0.8, 0.6, 0.5]).expand(count, 3),
        rotation=rotation_from_yaw(0.3 * number),
        symmetry=torch.ones(count, dtype=torch.int64),
        score=torch.linspace(0.95, 0.55, count),
    )


def make_mesh(objects: ObjectSet, index: int, subdivisions: int) -> trimesh.Trimesh:
    """A ball that fills the object's box; of five subdivisions it has 20,480 faces."""
    ball = trimesh.creation.icosphere(subdivisions=subdivisions, radius=0.5)
    vertices = torch.tensor(ball.vertices.copy(), dtype=torch.float32) * objects.size[index]
    placed = vertices @ objects.rotation[index].T + objects.center[index]
    return trimesh.Trimesh(placed.numpy(), ball.faces, process=False)


def make_views(count: int, size: tuple[int, int]) -> Views:
    """Cameras on a circle that look at the middle of the room."""
    angle = torch.linspace(0, 2 * torch.pi, count + 1)[:-1]
    position = torch.stack([3.5 * angle.cos(), 3.5 * angle.sin(), torch.full_like(angle, 1.6)], dim=1)
    forward = torch.nn.functional.normalize(torch.tensor([0.0, 0.0, 0.4]) - position, dim=1)
    right = torch.nn.functional.normalize(
        torch.linalg.cross(forward, torch.tensor([[0.0, 0.0, 1.0]]), dim=1), dim=1
    )
    pose = torch.eye(4).repeat(1, count, 1, 1)
    down = torch.linalg.cross(forward, right, dim=1)
    pose[0, :, :3, :3] = torch.stack([right, down, forward], dim=2)
    pose[0, :, :3, 3] = position
    height, width = size
    intrinsics = torch.tensor([[0.8 * width, 0, width / 2], [0, 0.8 * width, height / 2], [0, 0, 1]])
    ramp = torch.linspace(0, 255, width).to(torch.uint8).expand(1, count, 3, height, width).clone()
    ramp[:, :, 1] = (torch.arange(count) * 40 % 256).to(torch.uint8)[None, :, None, None]
    return Views(ramp, intrinsics.expand(1, count, 3, 3), pose)


def make_reads(views: Views, frames: Sequence[int], grid: VoxelGrid) -> VoxelReads:
    """Every voxel reads all pixels that see it alike."""
    index, size = list(frames), views.image_size
    cameras = Cameras(views.intrinsics[0, index], views.world_from_camera[0, index], size)
    pairs = trace_pairs(cameras, grid, (size[0] // 16, size[1] // 16))
    counts = pairs.pixels_per_voxel()
    weight = torch.repeat_interleave(1 / counts[counts > 0], counts[counts > 0])
    return pack_reads(weight, pairs, (size[0] // 16, size[1] // 16))


def write_result(
    folder: Path,
    *,
    num_objects: int = 6,
    num_frames: int = 5,
    size: tuple[int, int] = (48, 64),
    subdivisions: int = 2,
    with_viewer: bool = True,
    in_parts: bool = False,
) -> Path:
    """Write a scene of which the truth is known: object 0 is as predicted, the others stand 30 cm beside.

    In parts, each half of the frames belongs to a volume of its own, which lies a metre left or right.
    """
    folder.mkdir(parents=True)
    resolution = (16, 16, 6)
    objects, views = make_objects(num_objects), make_views(num_frames, size)
    grid = VoxelGrid(resolution, EXTENT, torch.tensor([0.0, 0.0, 1.0]))
    centers = grid.voxel_centers()
    prediction = ScenePrediction(folder.name, objects, grid.center)
    write_prediction(folder, prediction, [make_mesh(objects, n, subdivisions) for n in range(num_objects)])
    if with_viewer:
        volume = VoxelVolume(
            grid=grid,
            frames=range(num_frames),
            occupancy=0.9
            * ((centers[..., 2] < 0.6) & (centers[..., :2].norm(dim=-1) < 3) & (centers[..., 0] > 0)),
            view_count=count_views(Cameras(views.intrinsics[0], views.world_from_camera[0], size), grid),
            reads=None if in_parts else make_reads(views, range(num_frames), grid),
        )
        volumes = [volume]
        for frames, x in [(range(num_frames // 2), -1.0), (range(num_frames // 2, num_frames), 1.0)]:
            part = VoxelGrid(resolution, EXTENT, torch.tensor([x, 0.0, 1.0]))
            volumes += [VoxelVolume(part, frames, reads=make_reads(views, frames, part))] if in_parts else []
        truth = make_objects(num_objects)
        truth.center[1:, 1] += 0.3
        names = [f"{10 * n:06d}" for n in range(num_frames)]
        write_viewer_data(folder, views, names, volumes=volumes, truth=truth)
    return folder


@pytest.fixture(scope="session")
def result(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_result(tmp_path_factory.mktemp("viewer") / "results" / "room")
