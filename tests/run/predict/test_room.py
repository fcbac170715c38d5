# SPDX-License-Identifier: Apache-2.0
"""Rooms of any length, seen by networks that know what stands in them."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image
from torch import nn

from raytran.data.scan import even_views
from raytran.data.scannet.scan import read_scan
from raytran.errors import DataError
from raytran.geometry.grid import VoxelGrid
from raytran.geometry.rotation import rotation_from_yaw
from raytran.run.predict import room as module
from raytran.run.predict.predict import predict_room
from raytran.run.predict.room import RoomViews, read_room
from raytran.structs import ObjectSet, ScenePrediction, Views

from ...factories import EXTENT as SMALL_EXTENT
from ...factories import RESOLUTION as SMALL_RESOLUTION
from ...factories import make_model

RESOLUTION, EXTENT = (12, 12, 7), (4.5, 4.5, 3.5)
LIMITS = {"scene_id": "hall", "score_threshold": 0.5, "duplicate_iou": 0.25}


class Knowing(nn.Module):
    """Finds every object whose centre is in its volume, each time a little elsewhere and another score."""

    grid_resolution, grid_extent = RESOLUTION, EXTENT

    def __init__(self, truth: ObjectSet, jitter: float = 0.05) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.zeros(1))
        self.backbone = SimpleNamespace(encoder=SimpleNamespace(input_channels=3))
        self.truth, self.jitter = truth, jitter
        self.generator = torch.Generator().manual_seed(0)
        self.centers: list[torch.Tensor | None] = []
        self.views: list[Views] = []

    def predict(self, views: Views, *, scene_id, score_threshold, views_at_once, with_shapes, grid_center):
        self.centers.append(grid_center)
        self.views.append(views)
        center = views.world_from_camera[0, :, :3, 3].mean(dim=0) if grid_center is None else grid_center
        there = ((self.truth.center - center).abs() <= torch.tensor(EXTENT) / 2).all(dim=1)
        objects = self.truth.select(there)
        noise = torch.rand(len(objects), 3, generator=self.generator) * 2 - 1
        objects = ObjectSet(
            label=objects.label,
            center=objects.center + self.jitter * noise,
            size=objects.size,
            rotation=objects.rotation,
            symmetry=objects.symmetry,
            score=0.6 + 0.4 * torch.rand(len(objects), generator=self.generator),
            shape=torch.ones(len(objects), 3, 3, 3),
        )
        inside = VoxelGrid(RESOLUTION, EXTENT, center).voxel_centers()
        seen = torch.full(RESOLUTION, views.images.shape[1], dtype=torch.int32)
        # What a voxel holds here is where it is.
        return ScenePrediction(
            scene_id, objects, center, occupancy=inside[..., 0], seen=seen, grid_extent=EXTENT
        )


def furniture(length: float, generator: torch.Generator) -> ObjectSet:
    """A row of objects all along a hall, half a metre from one another."""
    count = int(length / 0.5)
    center = torch.rand(count, 3, generator=generator) * torch.tensor([0.1, 2.4, 0.6])
    center += torch.tensor([0.0, 0.3, 0.3])
    center[:, 0] += torch.arange(count) * 0.5 + 0.2
    return ObjectSet(
        label=torch.randint(0, 9, (count,), generator=generator),
        center=center,
        size=torch.tensor([0.4, 0.6, 0.4]).expand(count, 3),
        rotation=rotation_from_yaw(torch.rand(count, generator=generator) * 6.28),
        symmetry=torch.ones(count, dtype=torch.int64),
        score=torch.ones(count),
    )


def write_scan(folder, place, heading_deg) -> None:
    """Write a scan of level cameras; 0° looks along +x. Its images are of noise, the same everywhere."""
    for name in ("color", "pose", "intrinsic"):
        (folder / name).mkdir(parents=True)
    noise = np.random.default_rng(0).integers(0, 256, (32, 48, 3), dtype=np.uint8)
    for n, (position, heading) in enumerate(zip(place, heading_deg, strict=True)):
        Image.fromarray(noise).save(folder / "color" / f"{n}.png")
        angle = math.radians(heading)
        pose = np.eye(4)
        pose[:3, :3] = [
            [math.sin(angle), 0, math.cos(angle)],
            [-math.cos(angle), 0, math.sin(angle)],
            [0, -1, 0],
        ]
        pose[:3, 3] = position
        np.savetxt(folder / "pose" / f"{n}.txt", pose)
    np.savetxt(folder / "intrinsic" / "intrinsic_color.txt", np.diag([40.0, 40, 1, 1]) + np.eye(4, k=2) * 20)


@pytest.fixture
def hall(tmp_path):
    """Sixty cameras along a hall of 10 × 3 m, one that looks ahead after one to each side."""
    folder = tmp_path / "hall"
    place = [(0.5 + 9 * n / 59, 1.5, 1.6) for n in range(60)]
    write_scan(folder, place, [(0.0, 90.0, 270.0)[n % 3] for n in range(60)])
    return folder


def read(folder, **changes):
    settings = {"frames": "coverage", "num_views": 12, "image_size": (32, 48)}
    settings |= {"resolution": RESOLUTION, "extent": EXTENT} | changes
    with read_scan(folder, any_size=True) as scan:
        return read_room(scan, **settings)


@pytest.mark.parametrize("frames", ["coverage", "even"])
def test_every_object_of_a_long_room_comes_once(hall, frames, generator, caplog):
    caplog.set_level("INFO")
    truth = furniture(10.0, generator)
    room = read(hall, frames=frames)
    assert len(room.volumes) == 4
    model = Knowing(truth)
    prediction = predict_room(model, room, **LIMITS)
    # More were found than there are, since volumes overlap.
    assert (
        sum(int(((truth.center - c).abs() <= torch.tensor(EXTENT) / 2).all(1).sum()) for c in model.centers)
        > 30
    )
    objects = prediction.objects
    distance = torch.cdist(truth.center, objects.center)
    nearest = distance.argmin(dim=1)
    assert len(objects) == len(truth) == 20
    assert sorted(nearest.tolist()) == list(range(20))
    assert distance.amin(dim=1).max() < 0.09
    assert torch.equal(objects.label[nearest], truth.label)
    assert objects.score.tolist() == sorted(objects.score.tolist(), reverse=True)
    assert objects.shape.shape == (20, 3, 3, 3)
    assert "hall is larger than the volume of 4.5 x 4.5 x 3.5 m: predicted in 4 that overlap" in caplog.text
    # Each volume from cameras in it or just before it; their union once, in the order of the walk.
    for views, center in zip(model.views, model.centers, strict=True):
        assert 2 <= views.images.shape[1] <= 12
        assert ((views.world_from_camera[0, :, 0, 3] - center[0]).abs() < EXTENT[0] / 2 + 1.5 + 1e-3).all()
    along = room.views.world_from_camera[0, :, 0, 3]
    assert len(along) == len(room.frame_ids) == len(set(room.frame_ids))
    assert torch.equal(along, along.sort().values)
    # Voxels of the whole hall, each where it is.
    joint = room.volumes.joint()
    x = joint.voxel_centers()[..., 0].float()
    assert prediction.occupancy.shape == joint.resolution
    torch.testing.assert_close(prediction.occupancy, x, rtol=0, atol=1e-4)
    torch.testing.assert_close(prediction.grid_center.double(), joint.center, rtol=0, atol=1e-5)
    assert prediction.seen.min() > 0
    assert objects.num_views.min() > 0


@pytest.mark.parametrize("seed", range(5))
def test_no_object_is_lost_or_doubled_wherever_the_borders_are(hall, seed):
    truth = furniture(10.0, torch.Generator().manual_seed(seed))
    prediction = predict_room(Knowing(truth, jitter=0.08), read(hall, frames="even"), **LIMITS)
    distance = torch.cdist(truth.center, prediction.objects.center)
    assert len(prediction.objects) == 20
    assert sorted(distance.argmin(dim=1).tolist()) == list(range(20))


def test_a_room_that_fits_is_predicted_as_ever(hall, caplog):
    caplog.set_level("INFO")
    model = make_model()
    extent = (12.0, 12.0, SMALL_EXTENT[2])
    model.grid_extent = extent
    room = read(hall, frames="even", num_views=5, resolution=SMALL_RESOLUTION, extent=extent)
    with read_scan(hall, any_size=True) as scan:
        views, frame_ids = even_views(scan, image_size=(32, 48), num_views=5)
    assert room.frame_ids == frame_ids
    assert torch.equal(room.views.images, views.images)
    limits = {"scene_id": "hall", "score_threshold": 0.0, "duplicate_iou": None}
    alone = RoomViews.in_one_volume(views, frame_ids, model)
    here, there = predict_room(model, room, **limits), predict_room(model, alone, **limits)
    assert len(here.objects) == 5
    for name in ("center", "size", "score", "shape", "num_views"):
        assert torch.equal(getattr(here.objects, name), getattr(there.objects, name))
    assert torch.equal(here.occupancy, there.occupancy)
    assert torch.equal(here.grid_center, there.grid_center)
    assert torch.equal(here.foreground, there.foreground)
    assert "larger" not in caplog.text


def test_one_volume_that_would_miss_cameras_is_moved(tmp_path):
    # Most frames at one end of 4 m.
    place = [(0.02 * n, 0.0, 1.5) for n in range(30)] + [(0.6 + 0.34 * n, 0.0, 1.5) for n in range(11)]
    write_scan(tmp_path / "a", place, [90.0] * 41)
    room = read(tmp_path / "a", frames="even", num_views=41)
    model = Knowing(ObjectSet.empty())
    predict_room(model, room, **LIMITS)
    assert len(room.volumes) == 1
    assert model.centers[0].tolist() == pytest.approx([1.75, 0.0, 1.5])
    assert torch.equal(model.views[0].images, room.views.images)


def test_a_damaged_image_is_replaced_by_one_of_its_volume(hall):
    expected = read(hall, frames="even")
    damaged = expected.frame_ids[expected.members[0][3]]
    (hall / "color" / f"{damaged}.png").write_bytes(b"no image")
    room = read(hall, frames="even")
    assert damaged not in room.frame_ids
    assert len(room.members[0]) == len(expected.members[0])
    (new,) = set(room.frame_ids) - set(expected.frame_ids)
    assert abs(int(new) - int(damaged)) <= 2


def test_a_camera_that_stands_still_gives_what_it_has(tmp_path, caplog):
    caplog.set_level("INFO")
    write_scan(tmp_path / "a", [(0.001 * n, 0.0, 1.5) for n in range(9)], [0.0] * 9)
    assert read(tmp_path / "a", num_views=3).frame_ids == ("1", "4", "7")
    assert "chose 3 of 9 frames for what they see together; left out 0 near-duplicates" in caplog.text
    assert read(tmp_path / "a", num_views=1).frame_ids == ("0",)


def test_blurred_frames_are_left_out_and_counted(hall, caplog):
    caplog.set_level("INFO")
    for name in ("7", "8"):
        Image.new("RGB", (48, 32), (90, 90, 90)).save(hall / "color" / f"{name}.png")
    room = read(hall, num_views=100, extent=(20.0, 20.0, 3.5))
    assert set(map(str, range(60))) - set(room.frame_ids) == {"7", "8"}
    assert "chose 58 of 60 frames" in caplog.text
    assert "0 near-duplicates and 2 that are blurred or cannot be read" in caplog.text
    assert len(read(hall, num_views=100, frames="even").frame_ids) == 60


def test_of_a_long_video_some_frames_are_looked_at(hall, monkeypatch, caplog):
    caplog.set_level("INFO")
    monkeypatch.setattr(module, "MAX_CANDIDATES", 20)
    room = read(hall, num_views=50, extent=(20.0, 20.0, 3.5))
    assert room.frame_ids == tuple(str(1 + 3 * n) for n in range(20))
    assert "chose 20 of 20 frames" in caplog.text


def test_one_frame_is_too_few_unless_one_is_asked_for(tmp_path):
    write_scan(tmp_path / "a", [(0.0, 0.0, 1.5)], [0.0])
    for frames in ("coverage", "even"):
        with pytest.raises(DataError, match=r"a has 1 frame with an image and a pose, and 2 are needed"):
            read(tmp_path / "a", frames=frames)
        assert read(tmp_path / "a", frames=frames, num_views=1).frame_ids == ("0",)


def test_a_volume_with_blurred_frames_alone_takes_them(hall, caplog):
    caplog.set_level("INFO")
    everything = read(hall, frames="even", num_views=100, extent=(3.0, 3.0, 3.5))
    own = {everything.frame_ids[place] for place in everything.members[0]}
    assert 2 < len(own) < 30
    for name in own:
        Image.new("RGB", (48, 32), (90, 90, 90)).save(hall / "color" / f"{name}.png")
    room = read(hall, extent=(3.0, 3.0, 3.5))
    assert f"{len(own)} that are blurred" in caplog.text
    assert len(room.members[0]) == 12
    assert {room.frame_ids[place] for place in room.members[0]} <= own


def test_positions_in_millimetres_are_refused_by_name(tmp_path):
    write_scan(tmp_path / "garage", [(900.0 * n, 0.0, 1500.0) for n in range(5)], [90.0] * 5)
    with pytest.raises(DataError, match=r"cameras of garage see .* m, .*: give scale="):
        read(tmp_path / "garage")
