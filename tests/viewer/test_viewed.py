# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json

import pytest
import torch

from raytran.backbone.observed import observe_attention
from raytran.errors import DataError
from raytran.geometry.grid import VoxelGrid
from raytran.ops.pairs import PairList
from raytran.structs import Views
from raytran.viewer.viewed import read_truth, viewed_volumes

from ..factories import make_model, make_views


@pytest.fixture(scope="module")
def model():
    return make_model()


def predict(model, views, **settings):
    with observe_attention(model) as observed:
        prediction = model.predict(views, with_shapes=False, **settings)
    return prediction, observed


def sums(reads):
    """Return the sum of each voxel's weights, of those that read something."""
    counts = reads.pairs.pixels_per_voxel()
    return torch.segment_reduce(reads.weight, "sum", lengths=counts[counts > 0])


def test_what_voxels_read_is_told_the_same_in_chunks(model):
    views = make_views(1, 3)
    whole, chunked = (
        viewed_volumes(
            model, views, *predict(model, views, views_at_once=at_once), grid_extent=model.grid_extent
        )[0]
        for at_once in (None, 2)
    )
    assert whole.grid.resolution == tuple(whole.occupancy.shape) == model.grid_resolution
    assert isinstance(whole.reads.pairs, PairList)
    assert torch.equal(whole.reads.pairs.pixel_index, chunked.reads.pairs.pixel_index)
    torch.testing.assert_close(sums(whole.reads), torch.ones_like(sums(whole.reads)))
    torch.testing.assert_close(whole.reads.weight, chunked.reads.weight, rtol=1e-3, atol=1e-5)
    seen = whole.reads.pairs.pixels_per_voxel().view(model.grid_resolution) > 0
    assert torch.equal(whole.seen > 0, seen)


def test_volumes_of_a_large_room_each_say_what_they_read(model):
    views = make_views(1, 4)
    centers = [torch.tensor([0.0, 0.0, 0.5]), torch.tensor([0.4, 0.0, 0.5])]
    parts = [(centers[0], [0, 1, 2]), (centers[1], [3, 2])]
    with observe_attention(model) as observed:
        for center, frames in parts:
            some = Views(
                views.images[:, frames], views.intrinsics[:, frames], views.world_from_camera[:, frames]
            )
            prediction = model.predict(some, with_shapes=False, grid_center=center)
    whole, *tiles = viewed_volumes(
        model, views, prediction, observed, grid_extent=model.grid_extent, parts=parts
    )
    assert whole.reads is None
    assert [list(tile.frames) for tile in tiles] == [[0, 1, 2], [3, 2]]
    assert [tile.grid.center.tolist() for tile in tiles] == [center.tolist() for center in centers]
    for tile in tiles:
        torch.testing.assert_close(sums(tile.reads), torch.ones_like(sums(tile.reads)))


def test_a_network_without_rays_has_voxels_all_the_same(model):
    views = make_views(1, 2)
    prediction, _ = predict(model, views)
    (volume,) = viewed_volumes(model, views, prediction, None, grid_extent=model.grid_extent)
    assert isinstance(volume.grid, VoxelGrid)
    assert volume.reads is None


def test_truth_in_two_forms(tmp_path):
    annotations = tmp_path / "full_annotations.json"
    upright = {"translation": [3, 0, 1], "rotation": [0.5**0.5, 0.5**0.5, 0, 0], "scale": [1, 2, 3]}
    model = {"catid_cad": "03001627", "id_cad": "a", "trs": upright, "bbox": [0.5] * 3, "center": [0.0] * 3}
    still = {"translation": [0, 0, 0], "rotation": [1, 0, 0, 0], "scale": [1, 1, 1]}
    entry = {"id_scan": "room", "trs": still, "aligned_models": [model | {"sym": "__SYM_NONE"}]}
    annotations.write_text(json.dumps([entry]))
    torch.testing.assert_close(read_truth(annotations, "room").center, torch.tensor([[3.0, 0.0, 1.0]]))
    with pytest.raises(DataError, match="has no scene hall: give the annotations of this scene as truth="):
        read_truth(annotations, "hall")
    entry = {"category": "chair", "score": 1.0, "center": [1, 2, 3], "size": [1, 1, 1], "mesh": None}
    entry["rotation"] = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]
    scene = tmp_path / "scene.json"
    scene.write_text(json.dumps({"format": "raytran.scene/1", "scene_id": "any", "objects": [entry]}))
    assert read_truth(scene, "room").center.tolist() == [[1, 2, 3]]


@pytest.mark.parametrize("content", [None, "no json", "[{}]", '{"format": "raytran.scene/1"}', '{"a": 1}'])
def test_no_truth_there(tmp_path, content):
    path = tmp_path / "truth.json"
    if content is not None:
        path.write_text(content)
    with pytest.raises(DataError, match=r"truth\.json"):
        read_truth(path, "room")
