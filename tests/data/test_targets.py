# SPDX-License-Identifier: Apache-2.0
"""Shapes, occupancy and amodal masks."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image
from scipy.ndimage import binary_dilation, gaussian_filter
from scipy.spatial.transform import Rotation

from raytran.data import targets
from raytran.data.cache import MaskCache
from raytran.data.scan2cad import read_annotations, scene_objects
from raytran.data.scannet.scan import read_scan
from raytran.data.shapenet.meshes import read_binvox
from raytran.data.shapenet.models import read_mesh
from raytran.data.shapenet.voxelize import voxelize_solid
from raytran.data.targets import foreground_masks, scan_surface, scene_occupancy, shape_grids
from raytran.errors import DataError
from raytran.geometry.camera import Cameras
from raytran.geometry.grid import VoxelGrid
from raytran.geometry.rotation import rotation_from_yaw
from raytran.structs import SHAPE_SIZE, ObjectSet


def box(center, size, yaw=0.0, shape_size=4, model_id="03001627/cube") -> ObjectSet:
    """One solid box."""
    return ObjectSet(
        label=torch.tensor([3]),
        center=torch.tensor([center]),
        size=torch.tensor([size]),
        rotation=rotation_from_yaw(torch.tensor([yaw])),
        symmetry=torch.tensor([1]),
        score=torch.ones(1),
        shape=torch.ones(1, *[shape_size] * 3, dtype=torch.bool),
        model_id=(model_id,),
    )


def stored_files(folder, kind):
    return sorted(path for path in (folder / kind).rglob("*") if path.is_file())


def grid(resolution, extent, center=(0.0, 0.0, 0.0)) -> VoxelGrid:
    return VoxelGrid(resolution=resolution, extent=extent, center=torch.tensor(center))


class TestOccupancy:
    def test_box_along_the_axes(self) -> None:
        # Object y is the world's z: the box spans 1 × 2 × 3 m along the world's x, y, z.
        objects = box((0.5, 0.0, 0.5), (1.0, 3.0, 2.0))
        occupied = scene_occupancy(objects, grid((4, 4, 4), (4.0, 4.0, 4.0)))
        expected = torch.zeros(4, 4, 4, dtype=torch.bool)
        expected[2, 1:3, 1:4] = True
        assert torch.equal(occupied, expected)

    def test_turned_box(self) -> None:
        # A quarter turn swaps the world's x and y.
        objects = box((0.0, 0.5, 0.5), (1.0, 3.0, 2.0), yaw=math.pi / 2)
        occupied = scene_occupancy(objects, grid((4, 4, 4), (4.0, 4.0, 4.0)))
        expected = torch.zeros(4, 4, 4, dtype=torch.bool)
        expected[1:3, 2, 1:4] = True
        assert torch.equal(occupied, expected)

    def test_voxels_smaller_than_cells_leave_no_gap(self) -> None:
        objects = box((0.0, 0.0, 0.0), (2.0, 2.0, 2.0), yaw=0.3, shape_size=2)
        occupied = scene_occupancy(objects, grid((30, 30, 30), (3.0, 3.0, 3.0)))
        inner = VoxelGrid(resolution=(30, 30, 30), extent=(3.0, 3.0, 3.0), center=torch.zeros(3))
        local = inner.voxel_centers() @ objects.rotation[0]
        assert occupied[(local.abs() < 0.95).all(dim=-1)].all()
        assert not occupied[(local.abs() > 1.1).any(dim=-1)].any()

    def test_only_solid_cells_count(self) -> None:
        objects = box((0.0, 0.0, 0.0), (4.0, 4.0, 4.0))
        shape = torch.zeros(1, 4, 4, 4, dtype=torch.bool)
        shape[0, 0, 3, 1] = True
        occupied = scene_occupancy(replace(objects, shape=shape), grid((4, 4, 4), (4.0, 4.0, 4.0)))
        # Cell (x 0, y 3, z 1): world x = object x, y = - object z, z = object y.
        assert occupied.nonzero().tolist() == [[0, 2, 3]]

    def test_outside_the_grid_and_no_objects(self) -> None:
        small = grid((2, 2, 2), (1.0, 1.0, 1.0), center=(10.0, 0.0, 0.0))
        assert not scene_occupancy(box((0.0, 0.0, 0.0), (1.0, 1.0, 1.0)), small).any()
        none = replace(ObjectSet.empty(), shape=torch.zeros(0, 4, 4, 4, dtype=torch.bool))
        assert not scene_occupancy(none, small).any()
        assert scene_occupancy(ObjectSet.empty(), small).shape == (2, 2, 2)

    @pytest.mark.parametrize("seed", range(24))
    def test_the_same_as_all_points_of_all_cells(self, seed) -> None:
        rng = np.random.default_rng(seed)
        noise = gaussian_filter(rng.normal(size=(SHAPE_SIZE,) * 3), rng.uniform(0.5, 8))
        shape = noise > np.quantile(noise, rng.choice([0.0005, 0.2, 0.6, 0.95]))
        turn = Rotation.random(random_state=seed) if seed % 2 else Rotation.from_euler("z", seed)
        objects = replace(
            box(tuple(rng.uniform(-1, 1, 3)), tuple(rng.uniform(0.1, 3.5, 3))),
            rotation=torch.tensor(turn.as_matrix()[None]),
            shape=torch.from_numpy(shape[None]),
        )
        coarse, fine = ((48, 48, 16), (9.0, 9.0, 3.5)), ((60, 50, 40), (3.0, 4.0, 2.0))
        volume = grid(*(fine if seed % 3 == 0 else coarse))
        expected = occupancy_of_all_points(objects, volume)
        assert expected.any()
        assert not expected.all()
        assert torch.equal(scene_occupancy(objects, volume), torch.from_numpy(expected))

    def test_inner_cells_are_passed_over(self) -> None:
        """A solid of 63³ cells is known by its hull and a few points inside."""
        shape = np.ones((SHAPE_SIZE,) * 3, dtype=bool)
        chosen = targets._sufficient_cells(shape, np.full(3, 0.05))
        assert 63**3 - 61**3 < chosen.sum() < 0.12 * chosen.size

    def test_a_flat_object_and_a_single_solid_cell(self) -> None:
        shape = torch.zeros(1, *[SHAPE_SIZE] * 3, dtype=torch.bool)
        shape[0, 31, 31, 31] = True
        objects = replace(box((0.1, 0.1, 0.1), (0.4, 0.0, 0.4)), shape=shape)
        assert scene_occupancy(objects, grid((4, 4, 4), (4.0, 4.0, 4.0))).nonzero().tolist() == [[2, 2, 2]]

    @pytest.mark.parametrize("side", [1e3, 1e9, math.inf, math.nan])
    def test_an_object_in_another_unit_is_named(self, side) -> None:
        objects = box((0.0, 0.0, 0.0), (0.5, side, 0.5))
        objects.shape[0, 1:] = False
        with pytest.raises(DataError, match=r"0\.5 × .* × 0\.5 m is too large .*unit"):
            scene_occupancy(objects, grid((48, 48, 16), (1e-3, 1e-3, 1e-3)))

    def test_a_real_scene_agrees_with_the_voxels_of_shapenet(self, shared_dir, tmp_path) -> None:
        """Occupancy of the scene from our shapes and from ShapeNet's own solid voxels."""
        root = shared_dir / "realdata" / "scene0470_00"
        objects = scene_objects(read_annotations(root / "scan2cad" / "full_annotations.json")["scene0470_00"])
        cache = MaskCache(folder=tmp_path)
        ours = shape_grids(objects.model_id, shapenet_root=root / "shapenet", cache=cache)
        volume = grid((48, 48, 16), (9.0, 9.0, 3.5), center=tuple(objects.center.mean(dim=0).tolist()))
        occupied = scene_occupancy(replace(objects, shape=ours), volume).numpy()
        expected = np.zeros_like(occupied)
        for m, model_id in enumerate(objects.model_id):
            folder = root / "shapenet" / model_id / "models"
            mesh = read_mesh(root / "shapenet", *model_id.split("/"))
            cells, translate, scale = read_binvox(folder / "model_normalized.solid.binvox")
            points = translate + (np.argwhere(cells) + 0.5) / len(cells) * scale
            local = (points - mesh.bounds.mean(axis=0)) / mesh.extents * objects.size[m].numpy()
            world = local @ objects.rotation[m].numpy().T + objects.center[m].numpy()
            index = np.floor((world - volume.lower.numpy()) / volume.voxel_size.numpy()).astype(int)
            expected[tuple(index.T)] = True
        assert (occupied & expected).sum() / (occupied | expected).sum() >= 0.9
        around = np.ones((3, 3, 3))
        assert not (occupied & ~binary_dilation(expected, around)).any()
        assert not (expected & ~binary_dilation(occupied, around)).any()


def occupancy_of_all_points(objects: ObjectSet, volume: VoxelGrid) -> np.ndarray:
    """The obvious twin: every solid cell filled with points at most half a voxel apart."""
    voxel, lower = volume.voxel_size.double().numpy(), volume.lower.double().numpy()
    occupied = np.zeros(volume.resolution, dtype=bool)
    for m, shape in enumerate(objects.shape.numpy()):
        size, rotation, center = (
            t[m].double().numpy() for t in (objects.size, objects.rotation, objects.center)
        )
        cell = size / len(shape)
        parts = np.ceil(cell / voxel.min() * 2).astype(int)
        inner = np.stack(np.meshgrid(*((np.arange(n) + 0.5) / n for n in parts), indexing="ij"), axis=-1)
        points = (np.argwhere(shape)[:, None] + inner.reshape(-1, 3)).reshape(-1, 3) * cell - size / 2
        index = np.floor((points @ rotation.T + center - lower) / voxel).astype(int)
        occupied[tuple(index[((index >= 0) & (index < volume.resolution)).all(axis=1)].T)] = True
    return occupied


class TestShapes:
    def test_cube_is_full_and_kept(self, write_cube, tmp_path) -> None:
        write_cube()
        cache = MaskCache(folder=tmp_path / "cache")
        options = {"shapenet_root": tmp_path / "shapenet", "cache": cache}
        shapes = shape_grids(("03001627/cube", "03001627/cube"), **options)
        assert shapes.shape == (2, SHAPE_SIZE, SHAPE_SIZE, SHAPE_SIZE)
        assert shapes.dtype == torch.bool
        assert shapes.all()
        (path,) = stored_files(tmp_path / "cache", "shape")
        time = path.stat().st_mtime_ns
        assert shape_grids(("03001627/cube",), **options).all()
        assert path.stat().st_mtime_ns == time

    def test_changed_model_is_made_again(self, write_cube, tmp_path) -> None:
        path = write_cube()
        options = {"shapenet_root": tmp_path / "shapenet", "cache": MaskCache(folder=tmp_path / "cache")}
        assert shape_grids(("03001627/cube",), **options).all()
        # One corner pulled out: the cube fills less of the new box.
        path.write_text(path.read_text().replace("v 0.5 0.5 0.5", "v 0.9 0.9 0.9"))
        changed = shape_grids(("03001627/cube",), **options)
        assert not changed.all()
        assert changed.any()

    def test_known_and_new_models_together(self, write_cube, tmp_path, monkeypatch) -> None:
        path = write_cube(model_id="corner")
        path.write_text(path.read_text().replace("v 0.5 0.5 0.5", "v 0.9 0.9 0.9"))
        write_cube()
        options = {"shapenet_root": tmp_path / "shapenet", "cache": MaskCache(folder=tmp_path / "cache")}
        (corner,) = shape_grids(("03001627/corner",), **options)
        made = []
        monkeypatch.setattr(
            targets,
            "voxelize_solid",
            lambda *mesh, **options: made.append(1) or voxelize_solid(*mesh, **options),
        )
        names = ("03001627/cube", "03001627/corner", "03001627/cube")
        shapes = shape_grids(names, **options)
        assert made == [1]
        assert torch.equal(shapes[1], corner)
        assert shapes[[0, 2]].all()
        assert torch.equal(shape_grids(names, **options), shapes)
        assert made == [1]

    def test_a_model_of_the_first_release(self, tmp_path) -> None:
        # A stair whose low step is in front: +X in v1, hence low z in a grid.
        folder = tmp_path / "ShapeNetCore.v1" / "03001627" / "stair"
        folder.mkdir(parents=True)
        high = trimesh.creation.box(bounds=[(-0.5, 0, -0.3), (0, 0.4, 0.3)])
        low = trimesh.creation.box(bounds=[(0, 0, -0.3), (0.5, 0.1, 0.3)])
        (folder / "model.obj").write_text(trimesh.util.concatenate([high, low]).export(file_type="obj"))
        (grid,) = shape_grids(("03001627/stair",), shapenet_root=tmp_path, cache=MaskCache(folder=tmp_path))
        assert not grid[:, 17:, :31].any()
        assert grid[:, :, 32:].all()
        assert grid[:, :15].all()

    def test_missing_model(self, tmp_path) -> None:
        cache = MaskCache(folder=tmp_path / "cache")
        with pytest.raises(DataError, match="03001627"):
            shape_grids(("03001627/cube",), shapenet_root=tmp_path, cache=cache)

    def test_real_models_are_plausible(self, shared_dir, tmp_path) -> None:
        root = shared_dir / "realdata" / "scene0470_00" / "shapenet"
        (table,) = shape_grids(
            ("04379243/142060f848466cad97ef9a13efb5e3f7",),
            shapenet_root=root,
            cache=MaskCache(folder=tmp_path),
        )
        # A round table: its plate is the widest layer, near the top; it touches all six sides of its box.
        layers = table.sum(dim=(0, 2))
        assert layers.argmax() > 50
        for side in (table[0], table[-1], table[:, 0], table[:, -1], table[..., 0], table[..., -1]):
            assert side.any()


class TestForeground:
    def cameras(self, image_size=(32, 48)) -> Cameras:
        """Two cameras, at (0, 0, 1) and (0, 10, 1), that look along the world's +x."""
        intrinsics = torch.tensor([[40.0, 0, 24], [0, 40, 16], [0, 0, 1]]).expand(2, 3, 3)
        pose = torch.eye(4).repeat(2, 1, 1)
        pose[:, :3, :3] = torch.tensor([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
        pose[:, 1, 3] = torch.tensor([0.0, 10.0])
        pose[:, 2, 3] = 1.0
        return Cameras(intrinsics, pose, (32, 48)).scaled_to(image_size)

    def test_cube_ahead(self, write_cube, tmp_path) -> None:
        write_cube()
        masks = foreground_masks(
            box((3.0, 0.0, 1.0), (1.0, 1.0, 1.0)),
            self.cameras(),
            shapenet_root=tmp_path / "shapenet",
            cache=MaskCache(folder=tmp_path / "cache"),
        )
        # The near face, 2.5 m ahead, is 1 m · 40 px / 2.5 m = 16 px wide.
        expected = torch.zeros(2, 32, 48, dtype=torch.bool)
        expected[0, 8:24, 16:32] = True
        assert torch.equal(masks, expected)

    def test_masks_are_kept_by_frame_objects_and_size(self, write_cube, tmp_path) -> None:
        write_cube()
        options = {"shapenet_root": tmp_path / "shapenet", "cache": MaskCache(folder=tmp_path / "cache")}
        objects, cameras = box((3.0, 0.0, 1.0), (1.0, 1.0, 1.0)), self.cameras()

        def count() -> int:
            return len(stored_files(tmp_path / "cache", "foreground"))

        first = foreground_masks(objects, cameras, **options)
        assert count() == 2
        swapped = Cameras(cameras.intrinsics, cameras.world_from_camera.flip(0), cameras.image_size)
        assert torch.equal(foreground_masks(objects, swapped, **options), first.flip(0))
        assert count() == 2
        foreground_masks(box((3.0, 0.5, 1.0), (1.0, 1.0, 1.0)), cameras, **options)
        assert count() == 4
        assert foreground_masks(objects, self.cameras((16, 48)), **options)[0].sum() == 8 * 16
        assert count() == 6

    def test_no_objects(self, tmp_path) -> None:
        cache = MaskCache(folder=tmp_path)
        masks = foreground_masks(ObjectSet.empty(), self.cameras(), shapenet_root=tmp_path, cache=cache)
        assert masks.shape == (2, 32, 48)
        assert not masks.any()

    def test_real_masks(self, shared_dir, tmp_path) -> None:
        root = shared_dir / "realdata" / "scene0470_00"
        scan = read_scan(root / "scannet" / "scans" / "scene0470_00")
        objects = scene_objects(read_annotations(root / "scan2cad" / "full_annotations.json")["scene0470_00"])
        paths = sorted((root / "reference" / "amodal_mask").iterdir())
        index = [scan.frame_id.index(path.stem) for path in paths]
        cameras = scan.cameras[index]
        masks = foreground_masks(
            objects, cameras, shapenet_root=root / "shapenet", cache=MaskCache(folder=tmp_path)
        ).numpy()
        assert len(paths) == 6
        for path, mask in zip(paths, masks, strict=True):
            expected = np.asarray(Image.open(path)) > 0
            iou = (mask & expected).sum() / (mask | expected).sum()
            assert iou >= 0.98, f"{path.name}: {iou:.4f}"


@pytest.mark.parametrize(("height", "corner"), [("inf", 2), ("1e30", 2), ("1", 7), ("1", -1)])
def test_a_scans_mesh_of_points_that_are_nowhere_is_refused(tmp_path, height, corner):
    path = tmp_path / "mesh.ply"
    path.write_text(
        "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
        "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
        f"0 0 0\n1 0 0\n0 {height} 0\n3 0 1 {corner}\n"
    )
    with pytest.raises(DataError, match=r"mesh\.ply"):
        scan_surface(path, "")
