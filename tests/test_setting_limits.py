# SPDX-License-Identifier: Apache-2.0
"""What numbers in settings can mean, in configs and in the API."""

from __future__ import annotations

import math

import pytest
import torch

from raytran.errors import ConfigError
from raytran.geometry.grid import VoxelGrid
from raytran.run.config_dir import config_dir
from raytran.run.entry import compose, run_or_exit
from raytran.setting_limits import check_settings


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("image_size", [0, 640]),
        ("image_size", [480, 10**9]),
        ("image_size", [480.5, 640]),
        ("num_views", 10**9),
        ("num_views", 0),
        ("num_views", True),
        ("num_views", "24"),
        ("steps", 10**400),
        ("steps", -5),
        ("learning_rate", math.nan),
        ("learning_rate", "nan"),
        ("learning_rate", -1e-4),
        ("learning_rate", math.inf),
        ("score_threshold", 1.5),
        ("score_threshold", math.nan),
        ("duplicate_iou", -0.1),
        ("room_size", [[3, 4], [3, math.inf]]),
        ("grid_resolution", [-1, 0, 3]),
        ("grid_extent", [9, 9, 0]),
        ("weights", {"class": math.nan}),
        ("seed", -1),
        ("batch_size", 10**12),
        ("num_workers", 10**6),
        ("processes", -1),
        ("scale", 1e300),
        ("ceilings", [0, math.nan]),
        ("num_resamples", 10**9),
    ],
)
def test_a_number_beyond_its_meaning_is_named(name, value):
    with pytest.raises(ConfigError, match=rf"^train\.views\.{name}(\.\w+)? is .*: mend it$") as error:
        check_settings({"train": {"views": {name: value}}})
    assert len(str(error.value)) < 200


def test_words_references_and_other_numbers_are_not_looked_at():
    check_settings(
        {
            "frames": "coverage",
            "num_views": None,
            "learning_rate": "${schedule.stage1.learning_rate}",
            "views": "cameras.json",
            "port": -5,
            "mine": math.nan,
            "image_size": (480, 640),
        }
    )


@pytest.mark.parametrize("name", sorted(path.stem for path in config_dir().glob("*.yaml")))
def test_every_config_of_ours_passes(name):
    from omegaconf import OmegaConf

    check_settings(OmegaConf.to_container(compose(name, []), resolve=False))


def test_commands_end_in_a_sentence_before_they_begin(capsys):
    cfg = compose("train", ["preset=tiny", "views.image_size=[0,64]", "output_dir=unused"])
    with pytest.raises(SystemExit):
        run_or_exit(lambda _: pytest.fail("begun"), cfg)
    assert (
        capsys.readouterr().err
        == "raytran: views.image_size is 0, not a whole number from 1 to 8192: mend it\n"
    )


@pytest.mark.parametrize(
    ("resolution", "extent"),
    [
        ((-1, 0, 3), (1.0, 1.0, 1.0)),
        ((0, 4, 4), (1.0, 1.0, 1.0)),
        ((4, 4), (1.0, 1.0, 1.0)),
        ((4, 4, 4), (1.0, 1.0)),
        ((4, 4, 4.5), (1.0, 1.0, 1.0)),
        ((2000, 2000, 2000), (1.0, 1.0, 1.0)),
        ((10**9, 1, 1), (1.0, 1.0, 1.0)),
        ((4, 4, 4), (math.nan, 1.0, 1.0)),
        ((4, 4, 4), (0.0, 1.0, 1.0)),
        ((4, 4, 4), (-1.0, 1.0, 1.0)),
        ((4, 4, 4), (1e300, 1.0, 1.0)),
    ],
)
def test_grids_that_cannot_be(resolution, extent):
    with pytest.raises(ConfigError, match="grid"):
        VoxelGrid(resolution, extent, torch.zeros(3))
