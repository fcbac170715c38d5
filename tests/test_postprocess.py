# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from raytran.geometry.rotation import rotation_from_yaw
from raytran.postprocess import object_meshes, select_objects
from raytran.types import ObjectSet, ScenePrediction

SIZE = 16


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
    return ScenePrediction("scene", objects, torch.zeros(3))


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
