# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
import pytest
import torch
from hydra.utils import instantiate
from PIL import Image

from raytran.errors import ConfigError, DataError
from raytran.run.entry import compose
from raytran.run.plan.dry_run import Load, dry_training
from raytran.run.plan.plan import GIBIBYTE, Need, advice, parse_size, plan
from raytran.run.plan.roofline import Ceilings, measure_ceilings
from raytran.run.train.build import build_model

from ...commands import Commands

FAST = ["preset=tiny", "ceilings=[1,10]", "model.backbone.num_blocks=1", "model.heads.objects.num_layers=1"]


def make_scan(folder: Path) -> Path:
    for name in ("color", "pose", "intrinsic"):
        (folder / name).mkdir(parents=True)
    for n in range(4):
        Image.new("RGB", (64, 48)).save(folder / "color" / f"{n}.jpg")
        pose = np.eye(4)
        pose[:3, :3] = [[1, 0, 0], [0, 0, 1], [0, -1, 0]]
        pose[:3, 3] = [0.1 * n, 0, 1.4]
        np.savetxt(folder / "pose" / f"{n}.txt", pose)
    intrinsic = [[60, 0, 32, 0], [0, 60, 24, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
    np.savetxt(folder / "intrinsic" / "intrinsic_color.txt", intrinsic)
    return folder


def test_sizes() -> None:
    assert parse_size("16GB") == 16 * GIBIBYTE
    assert parse_size("1.5 gib") == 3 * GIBIBYTE // 2
    assert parse_size("512MB") == GIBIBYTE // 2
    for wrong in ("lots", "16", "0GB", "-3GB"):
        with pytest.raises(ConfigError, match="gpu=16GB"):
            parse_size(wrong)


def need(setting: str, gigabytes: float) -> Need:
    return Need("train", setting, 20, round(gigabytes * GIBIBYTE), 1.0)


def test_advice_names_the_first_setting_that_fits() -> None:
    plain, again = need("checkpoint_blocks=false", 20.0), need("checkpoint_blocks=true", 12.0)
    assert "fit with checkpoint_blocks=false (20.0 GB of 24.0 GB)" in advice([plain, again], 24 * GIBIBYTE)
    assert "they do with checkpoint_blocks=true (12.0 GB)" in advice([plain, again], 16 * GIBIBYTE)
    assert "12.0 GB even with checkpoint_blocks=true" in advice([plain, again], 8 * GIBIBYTE)


def test_a_plan(caplog: pytest.LogCaptureFixture, capsys: pytest.CaptureFixture[str]) -> None:
    with caplog.at_level(logging.INFO):
        grid, views = "model.grid.resolution=[12,12,6]", ["data.views=24", "views.image_size=[192,256]"]
        needs = plan(compose("plan", [*FAST, "gpu=16GB", grid, *views]))
    train = [x for x in needs if x.job == "train"]
    predict = {x.setting: x for x in needs if x.job == "predict"}
    assert {x.views for x in needs} == {24}
    assert train[1].memory < train[0].memory  # activation checkpointing …
    assert train[1].seconds > train[0].seconds  # … has its price
    assert predict["views_at_once=4"].memory < predict["views_at_once=null"].memory
    assert train[0].seconds > predict["views_at_once=null"].seconds > 0
    assert "predict: 24 frames fit with views_at_once=16" in caplog.text
    assert "training in 16-mixed" in " ".join(capsys.readouterr().out.split())


def test_a_plan_without_attention_has_no_blocks_to_compute_twice() -> None:
    small = ["model.grid.resolution=[12,12,6]", "data.views=4", "views.image_size=[64,96]"]
    needs = plan(compose("plan", [*FAST, "gpu=16GB", "model/backbone=unprojection", *small]))
    assert [x.setting for x in needs if x.job == "train"] == ["everything kept"]
    assert min(x.memory for x in needs) > 0


def test_a_plan_from_the_cameras_of_a_scan(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    scan = make_scan(tmp_path / "room")
    with caplog.at_level(logging.INFO):
        plan(compose("plan", [*FAST, f"scene={scan}", "data.views=2", "gpu=700MB"]))
    assert str(scan) in caplog.text
    assert "do not fit" in caplog.text


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("precision=8", "one of 16-mixed"),
        ("gpu=big", "gpu=16GB"),
        ("ceilings=[0,1]", r"ceilings=\[100,900\]"),
        ("views.image_size=[90,128]", "divisible by 16"),
        ("model.grid.resolution=[4,4]", "three numbers"),
    ],
)
def test_settings_without_meaning(setting: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        plan(compose("plan", [*FAST, setting]))


def test_a_missing_scan() -> None:
    with pytest.raises(DataError, match="nowhere"):
        plan(compose("plan", [*FAST, "scene=nowhere"]))


def test_ceilings_are_measured() -> None:
    found = measure_ceilings(torch.device("cpu"))
    assert isinstance(found, Ceilings)
    assert 1e9 < found.operations_per_second < 1e14
    assert 1e8 < found.bytes_per_second < 1e13


MEASURED = """
import sys
from pathlib import Path
import torch
from raytran.run.train.build import build_model
from raytran.run.plan.camera_paths import walk
from raytran.run.entry import compose
from raytran.run.plan.dry_run import Load, dry_prediction
from raytran.run.plan.plan import FIXED, SCRATCH
from raytran.structs import Views

def status(name):
    lines = Path("/proc/self/status").read_text().splitlines()
    return 1024 * next(int(line.split()[1]) for line in lines if line.startswith(name))

model = build_model(compose("train", ["preset=tiny", "output_dir=x"])).eval()
size = (192, 256)
forecast = dry_prediction(model, Load(1, 48, size, 40.0, fused=False), views_at_once=None).peak
cameras = walk(48).scaled_to(size)
lead = (cameras.intrinsics[None].float(), cameras.world_from_camera[None].float())
Path("/proc/self/clear_refs").write_text("5")
before = status("VmRSS")
model.predict(Views(torch.zeros(1, 48, 3, *size, dtype=torch.uint8), *lead))
weights = sum(4 * x.numel() for x in model.parameters())
print((status("VmHWM") - before + weights) / (SCRATCH * forecast + FIXED))
"""


@pytest.mark.skipif(not Path("/proc/self/clear_refs").exists(), reason="needs Linux's peak of memory")
def test_the_forecast_is_within_a_factor_of_two_of_the_measured_peak(
    command: Commands, tmp_path: Path
) -> None:
    (tmp_path / "measured.py").write_text(MEASURED)
    done = command(str(tmp_path / "measured.py"), folder=tmp_path)
    assert done.returncode == 0, done.stderr
    assert 0.5 < float(done.stdout.split()[-1]) < 2.0


def test_views_to_be_rendered_need_memory_in_training() -> None:
    cfg = compose("plan", [*FAST, "stage=novel_view"])
    del cfg.model.grid
    model, load = build_model(cfg, pretrained=False), Load(1, 3, (96, 128), 20.0, fused=False)
    few, many = (
        dry_training(model, load, instantiate(cfg.stage, new_views=count, _convert_="all")).peak
        for count in (1, 17)
    )
    # Of 16 more views at least their images and the widest layer of the head at full and at half size.
    assert many - few > 16 * 96 * 128 * 4 * (3 + 8 / 4)
