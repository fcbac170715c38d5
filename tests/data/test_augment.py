# SPDX-License-Identifier: Apache-2.0
"""Augmentation keeps geometry true: models project where they did, masks and occupancy follow the objects."""

from __future__ import annotations

import colorsys
import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from raytran.data.augment import Augmentation, change_colors, color_change, mirror_scene, rotate_scene
from raytran.data.dataset import scan2cad_dataset
from raytran.data.shapenet.models import read_mesh
from raytran.data.shapenet.voxelize import voxelize_solid
from raytran.data.targets import scene_occupancy
from raytran.errors import ConfigError
from raytran.geometry.camera import Cameras
from raytran.geometry.grid import VoxelGrid
from raytran.geometry.rasterize import rasterize_mask
from raytran.geometry.rotation import rotation_from_yaw, yaw_from_rotation
from raytran.structs import SHAPE_SIZE, ObjectSet, SceneBatch, Views

SIZE = (48, 64)
# A corner of the cube [-½, ½]³: no mirror and no turn maps it to itself.
VERTICES = np.array([[-0.5, -0.5, -0.5], [0.5, -0.5, -0.5], [-0.5, 0.5, -0.5], [-0.5, -0.5, 0.5]])
FACES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
MIRROR = np.diag([-1.0, 1.0, 1.0])
ALL_ON = {
    **{"yaw_deg": 180.0, "shift": (0.5, 0.5, 0.2), "mirror": 0.5, "frame_dropout": 0.3, "hue_deg": 10.0},
    **{"brightness": 0.2, "contrast": 0.2, "saturation": 0.2},
}


def placed_cells(objects: ObjectSet) -> list[torch.Tensor]:
    """The centres of the cells of each object's shape grid in the world."""
    steps = (np.arange(SHAPE_SIZE) + 0.5) / SHAPE_SIZE - 0.5
    cells = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
    return [torch.from_numpy(points).float() for points in placed(objects, cells)]


def cameras_of(scene: SceneBatch) -> Cameras:
    return Cameras(scene.views.intrinsics[0], scene.views.world_from_camera[0], scene.views.image_size)


def placed(objects: ObjectSet, vertices: np.ndarray = VERTICES) -> list[np.ndarray]:
    """The vertices of each object in the world."""
    return [
        (vertices * size.double().numpy()) @ rotation.double().numpy().T + center.double().numpy()
        for size, rotation, center in zip(objects.size, objects.rotation, objects.center, strict=True)
    ]


def masks_of(scene: SceneBatch, vertices: np.ndarray = VERTICES) -> torch.Tensor:
    (objects,) = scene.objects
    return rasterize_mask([(part, FACES) for part in placed(objects, vertices)], cameras_of(scene))[None]


def grid_of(scene: SceneBatch) -> VoxelGrid:
    return VoxelGrid(resolution=(32, 32, 16), extent=(8.0, 8.0, 4.0), center=scene.grid_center[0])


def occupancy_of(scene: SceneBatch) -> torch.Tensor:
    return scene_occupancy(scene.objects[0], grid_of(scene))


@pytest.fixture
def scene(generator) -> SceneBatch:
    """Three objects without any symmetry, one of them tilted, before three skewed, rolled cameras."""
    rotation = rotation_from_yaw(torch.tensor([0.4, -1.9, 2.6]))
    tilt = torch.linalg.matrix_exp(torch.tensor([[0.0, -0.1, 0.2], [0.1, 0.0, -0.3], [-0.2, 0.3, 0.0]]))
    rotation[2] = tilt @ rotation[2]
    shape = torch.from_numpy(voxelize_solid(VERTICES, FACES))
    objects = ObjectSet(
        label=torch.tensor([3, 6, 1]),
        center=torch.tensor([[3.1, 0.9, 0.6], [3.9, -1.2, 0.4], [2.6, -0.1, 1.3]]),
        size=torch.tensor([[0.9, 1.4, 0.8], [1.6, 0.9, 0.7], [0.5, 0.8, 0.6]]),
        rotation=rotation,
        symmetry=torch.tensor([1, 2, 4]),
        score=torch.ones(3),
        shape=shape.expand(3, -1, -1, -1),
        model_id=("03001627/a", "04379243/b", "02871439/c"),
    )
    poses = torch.eye(4).repeat(3, 1, 1)
    look = torch.tensor([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    for pose, turn, y in zip(poses, (-0.2, 0.05, 0.25), (-0.5, 0.1, 0.6), strict=True):
        skew = torch.tensor([[0.0, -turn, 0.1], [turn, 0.0, -0.05], [-0.1, 0.05, 0.0]])
        pose[:3, :3], pose[:3, 3] = torch.linalg.matrix_exp(skew) @ look, torch.tensor([-0.3, y, 1.2])
    intrinsics = torch.tensor([[50.0, 0.7, 29.0], [0.0, 52.0, 25.5], [0.0, 0.0, 1.0]]).repeat(1, 3, 1, 1)
    images = torch.randint(0, 256, (1, 3, 3, *SIZE), dtype=torch.uint8, generator=generator)
    start = SceneBatch(
        scene_id=("scene0000_00",),
        views=Views(images, intrinsics, poses[None]),
        frame_id=(("0", "1", "2"),),
        grid_center=torch.tensor([[3.0, 0.1, 1.0]]),
        objects=(objects,),
    )
    return replace(start, foreground=masks_of(start), occupancy=occupancy_of(start)[None])


def assert_proper(scene: SceneBatch) -> None:
    """Poses and rotations are turns, not mirrors."""
    for matrices in (scene.views.world_from_camera[0, :, :3, :3], scene.objects[0].rotation):
        eye = torch.eye(3).expand_as(matrices)
        torch.testing.assert_close(matrices @ matrices.mT, eye, atol=1e-5, rtol=0)
        assert (torch.linalg.det(matrices) > 0).all()


@pytest.mark.parametrize("angle", [0.7, -2.5])
def test_turned_models_project_to_the_same_pixels(scene, angle) -> None:
    turned = rotate_scene(scene, angle)
    assert_proper(turned)
    for before, after in zip(placed(scene.objects[0]), placed(turned.objects[0]), strict=True):
        assert np.abs(before - after).max() > 0.3
        pixels, depth = cameras_of(scene).project(torch.from_numpy(before).float())
        pixels_after, depth_after = cameras_of(turned).project(torch.from_numpy(after).float())
        torch.testing.assert_close(pixels_after, pixels, atol=2e-4, rtol=0)
        torch.testing.assert_close(depth_after, depth)
    assert torch.equal(turned.views.images, scene.views.images)
    assert torch.equal(masks_of(turned), scene.foreground)
    assert turned.occupancy is None


def test_the_yaw_of_objects_grows_counter_clockwise(scene) -> None:
    before, after = (
        yaw_from_rotation(part.objects[0].rotation) for part in (scene, rotate_scene(scene, 0.3))
    )
    torch.testing.assert_close(after - before, torch.full((3,), 0.3))


def test_mirrored_models_project_to_the_mirrored_pixels(scene) -> None:
    mirrored = mirror_scene(scene)
    assert_proper(mirrored)
    # The model of a mirrored object is its CAD model, mirrored.
    for before, after in zip(
        placed(scene.objects[0]), placed(mirrored.objects[0], VERTICES @ MIRROR), strict=True
    ):
        pixels, depth = cameras_of(scene).project(torch.from_numpy(before).float())
        pixels_after, depth_after = cameras_of(mirrored).project(torch.from_numpy(after).float())
        expected = torch.stack([SIZE[1] - pixels[..., 0], pixels[..., 1]], dim=-1)
        torch.testing.assert_close(pixels_after, expected, atol=2e-4, rtol=0)
        torch.testing.assert_close(depth_after, depth)
    assert torch.equal(mirrored.views.images, scene.views.images.flip(-1))
    assert torch.equal(mirrored.foreground, scene.foreground.flip(-1))
    assert torch.equal(masks_of(mirrored, VERTICES @ MIRROR), mirrored.foreground)
    # The model itself, not mirrored, would not fit.
    assert not torch.equal(masks_of(mirrored), mirrored.foreground)
    assert mirrored.objects[0].model_id == ()
    for name in ("label", "size", "symmetry"):
        assert torch.equal(getattr(mirrored.objects[0], name), getattr(scene.objects[0], name))


def test_pictures_are_mirrored_with_their_images(scene) -> None:
    assert mirror_scene(scene).views.picture is None
    picture = torch.tensor([[[10.0, 0.0, 30.0, 48.0], [0, 0, 64, 48], [0, 5, 64, 40]]])
    mirrored = mirror_scene(replace(scene, views=replace(scene.views, picture=picture)))
    expected = [
        [SIZE[1] - 30, 0, SIZE[1] - 10, 48],
        [SIZE[1] - 64, 0, SIZE[1], 48],
        [SIZE[1] - 64, 5, SIZE[1], 40],
    ]
    assert mirrored.views.picture[0].tolist() == expected


def test_mirrored_shapes_are_those_of_the_mirrored_mesh(scene) -> None:
    mirrored = torch.from_numpy(voxelize_solid(VERTICES @ MIRROR, FACES[:, ::-1]))
    shape = mirror_scene(scene).objects[0].shape[0]
    # Cells cut by the slanted face may fall to either side.
    assert (shape & mirrored).sum() / (shape | mirrored).sum() > 0.95
    assert (shape & scene.objects[0].shape[0]).sum() / (shape | mirrored).sum() < 0.7


def test_mirroring_twice_changes_nothing_but_names(scene) -> None:
    twice = mirror_scene(mirror_scene(scene))
    assert torch.equal(twice.views.images, scene.views.images)
    torch.testing.assert_close(twice.views.intrinsics, scene.views.intrinsics)
    assert torch.equal(twice.views.world_from_camera, scene.views.world_from_camera)
    assert torch.equal(twice.objects[0].rotation, scene.objects[0].rotation)
    assert torch.equal(twice.objects[0].shape, scene.objects[0].shape)
    assert torch.equal(twice.grid_center, scene.grid_center)


def test_occupancy_of_a_mirrored_and_of_a_quarter_turned_scene(scene) -> None:
    occupancy = scene.occupancy[0]
    for changed, expected in (
        (mirror_scene(scene), occupancy.flip(0)),
        (rotate_scene(scene, math.pi / 2), occupancy.rot90(1, (0, 1))),
    ):
        found = occupancy_of(changed)
        assert (found & expected).sum() / (found | expected).sum() > 0.99
        assert (found & occupancy).sum() / (found | occupancy).sum() < 0.5


def test_occupancy_follows_the_objects(scene) -> None:
    turned = Augmentation(yaw_deg=180, shift=(0.4, 0.4, 0.2), mirror=1.0)(scene, torch.Generator())
    assert turned.occupancy is None
    grid = grid_of(turned)
    parts = (torch.arange(6) + 0.5) / 6 - 0.5
    inner = torch.cartesian_prod(parts, parts, parts) * grid.voxel_size
    points = grid.voxel_centers()[..., None, :] + inner
    filled = torch.zeros(*grid.resolution, len(inner), dtype=torch.bool)
    objects = turned.objects[0]
    for m in range(len(objects)):
        cell = ((points - objects.center[m]) @ objects.rotation[m] / objects.size[m] + 0.5) * SHAPE_SIZE
        inside = ((cell >= 0) & (cell < SHAPE_SIZE)).all(dim=-1)
        x, y, z = cell.long().clamp(0, SHAPE_SIZE - 1).unbind(-1)
        filled |= objects.shape[m][x, y, z] & inside
    found = occupancy_of(turned)
    assert found[filled.float().mean(dim=-1) > 0.1].all()
    centres = torch.zeros_like(found)
    # What is found holds the centre of a solid cell; cells are far smaller than voxels.
    for shape, vectors in zip(objects.shape, placed_cells(objects), strict=True):
        index = grid.voxel_from_world(vectors[shape.flatten()]).floor().long()
        centres[tuple(index.T)] = True
    assert torch.equal(found, centres)


def test_a_shift_moves_the_volume_alone(scene, generator) -> None:
    shifted = Augmentation(shift=(0.5, 0.3, 0.0))(scene, generator)
    offset = (shifted.grid_center - scene.grid_center)[0]
    assert 0 < abs(offset[0]) <= 0.5
    assert 0 < abs(offset[1]) <= 0.3
    assert offset[2] == 0
    assert shifted.occupancy is None
    assert torch.equal(shifted.objects[0].center, scene.objects[0].center)
    assert torch.equal(shifted.views.world_from_camera, scene.views.world_from_camera)


@pytest.mark.parametrize("settings", [{"yaw_deg": 30.0}, {"shift": (1.0, 1.0, 1.0)}, {"hue_deg": 20.0}])
def test_draws_fill_their_range_and_do_not_depend_on_other_settings(scene, settings) -> None:
    def changed(seed: int, **options) -> SceneBatch:
        return Augmentation(**options)(scene, torch.Generator().manual_seed(seed))

    def measure(result: SceneBatch) -> float:
        if "yaw_deg" in settings:
            yaw = yaw_from_rotation(result.objects[0].rotation) - yaw_from_rotation(scene.objects[0].rotation)
            return float(torch.rad2deg(torch.remainder(yaw[0] + math.pi, 2 * math.pi) - math.pi)) / 30
        if "shift" in settings:
            return float(result.grid_center[0, 2] - scene.grid_center[0, 2])
        return float((result.views.images.float() - scene.views.images.float()).mean())

    draws = [measure(changed(seed, **settings)) for seed in range(40)]
    assert min(draws) < 0 < max(draws)
    if "hue_deg" not in settings:
        assert min(draws) < -0.7
        assert max(draws) > 0.7
        assert max(map(abs, draws)) <= 1 + 1e-5
    others = [measure(changed(seed, **settings, brightness=0.0, frame_dropout=0.5)) for seed in range(5)]
    assert others == draws[:5]


def test_all_off_changes_nothing(scene, generator) -> None:
    assert Augmentation()(scene, generator) is scene
    assert Augmentation().drop_frames([1, 5, 9], 2, generator) == [1, 5, 9]


def test_half_of_the_scenes_are_mirrored(scene) -> None:
    results = [Augmentation(mirror=0.5)(scene, torch.Generator().manual_seed(i)) for i in range(200)]
    # Standard deviation 7.
    assert 70 < sum(result is not scene for result in results) < 130


def test_colors_by_hand() -> None:
    image = torch.tensor([[10, 100], [60, 100], [200, 100]], dtype=torch.uint8).reshape(1, 3, 1, 2)

    def after(**change) -> list[list[int]]:
        return change_colors(image, *color_change(**change))[0, :, 0].T.tolist()

    assert after() == [[10, 60, 200], [100, 100, 100]]
    assert after(brightness=1.5) == [[15, 90, 255], [150, 150, 150]]
    assert after(contrast=0.5) == [[69, 94, 164], [114, 114, 114]]
    # Grey value 0.299 · 10 + 0.587 · 60 + 0.114 · 200 = 61.01.
    assert after(saturation=0.0) == [[61, 61, 61], [100, 100, 100]]
    assert after(saturation=0.5) == [[36, 61, 131], [100, 100, 100]]
    # A third of a turn moves red to green to blue.
    assert after(hue=2 * math.pi / 3) == [[200, 10, 60], [100, 100, 100]]


def test_a_small_turn_of_the_hue_is_that_of_hsv() -> None:
    image = torch.tensor([[180], [90], [90]], dtype=torch.uint8).reshape(1, 3, 1, 1)
    changed = change_colors(image, *color_change(hue=math.radians(30)))
    hue, *_ = colorsys.rgb_to_hsv(*(changed.flatten() / 255).tolist())
    assert math.isclose(360 * hue, 30, abs_tol=2)


def test_a_mask_channel_keeps_its_values(scene) -> None:
    mask = scene.foreground[:, :, None].byte() * 255
    images = torch.cat([scene.views.images, mask], dim=2)
    changed = change_colors(images, *color_change(brightness=0.5))
    assert torch.equal(changed[:, :, 3:], mask)
    assert torch.equal(changed[:, :, :3], change_colors(images[:, :, :3], *color_change(brightness=0.5)))
    flipped = mirror_scene(replace(scene, views=replace(scene.views, images=images)))
    assert torch.equal(flipped.views.images[:, :, 3] > 0, flipped.foreground)


def test_dropped_frames_are_replaced_by_others(generator) -> None:
    chosen = [3, 8, 9, 20, 21, 40]
    different = []
    for _ in range(200):
        frames = Augmentation(frame_dropout=0.5).drop_frames(chosen, 2, generator)
        assert len(frames) == 6
        assert frames == sorted(frames)
        assert set(frames) <= set(chosen)
        counts = [frames.count(frame) for frame in set(frames)]
        assert max(counts) - min(counts) <= 1
        different.append(len(set(frames)))
    assert set(different) == {2, 3, 4, 5, 6}
    assert 2.8 < sum(different) / 200 < 3.5
    assert len(set(Augmentation(frame_dropout=1.0).drop_frames(chosen, 4, generator))) == 4


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"mirror": 1.5}, r"augmentation\.mirror=1\.5: choose from 0 to 1"),
        ({"yaw_deg": -3}, r"augmentation\.yaw_deg=-3: choose from 0 to 180"),
        ({"shift": (0.5, 0.5)}, r"augmentation\.shift=.*three lengths"),
        ({"shift": 0.5}, r"augmentation\.shift=0\.5: give three lengths"),
        ({"shift": (0.5, -0.5, 0.0)}, r"augmentation\.shift=.*three lengths"),
        ({"frame_dropout": float("nan")}, r"augmentation\.frame_dropout=nan"),
    ],
)
def test_values_out_of_range(settings, message) -> None:
    with pytest.raises(ConfigError, match=message):
        Augmentation(**settings)


def test_real_models_project_onto_the_masks_of_augmented_real_frames(shared_dir, tmp_path) -> None:
    root = shared_dir / "realdata" / "scene0470_00"
    options = {"cache_dir": tmp_path, "image_size": (120, 160), "num_views": 4}
    plain = scan2cad_dataset(root, "train", **options)
    model_ids = plain[0].objects[0].model_id
    meshes = []
    for model_id in model_ids:
        mesh = read_mesh(root / "shapenet", *model_id.split("/"))
        used = np.asarray(mesh.vertices)[np.unique(mesh.faces)]
        low, high = used.min(axis=0), used.max(axis=0)
        meshes.append(((np.asarray(mesh.vertices) - (low + high) / 2) / (high - low), np.asarray(mesh.faces)))
    for mirror in (0.0, 1.0):
        change = Augmentation(yaw_deg=180, shift=(0.5, 0.5, 0.2), mirror=mirror)
        sample = scan2cad_dataset(root, "train", augmentation=change, **options)[0]
        (objects,) = sample.objects
        assert objects.model_id == (() if mirror else model_ids)
        turn = MIRROR if mirror else np.eye(3)
        world = [
            (placed(objects.select(torch.tensor([m])), vertices @ turn)[0], faces)
            for m, (vertices, faces) in enumerate(meshes)
        ]
        found = rasterize_mask(world, cameras_of(sample))[None]
        assert sample.foreground.sum() > 1000
        assert (found & sample.foreground).sum() / (found | sample.foreground).sum() > 0.9995
        assert not torch.equal(sample.occupancy, plain[0].occupancy)
