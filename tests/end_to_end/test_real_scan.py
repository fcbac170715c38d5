# SPDX-License-Identifier: Apache-2.0
"""From a real scan as released to a training step, by the commands a user types."""

from __future__ import annotations

import math

from raytran.run.entry import compose
from raytran.run.prepare.prepare import prepare
from raytran.run.train.fit import train


def test_a_real_scan_is_prepared_and_trained_on(shared_dir, tmp_path):
    real = shared_dir / "realdata" / "scene0470_00"
    out = tmp_path / "prepared"
    paths = [f"{name}={real / name}" for name in ("scannet", "shapenet", "scan2cad")]
    asked = ["preset=tiny", "image_size=[96,128]", "max_frames=6", "processes=1", f"output={out}"]
    prepared = prepare(compose("prepare", ["dataset=scan2cad", *paths, *asked]))
    assert prepared.report["frames"]["written"] == 6
    assert sum(prepared.report["objects"]["all"].values()) == 7
    cached = sorted((out / "cache").rglob("*.z"))
    data = ["preset=tiny", "experiment=stage2", "data=scan2cad", f"data.root={out}"]
    once = ["trainer=cpu", "trainer.max_steps=1", "init_from=none", f"output_dir={tmp_path / 'run'}"]
    fit = train(compose("train", [*data, *once]))
    assert fit.steps == 1
    assert fit.metrics
    assert all(map(math.isfinite, fit.metrics.values()))
    # Nothing that training asks for was left to be made.
    assert sorted((out / "cache").rglob("*.z")) == cached
