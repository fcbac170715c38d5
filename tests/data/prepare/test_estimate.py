# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import pytest

from raytran.data.files import bytes_below
from raytran.data.prepare.estimate import Estimate, estimate
from raytran.data.prepare.scan import PrepareSettings
from raytran.data.prepare.sources import Released, read_sources

SETTINGS = PrepareSettings((16, 24), max_frames=3)


@pytest.fixture
def sources(released, tmp_path):
    paths = (released / "scannet", released / "shapenet", released / "scan2cad")
    return read_sources(Released(*paths), tmp_path / "out")


def judge(sources, tmp_path, settings=SETTINGS, models=("03001627/cube",)):
    (tmp_path / "out").mkdir()
    jobs = sources.selection.jobs
    return estimate(jobs, models, tmp_path / "out", settings, shapenet=sources.shapenet, processes=1)


def test_an_estimate_is_near_what_it_becomes(sources, released, prepare, tmp_path):
    judged = judge(sources, tmp_path)
    assert (judged.scans, judged.frames) == (3, 9)
    assert list((tmp_path / "out").iterdir()) == []
    prepare(released, tmp_path / "real")
    real = tmp_path / "real"
    color = sum(bytes_below(scan / "color") for scan in (real / "scannet/scans").iterdir())
    written = color + bytes_below(real / "shapenet") + bytes_below(real / "cache")
    assert judged.num_bytes == pytest.approx(written, rel=0.2)
    assert judged.seconds > 0


def test_what_cannot_be_tried_does_not_stop_the_estimate(sources, released, tmp_path):
    for path in released.rglob("color/*.jpg"):
        path.write_bytes(b"damaged")
    judged = judge(sources, tmp_path, models=("03001627/gone",))
    assert (judged.frames, judged.num_bytes) == (9, 0)


def test_words():
    text = str(Estimate(scans=2, frames=400, num_bytes=2.4e9, seconds=7200.0, free=10_000_000_000))
    assert text == ("to do: scans 2, frames about 400; expect 2.4 GB on disk (10.0 GB are free) and 2.0 h")
    assert "and 1 min" in str(Estimate(scans=1, frames=2, num_bytes=10.0, seconds=3.0, free=1))
