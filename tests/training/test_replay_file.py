# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import nn

from raytran.errors import CheckpointError
from raytran.structs import ObjectSet
from raytran.training.replay_file import read_replay, write_replay

CARD = {"format": "raytran.checkpoint/1", "stage": "stage2", "preset": "tiny", "model": {}, "views": {}}


def write(path, batches):
    write_replay(path, nn.Linear(2, 1), batches, card=CARD, step=7, precision="16-mixed", scale=1024.0)


def test_batches_come_back_as_they_were(batch, tmp_path):
    bare = replace(batch, objects=None, occupancy=None, foreground=None, new_views=None)
    empty = replace(batch, objects=(ObjectSet.empty(),))
    write(tmp_path / "replay.pt", [batch, bare, empty])
    content, (first, second, third) = read_replay(tmp_path / "replay.pt")
    assert content["global_step"] == 7
    assert (content["replay"]["precision"], content["replay"]["scale"]) == ("16-mixed", 1024.0)
    assert set(content["state_dict"]) == {"model.weight", "model.bias"}
    assert (first.scene_id, first.frame_id) == (batch.scene_id, batch.frame_id)
    for name in ("label", "center", "size", "rotation", "symmetry", "score", "shape"):
        assert torch.equal(getattr(first.objects[0], name), getattr(batch.objects[0], name)), name
    assert torch.equal(first.foreground, batch.foreground)
    assert torch.equal(first.views.world_from_camera, batch.views.world_from_camera)
    assert torch.equal(first.new_views.images, batch.new_views.images)
    assert second.objects is second.occupancy is second.foreground is second.new_views is None
    assert len(third.objects[0]) == 0


def test_a_file_holds_no_more_than_the_batch(batch, tmp_path):
    """A batch may look into a larger storage, as a scene of many frames does; it is not written along."""
    large = torch.zeros(50, *batch.views.images.shape[1:], dtype=torch.uint8)
    write(tmp_path / "a.pt", [replace(batch, views=replace(batch.views, images=large[:1]))])
    write(tmp_path / "b.pt", [batch])
    assert (tmp_path / "a.pt").stat().st_size == pytest.approx((tmp_path / "b.pt").stat().st_size, rel=0.05)


def test_one_replay_takes_the_place_of_another(batch, tmp_path):
    for _ in range(2):
        write(tmp_path / "replay.pt", [batch])
    assert [path.name for path in tmp_path.iterdir()] == ["replay.pt"]


@pytest.mark.parametrize(
    "kept", [{"batches": [{"views": 1}]}, {"batches": [3]}, {}, {"batches": [], "scale": "x"}]
)
def test_damaged_batches_are_one_sentence(kept, tmp_path):
    torch.save({**CARD, "state_dict": {}, "replay": kept}, tmp_path / "replay.pt")
    with pytest.raises(CheckpointError, match=r"the batches in .* are damaged"):
        read_replay(tmp_path / "replay.pt")
