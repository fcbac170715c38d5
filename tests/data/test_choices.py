# SPDX-License-Identifier: Apache-2.0
"""Which objects are targets, and which mask goes in: choices on which the paper is silent."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from raytran.data.augment import Augmentation
from raytran.data.cache import MaskCache
from raytran.data.dataset import scan2cad_dataset
from raytran.data.targets import MAX_SURFACE_OFFSET, foreground_masks, seen_objects, visible_masks
from raytran.errors import ConfigError, DataError
from raytran.geometry.camera import Cameras
from raytran.geometry.rotation import rotation_from_yaw
from raytran.structs import ObjectSet

SMALL = {"image_size": (32, 48), "num_views": 2, "grid_resolution": (8, 8, 4), "grid_extent": (8.0, 8.0, 4.0)}
"""Frames 10 and 100, chosen evenly, look along +x from x = 0.1 and 1 at a height of 1 m."""

PLACES = {
    "ahead": (3.0, 0.0, 1.0),
    "hidden behind it": (4.5, 0.0, 1.0),
    "behind the cameras": (-2.0, 0.0, 1.0),
    "beside the first view": (1.5, 0.9, 1.0),
    "outside of the volume": (7.0, -3.0, 1.0),
}
SIZES = {"hidden behind it": 0.4, "beside the first view": 0.5}


@pytest.fixture
def root(write_scan, write_cube, write_annotations, cube_entry, tmp_path) -> Path:
    """One scan of four frames and five cubes, of which each choice takes others."""
    write_scan()
    write_cube()
    entries = [cube_entry(place, scale=[SIZES.get(name, 1.0)] * 3) for name, place in PLACES.items()]
    write_annotations({"scene0000_00": entries})
    return tmp_path


def chosen(root, choice, **options):
    dataset = scan2cad_dataset(
        root,
        "train",
        cache_dir=root / "cache",
        object_choice=choice,
        **{**SMALL, "view_choice": "even", **options},
    )
    sample = dataset[0]
    names = {place: name for name, place in PLACES.items()}
    objects = [names[tuple(round(x, 3) for x in center)] for center in sample.objects[0].center.tolist()]
    return objects, sample


def test_all_objects_are_targets_unless_others_are_chosen(root):
    assert chosen(root, "all")[0] == list(PLACES)


def test_objects_whose_centre_is_in_the_volume(root):
    """The volume spans 4 m around x = 0.55: only the last centre, at x = 7, lies outside."""
    assert chosen(root, "in_volume")[0] == list(PLACES)[:4]
    # With an extent of 7 m the one at x = 4.5 is out too, with 6.9 m along y none.
    assert chosen(root, "in_volume", grid_extent=(7.0, 6.9, 4.0))[0] == [
        "ahead",
        "behind the cameras",
        "beside the first view",
    ]


def test_the_volume_is_that_of_the_augmented_scene(root):
    objects, sample = chosen(root, "in_volume", augmentation=Augmentation(shift=(6.0, 0.0, 0.0)))
    middle = float(sample.grid_center[0, 0])
    expected = [name for name, place in PLACES.items() if abs(place[0] - middle) <= 4]
    assert objects == expected != chosen(root, "in_volume")[0]


def test_objects_that_a_given_frame_sees(root):
    """The second frame stands at x = 1, where the cube beside is out of its sight but not of the first's."""
    seen = ["ahead", "beside the first view", "outside of the volume"]
    assert chosen(root, "seen")[0] == seen
    # Frame 100 alone, by what is drawn at random: none of the others counts.
    scan = root / "scannet" / "scans" / "scene0000_00"
    for frame in (0, 10, 20):
        (scan / "color" / f"{frame}.jpg").unlink()
    assert chosen(root, "seen", num_views=1, min_views=1)[0] == ["ahead", "outside of the volume"]


@pytest.mark.parametrize("choice", ["in_volume", "seen"])
def test_other_targets_are_of_all_objects(root, choice):
    every, some = chosen(root, "all")[1], chosen(root, choice)[1]
    assert len(some.objects[0]) == len(some.objects[0].shape) < len(every.objects[0])
    assert torch.equal(some.occupancy, every.occupancy)
    assert torch.equal(some.foreground, every.foreground)


def test_frames_to_be_rendered_do_not_count_as_seen(root):
    objects, sample = chosen(root, "seen", num_views=1, num_new_views=3, min_views=1)
    place = float(sample.views.world_from_camera[0, 0, 0, 3])
    expected = ["ahead", "beside the first view", "outside of the volume"]
    assert objects == (expected if place < 0.5 else [expected[0], expected[2]])


def slab_depths(objects, origin, directions):
    """Depth at which rays enter each box, ``(M, n)``; inf for a miss. The slab method, in float64."""
    found = []
    for center, size, rotation in zip(objects.center, objects.size, objects.rotation, strict=True):
        turn = rotation.double().numpy()
        start = (origin - center.double().numpy()) @ turn
        with np.errstate(divide="ignore"):
            low, high = ((side * size.double().numpy() / 2 - start) / (directions @ turn) for side in (-1, 1))
        enter, leave = np.minimum(low, high).max(axis=1), np.maximum(low, high).min(axis=1)
        depth = np.where(enter > 0, enter, leave)  # from inside of a box its far wall is met
        found.append(np.where((enter <= leave) & (leave > 0), depth, np.inf))
    return np.array(found).reshape(len(objects), -1)


def random_boxes(count, seed, size=(0.4, 1.6)) -> ObjectSet:
    g = torch.Generator().manual_seed(seed)
    return ObjectSet(
        label=torch.full((count,), 3),
        center=torch.rand(count, 3, generator=g) * torch.tensor([5.0, 4.0, 2.0])
        + torch.tensor([1.0, -2.0, 0.0]),
        size=size[0] + (size[1] - size[0]) * torch.rand(count, 3, generator=g),
        rotation=rotation_from_yaw(6 * torch.rand(count, generator=g)),
        symmetry=torch.ones(count, dtype=torch.int64),
        score=torch.ones(count),
        model_id=("03001627/cube",) * count,
    )


def cameras_along_x(count=3) -> Cameras:
    pose = torch.eye(4).repeat(count, 1, 1)
    pose[:, :3, :3] = torch.tensor([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    pose[:, :3, 3] = torch.tensor([[-0.5, 0.2, 1.1], [0.3, -1.0, 0.9], [2.0, 0.5, 1.5]])[:count]
    intrinsics = torch.tensor([[40.0, 0, 24], [0, 40, 16], [0, 0, 1]]).expand(count, 3, 3)
    return Cameras(intrinsics, pose, (32, 48))


def rays(camera):
    """Optical centre and the directions through the pixels' centres, of unit depth."""
    v, u = np.meshgrid(np.arange(32) + 0.5, np.arange(48) + 0.5, indexing="ij")
    local = np.stack([(u - 24) / 40, (v - 16) / 40, np.ones_like(u)], axis=-1).reshape(-1, 3)
    pose = camera.double().numpy()
    return pose[:3, 3], local @ pose[:3, :3].T


@pytest.mark.parametrize("seed", range(6))
def test_seen_objects_against_rays_cast_by_hand(seed, write_cube, tmp_path):
    write_cube()
    objects, cameras = random_boxes(7, seed), cameras_along_x()
    sources = {"shapenet_root": tmp_path / "shapenet", "cache": MaskCache(folder=tmp_path / "cache")}
    found = seen_objects(objects, cameras, **sources)
    expected = torch.zeros(3, 7, dtype=torch.bool)
    for view, pose in enumerate(cameras.world_from_camera):
        depths = slab_depths(objects, *rays(pose))
        nearest = depths.argmin(axis=0)[np.isfinite(depths.min(axis=0))]
        expected[view, np.unique(nearest)] = True
    assert torch.equal(found, expected)
    assert torch.equal(seen_objects(objects, cameras, **sources), found), "from the cache"
    assert found.any()


def write_mesh(path, boxes):
    """Write boxes as the mesh of a scan."""
    parts = []
    for center, size, rotation in zip(boxes.center, boxes.size, boxes.rotation, strict=True):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotation.numpy(), center.numpy()
        parts.append(trimesh.creation.box(size.numpy(), pose))
    path.parent.mkdir(parents=True, exist_ok=True)
    trimesh.util.concatenate(parts).export(path)


@pytest.mark.parametrize("seed", range(6))
def test_visible_masks_against_rays_cast_by_hand(seed, write_cube, tmp_path):
    """What the scan has nearer than a model by more than 20 cm hides it; models do not hide each other."""
    write_cube()
    objects, others, cameras = random_boxes(5, seed), random_boxes(4, seed + 50), cameras_along_x()
    mesh = tmp_path / "scan.ply"
    write_mesh(mesh, others)
    sources = {"shapenet_root": tmp_path / "shapenet", "cache": MaskCache(folder=tmp_path / "cache")}
    found = visible_masks(objects, cameras, scan_mesh=mesh, **sources)
    for mask, pose in zip(found, cameras.world_from_camera, strict=True):
        of_object, of_scan = (slab_depths(boxes, *rays(pose)).min(axis=0) for boxes in (objects, others))
        expected = np.isfinite(of_object) & (of_scan >= of_object - MAX_SURFACE_OFFSET)
        assert (mask.numpy().ravel() != expected).sum() <= 2, "but for rays along an edge"
    amodal = foreground_masks(objects, cameras, **sources)
    assert (found & ~amodal).sum() == 0
    assert found.sum() < amodal.sum()


def test_a_visible_mask_goes_in_and_the_amodal_one_stays_the_target(root):
    wall = ObjectSet(
        label=torch.zeros(1, dtype=torch.int64),
        center=torch.tensor([[1.8, 0.0, 1.0]]),
        size=torch.tensor([[0.05, 0.6, 0.6]]),
        rotation=torch.eye(3)[None],
        symmetry=torch.ones(1, dtype=torch.int64),
        score=torch.ones(1),
    )
    write_mesh(root / "scannet" / "scans" / "scene0000_00" / "scene0000_00_vh_clean_2.ply", wall)
    amodal, visible = (chosen(root, "all", input_mask=mask)[1] for mask in ("amodal", "visible"))
    assert torch.equal(amodal.foreground, visible.foreground)
    assert torch.equal(amodal.views.images[:, :, 3], 255 * amodal.foreground.byte())
    mask = visible.views.images[:, :, 3] == 255
    hidden = amodal.foreground & ~mask
    assert hidden.any()
    assert not (mask & ~amodal.foreground).any()
    # The wall's picture in the second view, 0.775 m from the camera: 31 pixels in the middle of 48 × 32.
    assert torch.equal(hidden[0, 1, :, 9:39], amodal.foreground[0, 1, :, 9:39])
    assert not hidden[0, 1, :, :8].any()
    assert not hidden[0, 1, :, 40:].any()


def test_without_a_mesh_it_is_one_sentence(root):
    with pytest.raises(
        DataError, match=r"scene0000_00_vh_clean_2\.ply, which tells .* data\.dataset\.input_mask=amodal"
    ):
        chosen(root, "all", input_mask="visible")
    mesh = root / "scannet" / "scans" / "scene0000_00" / "scene0000_00_vh_clean_2.ply"
    for content in (b"", b"ply\nformat ascii 1.0\n", b"nothing of the kind"):
        mesh.write_bytes(content)
        with pytest.raises(DataError, match=r"vh_clean_2\.ply.*copy"):
            chosen(root, "all", input_mask="visible")


def test_choices_that_do_not_exist(root):
    with pytest.raises(ConfigError, match="unknown object_choice=some: choose one of all, in_volume, seen"):
        chosen(root, "some")
    for mask in (True, False, "modal"):
        with pytest.raises(
            ConfigError, match=f"unknown input_mask={mask}: choose one of amodal, visible, null"
        ):
            chosen(root, "all", input_mask=mask)


def test_masks_that_were_drawn_before_are_found_again(write_cube, tmp_path):
    """The name of an entry is a digest of the same parts as ever: nothing is drawn anew after an update."""
    write_cube()
    exact = {
        "center": torch.tensor([[3.0, 0.0, 1.0]]),
        "size": torch.ones(1, 3),
        "rotation": torch.eye(3)[None],
    }
    objects, sources = replace(random_boxes(1, 0), **exact), {"shapenet_root": tmp_path / "shapenet"}
    foreground_masks(objects, cameras_along_x(1), **sources, cache=MaskCache(folder=tmp_path))
    (entry,) = (tmp_path / "foreground").rglob("*.z")
    assert entry.name == "f9dc5ea567fac33132033cf1ce78ac20ab9c8b3bc76a30b18b739c0180c9f42c.bits.z"
