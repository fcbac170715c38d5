# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import re

import pytest

from raytran.checkpoints.metadata import DataIdentity, checkpoint_metadata
from raytran.run.entry import compose
from raytran.run.train.build import build_model, build_module, plain
from raytran.run.train.start_report import changed_settings, start_report


def metadata(cfg, parent=None):
    return checkpoint_metadata(stage=cfg.stage.name, preset=cfg.preset, config=plain(cfg), parent=parent)


@pytest.mark.parametrize(
    ("experiment", "trained", "frozen", "terms"),
    [
        ("stage1", ["backbone", "heads.occupancy"], ["heads.objects", "heads.shape"], "occupancy"),
        ("stage3", ["heads.shape"], ["backbone", "heads.occupancy", "heads.objects"], "shape"),
    ],
)
def test_parts_and_counts(experiment, trained, frozen, terms):
    cfg = compose("train", ["preset=tiny", f"experiment={experiment}", "output_dir=unused"])
    module = build_module(cfg, build_model(cfg))
    first, second, third = start_report(module.stage, module.model, metadata(cfg))
    assert first.startswith("trains ")
    assert all(f" {name} " in first for name in trained)
    assert second.startswith("frozen ")
    assert all(f" {name} " in second for name in frozen)
    assert third.startswith(f"loss terms {terms};")
    counts = [int(line.split()[1].replace(",", "")) for line in (first, second)]
    assert sum(counts) == sum(parameter.numel() for parameter in module.model.parameters())
    assert counts[0] == sum(p.numel() for p in module.model.parameters() if p.requires_grad)
    parts = [int(number.replace(",", "")) for number in re.findall(r" ([\d,]+)(?:,|$)", first.split(":")[1])]
    assert sum(parts) == counts[0]


def test_the_parent_is_named_with_its_score():
    cfg = compose("train", ["preset=tiny", "experiment=stage2", "output_dir=unused"])
    module = build_module(cfg, build_model(cfg))
    scores = {"val/occupancy/iou": 0.41234, "val/total": 3.0}
    parent = {"path": "a/last.ckpt", "stage": "stage1", "step": 1500, "scores": scores}
    last = start_report(module.stage, module.model, metadata(cfg, parent))[-1]
    assert last == "starts from stage1, step 1500, val/occupancy/iou 0.412: a/last.ckpt"


def test_a_parent_on_other_data_is_said_in_one_line():
    typed = ["preset=tiny", "experiment=stage2", "output_dir=unused"]
    cfg = compose("train", [*typed, "data=scan2cad", "data.root=real"])
    module = build_module(cfg, build_model(cfg))
    parent = {"path": "a/last.ckpt", "stage": "stage1", "step": 1500, "scores": {}}
    rooms = DataIdentity.of_config(plain(compose("train", [*typed, "data.root=rooms"]))).as_plain()
    line = "its parent was trained on other data, rooms in rooms; this run on scan2cad in real"
    assert line in start_report(module.stage, module.model, metadata(cfg, parent | {"data": rooms}))
    same = metadata(cfg)["data"]
    for quiet in (parent, parent | {"data": None}, parent | {"data": same}):
        assert not any(
            "other data" in line for line in start_report(module.stage, module.model, metadata(cfg, quiet))
        )


def test_a_network_of_ones_own_says_what_its_checkpoints_need():
    cfg = compose("train", ["preset=tiny", "output_dir=unused"])
    module, known = build_module(cfg, build_model(cfg)), metadata(cfg)
    known["model"]["backbone"]["_target_"] = "mylab.nets.MyBackbone"
    known["model"]["heads"]["shape"]["_target_"] = "friends.Head"
    line = start_report(module.stage, module.model, known)[-1]
    assert line.startswith("this network has classes of friends, mylab: to use its checkpoints, evaluate, ")
    assert line.endswith("need trust=[friends,mylab]")
    assert start_report(module.stage, module.model, known, trust=["mylab"])[-1] == line
    assert line not in start_report(module.stage, module.model, known, trust=["mylab", "friends"])


def test_settings_that_change_in_a_resumed_run_are_named():
    before = {
        "seed": 0,
        "resume": "none",
        "optimizer": {"learning_rate": 1e-3, "decay": "none"},
        "views": [3, 4],
    }
    now = {"seed": 0, "resume": "auto", "optimizer": {"learning_rate": 1e-4, "warmup": 5}, "views": [3, 4]}
    assert changed_settings(before, before) == []
    assert changed_settings(before, now) == [
        "optimizer.learning_rate: 0.001 → 0.0001",
        "optimizer.decay: none → unset",
        "optimizer.warmup: unset → 5",
    ]


@pytest.mark.parametrize("masks", [False, True])
def test_settings_that_came_later_are_no_change(masks):
    """A run from before there were keys for what it did goes on without a word, unless they say otherwise."""
    typed = ["preset=tiny", "experiment=stage2", "output_dir=unused"] + ["variant=gt_masks"] * masks
    before = plain(compose("train", typed))
    for key in ("shape_layers", "center_beta", "yaw_beta"):
        del before["loss"][key]
    for key in ("class_cost", "center_beta", "yaw_beta"):
        del before["loss"]["matcher"][key]
    del before["data"]["name"], before["data"]["dataset"]["object_choice"]
    before["data"]["dataset"]["input_mask"] = masks
    del before["variant_prefix"]
    of_objects = before["model"]["heads"]["objects"]
    del before["classes"], before["model"]["classes"], before["data"]["dataset"]["classes"]
    del of_objects["classes"], of_objects["queries"]["classes"]
    assert changed_settings(before, plain(compose("train", typed))) == []
    more = ["loss.shape_layers=all", "data.dataset.object_choice=seen", "loss.yaw_beta=0.2"]
    assert sorted(changed_settings(before, plain(compose("train", [*typed, *more])))) == [
        "data.dataset.object_choice: all → seen",
        "loss.matcher.yaw_beta: 0.1 → 0.2",
        "loss.shape_layers: last → all",
        "loss.yaw_beta: 0.1 → 0.2",
    ]
