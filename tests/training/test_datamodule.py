# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from itertools import islice
from types import SimpleNamespace

import lightning.pytorch as pl
import pytest
import torch

from raytran.data.augment import Augmentation
from raytran.errors import DataError
from raytran.run.entry import compose
from raytran.run.train.build import build_data
from raytran.training.datamodule import SceneDataModule


class Scenes:
    """Stands in for a data set: an item says when it was asked for what."""

    def __init__(self, **options):
        self.options = options

    def __len__(self):
        return 5

    def __getitem__(self, item):
        return item


class Boxes(Scenes):
    """Scenes of whose objects nothing but the boxes is known."""

    def has_shapes(self):
        return False


def make_data(monkeypatch, tmp_path, **options):
    monkeypatch.setattr("raytran.training.datamodule.collate_scenes", lambda samples: list(samples))
    return SceneDataModule(
        root=tmp_path, dataset=Scenes, targets=["objects"], num_views=7, val_views=9, num_workers=0, **options
    )


def test_every_epoch_brings_every_scene_in_another_order(monkeypatch, tmp_path):
    loader = make_data(monkeypatch, tmp_path).train_dataloader()
    items = [item for batch in islice(loader, 15) for item in batch]
    orders = [items[5 * epoch : 5 * epoch + 5] for epoch in range(3)]
    for epoch, order in enumerate(orders):
        assert {found for found, _ in order} == {epoch}
        assert sorted(index for _, index in order) == [0, 1, 2, 3, 4]
    assert len({tuple(index for _, index in order) for order in orders}) > 1


def test_shapes_are_not_learned_of_boxes(monkeypatch, tmp_path):
    data = make_data(monkeypatch, tmp_path)
    data._dataset = Boxes
    assert data.train_dataloader() is not None
    data._targets = ("shapes",)
    with pytest.raises(DataError, match=r"no object in .* has a shape to learn, only boxes are known: train"):
        data.train_dataloader()
    # Scores of the boxes are wanted all the same.
    assert data.val_dataloader() is not None


def test_a_checkpoint_holds_the_place_in_the_stream(monkeypatch, tmp_path):
    whole = list(islice(make_data(monkeypatch, tmp_path, batch_size=2).train_dataloader(), 9))
    # Stopped after three steps of two batches on one rank, it goes on with the seventh batch.
    stopped, resumed = (make_data(monkeypatch, tmp_path, batch_size=2) for _ in range(2))
    stopped.trainer = SimpleNamespace(global_step=3, accumulate_grad_batches=2, world_size=1)
    assert stopped.state_dict() == {"scenes": 12, "step": 3}
    resumed.load_state_dict(stopped.state_dict())
    assert list(islice(resumed.train_dataloader(), 3)) == whole[6:]


def test_loaders_leave_the_random_numbers_of_the_run_alone(monkeypatch, tmp_path):
    data = make_data(monkeypatch, tmp_path)
    before = torch.get_rng_state()
    next(iter(data.train_dataloader()))
    next(iter(data.val_dataloader()))
    assert torch.equal(torch.get_rng_state(), before)


def test_training_draws_views_and_validation_spreads_them(monkeypatch, tmp_path):
    data = make_data(monkeypatch, tmp_path)
    training, validation = data.split("train", training=True).options, data.split("val").options
    assert (training["split"], training["view_choice"], training["num_views"]) == ("train", "random", 7)
    assert (validation["split"], validation["view_choice"], validation["num_views"]) == ("val", "even", 9)


def test_further_roots_add_training_scenes_alone(monkeypatch, tmp_path):
    data = make_data(monkeypatch, tmp_path, more_roots=[tmp_path / "a", tmp_path / "b"])
    joined = data.split("train", training=True)
    assert [part.options["root"].name for part in joined._datasets] == [tmp_path.name, "a", "b"]
    assert len(joined) == 15
    assert [joined[3, index] for index in (0, 4, 5, 9, 10, 14)] == [
        *((3, 0), (3, 4)),
        *((3, 0), (3, 4)),
        *((3, 0), (3, 4)),
    ]
    assert [joined[index] for index in (4, 5)] == [4, 0]
    with pytest.raises(IndexError, match="scene 15 of 15"):
        joined[0, 15]
    items = {item for batch in islice(data.train_dataloader(), 15) for item in batch}
    assert items == {(0, index) for index in range(5)}  # each of the three sets gives all of its five
    assert data.split("val").options["root"] == data.split("train").options["root"] == tmp_path


def test_shapes_are_learned_where_one_of_the_roots_has_some(monkeypatch, tmp_path):
    data = make_data(monkeypatch, tmp_path, more_roots=[tmp_path / "a"])
    data._targets = ("shapes",)
    data._dataset = lambda **options: (Boxes if options["root"] == tmp_path else Scenes)(**options)
    assert data.train_dataloader() is not None
    data._dataset = Boxes
    with pytest.raises(DataError, match="only boxes are known"):
        data.train_dataloader()


def test_only_training_scenes_are_augmented(monkeypatch, tmp_path):
    data = make_data(monkeypatch, tmp_path, augmentation=Augmentation(mirror=1.0))
    assert data.split("train", training=True).options["augmentation"].mirror == 1
    assert data.split("train").options["augmentation"] is None
    assert data.split("val").options["augmentation"] is None


@pytest.mark.parametrize("data", ["rooms", "scan2cad"])
def test_augmentation_is_off_unless_asked_for(data):
    overrides = ["preset=raytran", f"data={data}", "data.root=unused", "output_dir=unused"]
    assert build_data(compose("train", overrides))._augmentation == Augmentation()
    asked = build_data(compose("train", [*overrides, "data.augmentation.shift=[0.5,0.5,0.2]"]))
    assert asked._augmentation == Augmentation(shift=(0.5, 0.5, 0.2))


def test_data_are_made_where_they_are_read(monkeypatch, tmp_path):
    made = []
    make_data(monkeypatch, tmp_path, make=lambda output: made.append(output)).prepare_data()
    assert made == [tmp_path]


def test_validation_scenes_come_one_by_one(monkeypatch, tmp_path):
    """So that losses, means over scenes, are the same for any batch size and any number of ranks."""
    assert list(make_data(monkeypatch, tmp_path, batch_size=2).val_dataloader()) == [[i] for i in range(5)]


@pytest.mark.filterwarnings("ignore:`training_step` returned", "ignore:You passed in a `val_dataloader`")
def test_the_trainer_is_given_the_scenes_of_every_root(room, tmp_path):
    class Counted(pl.LightningModule):
        def training_step(self, batch, index):
            seen.append(batch.scene_id[0])

        def configure_optimizers(self):
            return torch.optim.SGD([torch.nn.Parameter(torch.zeros(1))])

    words = ["preset=tiny", "data=scan2cad", f"data.root={room}", f"output_dir={tmp_path}"]
    words += ["stage.targets=[objects]", "views.num_workers=0"]
    trainer = pl.Trainer(
        accelerator="cpu",
        limit_train_batches=2,
        max_epochs=1,
        logger=False,
        enable_checkpointing=False,
        enable_progress_bar=False,
    )
    seen: list[str] = []
    data = build_data(compose("train", [*words, f"data.more_roots=[{room}]"]))
    trainer.fit(Counted(), datamodule=data)
    assert len(seen) == len(trainer.train_dataloader.dataset) == 2
    assert (
        len(build_data(compose("train", words)).split("train", training=True))
        == len(data.split("train"))
        == 1
    )
    missing = build_data(compose("train", [*words, f"data.more_roots=[{tmp_path / 'absent'}]"]))
    with pytest.raises(DataError, match=r"there is no folder .*absent"):
        missing.train_dataloader()
