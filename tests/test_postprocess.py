# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from raytran import postprocess
from raytran.geometry.boxes import OrientedBoxes, box_iou
from raytran.geometry.room_tiles import Volumes
from raytran.geometry.rotation import rotation_from_yaw
from raytran.postprocess import count_object_views, merge_volumes, object_meshes, select_objects
from raytran.structs import ObjectSet, ScenePrediction

SIZE = 16
TWO = Volumes(
    (8, 8, 4), (8.0, 8.0, 4.0), torch.tensor([[0.0, 0.0, 0.0], [6.0, 0.0, 0.0]], dtype=torch.float64)
)
"""Volumes that share 2 ≤ x ≤ 4; the border is at x = 3."""


def prediction(label, center, score, *, size=(1.0, 1.0, 1.0), yaw=0.0, shape=None) -> ScenePrediction:
    count = len(label)
    objects = ObjectSet(
        label=torch.tensor(label),
        center=torch.tensor(center, dtype=torch.float32).reshape(count, 3),
        size=torch.tensor(size).expand(count, 3),
        rotation=rotation_from_yaw(torch.full((count,), yaw)),
        symmetry=torch.ones(count, dtype=torch.int64),
        score=torch.tensor(score),
        shape=shape,
    )
    return ScenePrediction("scene", objects, torch.zeros(3), grid_extent=(4.0, 4.0, 4.0))


def test_threshold_is_inclusive_and_scores_are_sorted():
    scene = prediction([0, 1, 2, 3], [[i, 0, 0] for i in range(4)], [0.5, 0.4, 0.9, 0.7])
    assert select_objects(scene).objects.label.tolist() == [2, 3, 0]
    assert select_objects(scene, score_threshold=0.0).objects.label.tolist() == [2, 3, 0, 1]
    assert len(select_objects(scene, score_threshold=0.95).objects) == 0


def test_duplicates_give_way_to_the_kept_object_of_higher_score():
    # 0 - 0.3 - 0.6 in x: each overlaps its neighbour by IoU 0.54, the ends overlap by 0.25.
    scene = prediction([5, 5, 5, 6], [[0.6, 0, 0], [0.3, 0, 0], [0, 0, 0], [0, 0, 0]], [0.7, 0.8, 0.9, 0.6])
    kept = select_objects(scene, score_threshold=0.0, duplicate_iou=0.5).objects
    torch.testing.assert_close(
        kept.score, torch.tensor([0.9, 0.7, 0.6])
    )  # the middle one does not count any more
    assert len(select_objects(scene, score_threshold=0.0).objects) == 4
    assert len(select_objects(replace(scene, objects=ObjectSet.empty()), duplicate_iou=0.5).objects) == 0


def test_full_grid_gives_the_box_in_the_world():
    yaw, size, center = 0.5, (2.0, 1.0, 0.6), [1.0, -2.0, 0.5]
    scene = prediction([0], center, [1.0], size=size, yaw=yaw, shape=torch.ones(1, SIZE, SIZE, SIZE))
    (mesh,) = object_meshes(scene)
    in_object = (mesh.vertices - np.array(center)) @ scene.objects.rotation[0].double().numpy()
    np.testing.assert_allclose(in_object.max(axis=0), np.array(size) / 2, atol=1e-6)
    np.testing.assert_allclose(in_object.min(axis=0), -np.array(size) / 2, atol=1e-6)
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(np.prod(size), rel=0.02)  # positive: faces point outwards
    # Upright: the object's y is the world's z, and its x points to the yaw.
    np.testing.assert_allclose(mesh.bounds[:, 2], [0.0, 1.0], atol=1e-6)


def test_cells_lie_where_the_shape_grid_says():
    shape = torch.zeros(1, SIZE, SIZE, SIZE)
    shape[0, 12, 3:5, 7] = 1.0  # cell i spans [i/S - ½, (i+1)/S - ½]
    (mesh,) = object_meshes(prediction([0], [0.0, 0, 0], [1.0], size=(1.6, 3.2, 0.8), shape=shape))
    x, y, z = mesh.vertices[:, 0], mesh.vertices[:, 2], -mesh.vertices[:, 1]
    expected = {"x": (0.4, 0.5), "y": (-1.0, -0.6), "z": (-0.05, 0.0)}
    for values, (low, high) in zip((x, y, z), expected.values(), strict=True):
        assert values.min() == pytest.approx(low, abs=1e-6)
        assert values.max() == pytest.approx(high, abs=1e-6)


def test_empty_or_missing_shapes_give_no_mesh():
    shape = torch.zeros(3, SIZE, SIZE, SIZE)
    shape[1, 4:8, 4:8, 4:8] = 0.9
    shape[2] = 0.5
    meshes = object_meshes(prediction([0, 0, 0], torch.zeros(3, 3).tolist(), [1.0] * 3, shape=shape))
    assert [mesh is None for mesh in meshes] == [True, False, True]
    assert object_meshes(prediction([0, 0], torch.zeros(2, 3).tolist(), [1.0] * 2)) == [None, None]


def test_bool_shapes_of_the_truth_are_accepted():
    shape = torch.zeros(1, SIZE, SIZE, SIZE, dtype=torch.bool)
    shape[0, 2:6] = True
    (mesh,) = object_meshes(prediction([0], [0.0, 0, 0], [1.0], shape=shape))
    assert mesh.volume == pytest.approx(0.25, rel=0.03)


def test_views_of_an_object_are_the_mean_over_its_box():
    seen = torch.zeros(4, 4, 4, dtype=torch.int32)
    seen[2:] = 10
    scene = prediction(
        [0, 0, 0, 0],
        [[1.0, 0, 0], [0, 0, 0], [-1.0, 0, 0], [2.0, 0, 0]],
        [1.0] * 4,
        size=(1.0, 1.0, 1.0),
    )
    objects = count_object_views(replace(scene, seen=seen))
    # Wholly where ten looked, half, not, and half out of the volume.
    assert objects.num_views.tolist() == [10, 5, 0, 5]
    assert count_object_views(scene).num_views is None
    none = replace(scene, objects=ObjectSet.empty(), seen=seen)
    assert len(count_object_views(none).num_views) == 0
    # Turned by 90°, a long box lies along y.
    long = prediction([0], [0.0, 0, 0], [1.0], size=(4.0, 0.1, 0.1), yaw=np.pi / 2)
    seen = torch.arange(4, dtype=torch.int32)[None, :, None].expand(4, 4, 4)
    objects = count_object_views(replace(long, seen=seen))
    assert objects.num_views.tolist() == [1.5]


def merged(first, second, **changes) -> ScenePrediction:
    """Merge two predictions, each a list of (label, x, score)."""
    parts = [
        prediction([o[0] for o in part], [[o[1], 0.0, 0.0] for o in part], [o[2] for o in part], **changes)
        for part in (first, second)
    ]
    return merge_volumes(parts, TWO)


def found(scene: ScenePrediction) -> list[tuple[int, float, float]]:
    objects = scene.objects
    return [
        (int(label), round(float(center[0]), 3), round(float(score), 3))
        for label, center, score in zip(objects.label, objects.center, objects.score, strict=True)
    ]


@pytest.mark.parametrize(
    ("first", "second", "expected"),
    [
        # Each alone in its own volume.
        ([(0, 0.0, 0.9)], [(0, 6.0, 0.8)], [(0, 0.0, 0.9), (0, 6.0, 0.8)]),
        # Seen by both: the volume counts in which it lies nearer to the middle, not the higher score.
        ([(0, 2.5, 0.6)], [(0, 2.45, 0.9)], [(0, 2.5, 0.6)]),
        ([(0, 3.6, 0.9)], [(0, 3.5, 0.7)], [(0, 3.5, 0.7)]),
        # On the border each sees it on its own side: once, the surer.
        ([(0, 2.95, 0.6)], [(0, 3.05, 0.9)], [(0, 3.05, 0.9)]),
        # On the border each sees it on the other's side: not lost.
        ([(0, 3.05, 0.9)], [(0, 2.95, 0.6)], [(0, 3.05, 0.9)]),
        # Only the farther volume found it, well across the border: it is not believed.
        ([(0, 3.8, 0.9)], [], []),
        # Of two classes in one place the owner's counts.
        ([(5, 3.1, 0.9)], [(6, 3.15, 0.6)], [(6, 3.15, 0.6)]),
        # One place is a box IoU above a half: 0.54 at 0.3 m, but 0.43 at 0.4 m, where they are two things.
        ([(5, 3.1, 0.9)], [(6, 3.4, 0.6)], [(6, 3.4, 0.6)]),
        ([(5, 3.1, 0.9)], [(6, 3.5, 0.6)], [(5, 3.1, 0.9), (6, 3.5, 0.6)]),
        # Two things side by side at the border are two.
        ([(0, 2.4, 0.9)], [(0, 3.5, 0.8)], [(0, 2.4, 0.9), (0, 3.5, 0.8)]),
        ([], [], []),
    ],
)
def test_each_object_of_two_volumes_comes_once(first, second, expected):
    assert found(merged(first, second)) == expected


def test_shapes_and_views_come_along():
    shape = torch.rand(2, 4, 4, 4)
    parts = [
        prediction([0], [[0.0, 0, 0]], [0.5], shape=shape[:1]),
        prediction([1], [[6.0, 0, 0]], [0.9], shape=shape[1:]),
    ]
    parts = [
        replace(part, objects=replace(part.objects, num_views=torch.tensor([float(n)])))
        for n, part in enumerate(parts)
    ]
    objects = merge_volumes(parts, TWO).objects
    assert torch.equal(objects.shape, shape.flip(0))
    assert objects.num_views.tolist() == [1.0, 0.0]


def test_voxels_come_from_the_volume_whose_middle_is_nearest():
    first, second = torch.rand(8, 8, 4), torch.rand(8, 8, 4)
    scene = prediction([], [], [])
    parts = [replace(scene, occupancy=first), replace(scene, occupancy=second)]
    whole = merge_volumes(parts, TWO)
    joint = TWO.joint()
    assert whole.occupancy.shape == joint.resolution == (14, 8, 4)
    assert whole.grid_center.tolist() == [3.0, 0.0, 0.0]
    assert torch.equal(whole.occupancy[:7], first[:7])
    assert torch.equal(whole.occupancy[7:], second[1:])
    assert whole.seen is None
    # A corner that no volume holds stays empty.
    angle = Volumes((8, 8, 4), (8.0, 8.0, 4.0), torch.tensor([[0.0, 0, 0], [6.0, 0, 0], [6.0, 6.0, 0]]))
    ones = [replace(scene, seen=torch.ones(8, 8, 4, dtype=torch.int32))] * 3
    seen = merge_volumes(ones, angle).seen
    assert seen.dtype == torch.int32
    assert seen.shape == (14, 14, 4)
    assert seen[:6, 8:].sum() == 0
    assert seen.sum() == (14 * 14 - 6 * 6) * 4


def test_memory_grows_with_objects_not_with_their_square(monkeypatch):
    largest = []

    def iou(first, second):
        largest.append(len(first.center) * len(second.center))
        return box_iou(first, second)

    monkeypatch.setattr(postprocess, "box_iou", iou)
    count = 1500
    center = torch.rand(count, 3, generator=torch.Generator().manual_seed(0)) * 12
    scene = prediction([5] * count, center.tolist(), torch.linspace(1, 0.5, count).tolist())
    kept = select_objects(scene, duplicate_iou=0.1).objects
    assert max(largest) <= 256 * count
    # The objects that are kept, one after another, by the table of all pairs.
    boxes = OrientedBoxes(scene.objects.center, scene.objects.size, scene.objects.rotation)
    table, expected = box_iou(boxes, boxes)[0] > 0.1, []
    for index in range(count):
        if not table[index, expected].any():
            expected.append(index)
    assert torch.equal(kept.center, scene.objects.center[expected])
    assert len(expected) < count - 100
