# SPDX-License-Identifier: Apache-2.0
"""Which scenes are drawn, in every stage; and that no picture ends a run."""

from __future__ import annotations

import errno
from functools import partial

import pytest

from raytran.training.callbacks import scene_pictures
from raytran.training.callbacks.scene_pictures import ScenePictures

EVERY_TWO_STEPS = {"max_steps": 4, "val_check_interval": 2, "check_val_every_n_epoch": None}


@pytest.mark.parametrize(
    ("experiment", "names"),
    [
        ("stage1", {"occupancy.png", "topdown.png", "boxes.jpg"}),
        ("stage2", {"occupancy.png", "masks.jpg", "topdown.png", "boxes.jpg"}),
        ("stage3", {"topdown.png", "boxes.jpg"}),
        ("novel_view", {"new_views.jpg", "topdown.png", "boxes.jpg"}),
    ],
)
def test_each_stage_shows_what_it_predicts(experiment, names, fit, tmp_path, monkeypatch):
    # All slots of a network that has learned nothing yet, with their shapes in stage 3.
    monkeypatch.setattr(scene_pictures, "SCORE_THRESHOLD", 0.0)
    twice = EVERY_TWO_STEPS if experiment == "stage1" else EVERY_TWO_STEPS | {"max_steps": 2}
    fit(ScenePictures(tmp_path, scenes=2), experiment=experiment, validate=3, **twice)
    steps = range(2, twice["max_steps"] + 1, 2)
    assert {path.name for path in tmp_path.iterdir()} == {f"step-{step:06d}" for step in steps}
    for step in tmp_path.iterdir():
        assert {path.name for path in step.iterdir()} == {"scene0", "scene2"}, "spread over the split"
        for scene in step.iterdir():
            assert {path.name for path in scene.iterdir()} == names


def test_a_validation_done_again_replaces_its_pictures(fit, tmp_path):
    old = tmp_path / "step-000002" / "gone"
    old.mkdir(parents=True)
    fit(ScenePictures(tmp_path, scenes=1), experiment="stage1", validate=1, **EVERY_TWO_STEPS)
    assert not old.exists()


def fail(error, *_arguments, **_named):
    raise error


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (OSError(errno.ENOSPC, "No space left on device"), "no pictures of step 2 (No space left on device)"),
        (ValueError("a box without extent\nat all"), "no pictures of step 2: a box without extent"),
    ],
)
def test_a_picture_that_fails_is_said_and_training_goes_on(error, words, fit, tmp_path, monkeypatch, caplog):
    monkeypatch.setattr(scene_pictures, "draw_scene", partial(fail, error))
    trainer = fit(ScenePictures(tmp_path, scenes=1), experiment="stage1", validate=1, **EVERY_TWO_STEPS)
    assert trainer.global_step == 4
    assert words in caplog.text
    assert list(tmp_path.iterdir()) == [], "nothing half-written stays"
