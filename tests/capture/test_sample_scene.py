# SPDX-License-Identifier: Apache-2.0
"""The scene that raytran carries."""

from __future__ import annotations

import logging

from raytran.capture.open import open_scene
from raytran.capture.sample_scene import scene_path


def test_the_sample_opens_without_a_doubt(caplog):
    folder = scene_path("sample")
    with caplog.at_level(logging.WARNING), open_scene(folder) as scan:
        assert (len(scan), scan.dropped, scan.image_size) == (24, {}, (240, 320))
    assert not caplog.records
    assert sum(path.stat().st_size for path in folder.rglob("*")) < 2**20


def test_a_scene_of_that_name_comes_first(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    carried = scene_path("sample")
    assert scene_path("./sample") == tmp_path / "sample" or scene_path("./sample") != carried
    (tmp_path / "sample").mkdir()
    assert scene_path("sample") == tmp_path / "sample"
    assert scene_path("other") == tmp_path / "other"
