# SPDX-License-Identifier: Apache-2.0
"""Functions compute on the device of their tensors: run on a pretend GPU, and by what the sources say."""

from __future__ import annotations

import ast
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from raytran.extensions.unprojection import pair_centers
from raytran.geometry.boxes import OrientedBoxes, box_iou
from raytran.geometry.camera import Cameras
from raytran.geometry.checks import check_views, rigid_motions
from raytran.geometry.grid import VoxelGrid, position_code, ray_code
from raytran.geometry.rasterize import rasterize_mask
from raytran.geometry.room_tiles import Volumes, cover
from raytran.geometry.rotation import (
    geodesic_angle,
    matrix_from_quaternion,
    quaternion_from_matrix,
    rotation_from_yaw,
    symmetric_yaw_error,
    upright_basis,
    yaw_from_rotation,
)
from raytran.metrics.functional.alignment import alignment_errors
from raytran.metrics.functional.detection import average_precision, best_f1, match_in_order, score_order
from raytran.metrics.functional.shape import chamfer_distance, surface_points
from raytran.metrics.new_views import nearest_frames, psnr_of_frames
from raytran.ops import reference
from raytran.ops.pairs import PairList
from raytran.ops.ray_attention import ray_attention
from raytran.ops.splat import splat_features
from raytran.ops.traverse import count_views, trace_pairs, voxel_rays
from raytran.postprocess import count_object_views, merge_volumes, object_meshes, select_objects
from raytran.structs import ObjectSet, ScenePrediction, Views
from raytran.viewer.attention import attention_weights

from .pretend_device import DEVICE, on_pretend_device, recorded

RESOLUTION, EXTENT = (8, 4, 4), (6.0, 6.0, 3.0)
TRIANGLE = [[0, 1, 0], [1, 1, 0], [0, 1, 1]], [[0, 1, 2]]


class Inputs:
    """The same inputs at every time, on a device."""

    def __init__(self, device: str) -> None:
        self._device = device

    def random(self, *shape: int) -> Tensor:
        return torch.rand(*shape, generator=torch.Generator().manual_seed(sum(shape))).to(self._device)

    def boxes(self, count: int = 6) -> OrientedBoxes:
        yaw = 3 * self.random(count)
        return OrientedBoxes(self.random(count, 3), self.random(count, 3) + 0.5, rotation_from_yaw(yaw))

    def objects(self, count: int = 6) -> ObjectSet:
        boxes, score = self.boxes(count), self.random(count)
        ones = torch.ones_like(score, dtype=torch.int64)
        return ObjectSet(ones, boxes.center, boxes.size, boxes.rotation, ones, score)

    def prediction(self, count: int = 6) -> ScenePrediction:
        center, seen = torch.zeros(3).to(self._device), (9 * self.random(*RESOLUTION)).int()
        return ScenePrediction(
            "a",
            self.objects(count),
            center,
            occupancy=self.random(*RESOLUTION),
            seen=seen,
            grid_extent=EXTENT,
        )

    def cameras(self, *lead: int) -> Cameras:
        pose = torch.tensor([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]]).repeat(*lead, 1, 1)
        pose[..., :3, 3] = torch.linspace(0, 0.5, lead[-1])[:, None]
        intrinsics = torch.tensor([[40.0, 0, 24], [0, 40, 16], [0, 0, 1]]).repeat(*lead, 1, 1)
        return Cameras(intrinsics.to(self._device), pose.to(self._device), (32, 48))

    def in_pictures(self, *lead: int) -> Cameras:
        """The same cameras, which took less than their images."""
        picture = torch.tensor([9.0, 0, 31, 32]).repeat(*lead, 1).to(self._device)
        return replace(self.cameras(*lead), picture=picture)

    def views(self) -> Views:
        cameras, images = self.in_pictures(1, 2), self.random(1, 2, 3, 32, 48)
        return Views(images, cameras.intrinsics, cameras.world_from_camera, cameras.picture)

    def grid(self, *lead: int) -> VoxelGrid:
        return VoxelGrid(RESOLUTION, EXTENT, torch.zeros(*lead, 3).to(self._device))

    def pairs(self) -> PairList:
        return trace_pairs(self.cameras(2), self.grid(), (2, 3))

    def volumes(self) -> Volumes:
        center = torch.tensor([[0.0, 0, 0], [4.5, 0, 0]], dtype=torch.float64)
        return Volumes(RESOLUTION, EXTENT, center.to(self._device))

    def attended(self) -> tuple[Tensor, Tensor, PairList]:
        """Features of voxels, of pixels, and their pairs."""
        pairs = self.pairs()
        return self.random(pairs.num_voxels, 2, 4), self.random(pairs.num_pixels, 2, 4), pairs


def attend(function, at: Inputs):
    voxels, pixels, pairs = at.attended()
    return function(voxels, pixels, pixels, pairs)


def splat(function, at: Inputs):
    _, pixels, pairs = at.attended()
    return function(pixels.flatten(1), pairs)


def covered(at: Inputs):
    volumes, seen = cover(at.cameras(5), resolution=RESOLUTION, extent=EXTENT)
    return volumes.center, seen


def merged(at: Inputs):
    room = merge_volumes([at.prediction(), at.prediction(3)], at.volumes())
    return room.objects.center, room.occupancy, room.seen, room.grid_center


def counted(at: Inputs):
    return count_object_views(at.prediction()).num_views


def meshed(at: Inputs):
    whole = replace(at.objects(1), shape=torch.ones_like(at.random(1, 4, 4, 4)))
    return [mesh.bounds for mesh in object_meshes(replace(at.prediction(), objects=whole))]


FUNCTIONS = {
    "corners": lambda at: at.boxes().corners(),
    "box_iou": lambda at: box_iou(at.boxes(), at.boxes(3)),
    "upright_basis": lambda at: upright_basis(device=at.random(1).device),
    "quaternions": lambda at: matrix_from_quaternion(quaternion_from_matrix(at.boxes().rotation)),
    "yaw": lambda at: yaw_from_rotation(at.boxes().rotation),
    "symmetric_yaw_error": lambda at: symmetric_yaw_error(at.random(6), at.random(6), at.objects().symmetry),
    "geodesic_angle": lambda at: geodesic_angle(at.boxes().rotation, at.boxes().rotation.flip(0)),
    "cell_rays": lambda at: at.cameras(2).cell_rays((2, 3), 2),
    "project": lambda at: at.cameras(2).project(at.boxes().corners().flatten(0, 1)),
    "voxel_from_world": lambda at: at.grid().voxel_from_world(at.grid().voxel_centers().flatten(0, 2)),
    "position_code": lambda at: position_code(at.random(6, 3), EXTENT, 14),
    "ray_code": lambda at: ray_code(at.cameras(1, 2), at.grid(1), (2, 3)),
    "owner": lambda at: at.volumes().owner(at.random(6, 3)),
    "joint": lambda at: at.volumes().joint().center,
    "cover": covered,
    "trace_pairs": lambda at: at.pairs().voxel_index,
    "trace_pairs's twin": lambda at: reference.trace_pairs(at.cameras(2), at.grid(), (2, 3)).voxel_index,
    "trace_pairs of pictures": lambda at: trace_pairs(at.in_pictures(2), at.grid(), (2, 3)).voxel_index,
    "cells_in_picture": lambda at: at.in_pictures(2).cells_in_picture((2, 3), 2),
    "sees": lambda at: at.in_pictures(2).sees(*at.cameras(2).project(at.boxes().center)),
    "quarter_turned": lambda at: at.in_pictures(2).quarter_turned().intrinsics,
    "rigid_motions": lambda at: rigid_motions(at.cameras(2).world_from_camera),
    "check_views": lambda at: check_views(at.views()) is None,
    "pair_centers": lambda at: pair_centers(at.cameras(1, 2), at.grid(1), (2, 3)).voxel_index,
    "count_views": lambda at: count_views(at.cameras(2), at.grid(), (2, 3)),
    "blocks": lambda at: PairList.from_blocks(at.pairs().blocks()).by("voxels"),
    "ray_attention": lambda at: attend(ray_attention, at),
    "ray_attention's twin": lambda at: attend(reference.ray_attention, at),
    "splat_features": lambda at: splat(splat_features, at),
    "splat_features's twin": lambda at: splat(reference.splat_features, at),
    "attention_weights": lambda at: attention_weights(*at.attended()),
    "rasterize_mask": lambda at: rasterize_mask([TRIANGLE], at.cameras(2)),
    "alignment_errors": lambda at: alignment_errors(at.objects(), at.objects(3)),
    "match_in_order": lambda at: match_in_order(score_order(at.random(6)), at.random(6, 3) > 0.5),
    "best_f1": lambda at: list(best_f1(at.random(6), at.random(6) > 0.5, 4).values()),
    "average_precision": lambda at: average_precision(at.random(6), at.random(6) > 0.5, 4),
    "chamfer_distance": lambda at: chamfer_distance(at.random(6, 3), at.random(5, 3)),
    "surface_points": lambda at: surface_points(at.random(4, 4, 4) > 0.5, at.random(3).double()),
    "psnr_of_frames": lambda at: psnr_of_frames(at.random(2, 3, 8, 8), at.random(2, 3, 8, 8).flip(0)),
    "nearest_frames": lambda at: nearest_frames(at.cameras(1, 2), at.cameras(1, 3)),
    "select_objects": lambda at: (
        select_objects(at.prediction(9), score_threshold=0.1, duplicate_iou=0.05).objects.score
    ),
    "count_object_views": counted,
    "merge_volumes": merged,
    "object_meshes": meshed,
}

SOME_FOLDERS = ("geometry", "ops", "backbone", "heads", "extensions", "losses")

COPIES = {
    "geometry/box_clip.py": {"_face_edges", "_crossings", "_clamped_flux"},
    "geometry/boxes.py": {"corners"},
    "geometry/rotation.py": {"upright_basis"},
    "geometry/room_tiles.py": {"_offset", "corner_index"},
    "ops/traverse.py": {"_clip"},
}
"""Functions that copy Python's numbers to the device, for which the host waits: not to be added to."""

ON_THE_CPU = {
    "geometry/room_tiles.py": {"cover", "_along_axis"},
    "geometry/rasterize.py": {"rasterize_mask", "rasterize_ids", "near_pixels", "_clip_to_front"},
}
"""Functions that make tensors on the CPU, and return them there."""

MADE = {
    "arange",
    "empty",
    "eye",
    "full",
    "linspace",
    "ones",
    "rand",
    "randint",
    "randn",
    "randperm",
    "tensor",
    "zeros",
}


def flat(value):
    if isinstance(value, list | tuple):
        return [one for item in value for one in flat(item)]
    return [torch.as_tensor(value).cpu()]


@pytest.mark.parametrize("name", FUNCTIONS)
@on_pretend_device
def test_gives_on_the_device_what_it_gives_on_the_cpu(name):
    found, expected = (FUNCTIONS[name](Inputs(device)) for device in (DEVICE, "cpu"))
    torch.testing.assert_close(flat(found), flat(expected))


@on_pretend_device
def test_duplicates_are_waited_for_once_however_many_there_are():
    waits = []
    for count in (6, 24):
        scene = Inputs(DEVICE).prediction(count)
        with recorded() as seen:
            kept = select_objects(scene, score_threshold=0.0, duplicate_iou=0.05)
        assert 1 < len(kept.objects) < count
        waits.append(seen.waits)
    assert waits[0] == waits[1]
    assert (
        sum(count for place, count in waits[0].items() if "copy to the host at raytran/postprocess" in place)
        == 1
    )


@on_pretend_device
def test_views_of_objects_are_counted_without_a_wait():
    scene = Inputs(DEVICE).prediction()
    with recorded() as seen:
        count_object_views(scene)
    assert not seen.waits, seen


@on_pretend_device
def test_rays_outside_of_pictures_are_left_out_without_a_wait():
    waits = []
    for cameras in (Inputs(DEVICE).cameras(2), Inputs(DEVICE).in_pictures(2)):
        with recorded() as seen:
            voxel_rays(cameras, Inputs(DEVICE).grid(), (2, 3), 2)
        waits.append(seen.waits)
    assert waits[0] == waits[1]


@on_pretend_device
def test_the_values_of_views_are_waited_for_once():
    views = Inputs(DEVICE).views()
    center = views.world_from_camera.new_zeros(3)
    for values, expected in ((True, 1), (False, 0)):
        with recorded() as seen:
            check_views(views, grid_center=center, values=values)
        assert seen.waits.total() == expected, seen


def calls_of(root, folders):
    """Yield file, function and call of all calls in functions; not those that make a module's parts."""
    package = root / "src" / "raytran"
    for path in [
        package / "model.py",
        package / "postprocess.py",
        *(f for n in folders for f in (package / n).rglob("*.py")),
    ]:
        for function in ast.walk(ast.parse(path.read_text())):
            if isinstance(function, ast.FunctionDef) and function.name != "__init__":
                for node in ast.walk(function):
                    if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
                        yield path.relative_to(package).as_posix(), function.name, node


def is_torch(call):
    return isinstance(call.func.value, ast.Name) and call.func.value.id == "torch"


def names_device(call):
    return any(keyword.arg == "device" for keyword in call.keywords)


def test_no_more_functions_copy_numbers_to_the_device(project_root):
    for path, function, call in calls_of(project_root, SOME_FOLDERS):
        makes = is_torch(call) and call.func.attr in ("tensor", "as_tensor") and names_device(call)
        if path != "postprocess.py" and (makes or call.func.attr == "new_tensor"):
            assert function in COPIES.get(path, ()), (
                f"{path}:{call.lineno}: a GPU is waited for before numbers are copied to it: make them there "
                "with new_full, or keep them in a buffer"
            )


def test_tensors_are_made_on_a_device_that_is_named(project_root):
    for path, function, call in calls_of(project_root, SOME_FOLDERS):
        if is_torch(call) and call.func.attr in MADE and not names_device(call):
            assert function in ON_THE_CPU.get(path, ()), (
                f"{path}:{call.lineno}: say on which device, with device="
            )
