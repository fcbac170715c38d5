# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import pytest
import torch

from raytran.data.few_scenes import FewScenes, few_scenes

SMALL = {"image_size": (32, 48), "num_views": 2, "grid_resolution": (8, 8, 4), "grid_extent": (8.0, 8.0, 4.0)}


def test_the_first_scenes_and_no_more():
    few = FewScenes(["a", "b", "c"], 2)
    assert (len(few), few[0], few[1]) == (2, "a", "b")
    with pytest.raises(IndexError):
        few[2]
    assert len(FewScenes(["a"], 5)) == 1


def test_the_same_frames_in_every_epoch_and_in_validation(cube_dataset):
    asked = {"root": cube_dataset, "cache_dir": cube_dataset / "cache", "num_scenes": 1, **SMALL}
    training = few_scenes(split="train", view_choice="random", **asked)
    first = training[0]
    validation = few_scenes(split="val", view_choice="even", **asked)
    for other in (training[7, 0], validation[0]):
        assert other.frame_id == first.frame_id == (("10", "100"),)
        assert torch.equal(other.views.images, first.views.images)


def test_objects_are_counted_without_reading_the_scene(cube_dataset):
    from raytran.data.dataset import scan2cad_dataset

    dataset = scan2cad_dataset(cube_dataset, "train", cache_dir=cube_dataset / "cache", **SMALL)
    assert [dataset.num_objects(index) for index in range(len(dataset))] == [len(dataset[0].objects[0])]
