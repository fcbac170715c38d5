# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json

import pytest

from raytran.data.prepare.settings import PrepareSettings, claimed
from raytran.errors import ConfigError, DataError


def test_a_new_folder_is_claimed_and_may_be_claimed_again(tmp_path):
    for _ in range(2):
        with claimed(tmp_path / "out", PrepareSettings(), {"annotations": "abc"}):
            found = json.loads((tmp_path / "out" / "prepare.json").read_text())
        assert found["image_size"] == [480, 640]
        assert found["annotations"] == "abc"


@pytest.mark.parametrize(
    ("settings", "sources", "named"),
    [
        (PrepareSettings(masks=False), {"annotations": "abc"}, "another masks;"),
        (PrepareSettings((96, 128), 5), {"annotations": "x"}, "another image_size, max_frames, annotations;"),
    ],
)
def test_other_settings_are_refused(tmp_path, settings, sources, named):
    with claimed(tmp_path, PrepareSettings(), {"annotations": "abc"}):
        pass
    with pytest.raises(DataError, match=named), claimed(tmp_path, settings, sources):
        pass


def test_a_damaged_marker_is_refused(tmp_path):
    (tmp_path / "prepare.json").write_text("{")
    with pytest.raises(DataError, match=r"prepare\.json"), claimed(tmp_path, PrepareSettings(), {}):
        pass


def test_only_one_at_a_time(tmp_path):
    with claimed(tmp_path, PrepareSettings(), {}):
        again = claimed(tmp_path, PrepareSettings(), {})
        with pytest.raises(DataError, match="another process prepares"), again:
            pass
    with claimed(tmp_path, PrepareSettings(), {}):
        pass


@pytest.mark.parametrize("wrong", [{"image_size": (8, 640)}, {"max_frames": 1}])
def test_contradictions_are_refused(wrong):
    with pytest.raises(ConfigError, match="max_frames"):
        PrepareSettings(**wrong)
