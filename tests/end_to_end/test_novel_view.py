# SPDX-License-Identifier: Apache-2.0
"""New views: a fit from a finished stage 1, its scores, and a prediction that renders a list of cameras."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
import torch
from PIL import Image

import raytran
from raytran.data.scannet.scan import open_scan
from raytran.errors import ConfigError
from raytran.run.entry import compose
from raytran.run.evaluate.evaluate import evaluate_model
from raytran.run.evaluate.results import write_evaluation
from raytran.run.predict.predict import predict
from raytran.run.train.build import build_data
from raytran.run.train.fit import train


@pytest.fixture(scope="module")
def trained(settings, tmp_path_factory):
    """Stage 1, then new views from it."""
    folder = tmp_path_factory.mktemp("novel_view")
    short = [*settings, "trainer.max_steps=2", "watch.pictures=1", f"outputs={folder}"]
    before = train(compose("train", [*short, f"output_dir={folder}/before"]))
    more = ["experiment=novel_view", "stage.new_views=2", f"init_from={before.checkpoint}"]
    return before, train(compose("train", [*short, *more, f"output_dir={folder}/after"]))


def test_training_starts_from_stage_1_and_scores_new_views(trained):
    parent, fit = trained
    card = torch.load(fit.checkpoint, weights_only=True)
    assert (card["stage"], card["parent"]["path"]) == ("novel_view", str(parent.checkpoint))
    for name in ("psnr", "ssim", "psnr_best_constant", "psnr_nearest_frame"):
        assert math.isfinite(card["scores"][f"val/view/{name}"])
    assert len(list((fit.folder / "pictures" / "step-000002").glob("*/new_views.jpg"))) == 1


def test_evaluation_says_what_validation_said(trained, settings, tmp_path):
    _, fit = trained
    cfg = compose("train", [*settings, "experiment=novel_view", "stage.new_views=2", "output_dir=unused"])
    model, dataset = raytran.load(fit.checkpoint), build_data(cfg).split("val")
    evaluation = evaluate_model(model, dataset, tasks=("view",), progress=False)
    write_evaluation(tmp_path / "out", evaluation)
    metrics = evaluation.metrics
    scores = torch.load(fit.checkpoint, weights_only=True)["scores"]
    assert metrics["new_views"]["n_views"] == 2
    for name in ("psnr", "ssim", "psnr_best_constant", "psnr_nearest_frame"):
        assert metrics["new_views"][name] == pytest.approx(scores[f"val/view/{name}"], abs=1e-3)
    assert json.loads((tmp_path / "out" / "metrics.json").read_text()) == metrics
    assert len((tmp_path / "out" / "per_view.csv").read_text().splitlines()) == 3


def test_a_prediction_renders_a_list_of_cameras(trained, rooms, tmp_path):
    """Pictures come under the names of the list, at its size; a network without the head is refused first."""
    parent, fit = trained
    scene = next((rooms / "scannet" / "scans").iterdir())
    with open_scan(scene) as scan:
        poses, matrix, size = scan.world_from_camera[:3], scan.intrinsics[0], scan.image_size
    views = [{"name": f"pose {n}", "world_from_camera": pose.tolist()} for n, pose in enumerate(poses)]
    listed = tmp_path / "cameras.json"
    listed.write_text(json.dumps({"image_size": list(size), "intrinsics": matrix.tolist(), "views": views}))
    typed = [
        f"scene={scene}",
        f"views={listed}",
        "check=false",
        "turntable=0",
        "num_overlays=0",
        "device=cpu",
    ]
    with pytest.raises(ConfigError, match="cannot render views="):
        predict(compose("predict", [*typed, f"checkpoint={parent.checkpoint}", f"output={tmp_path}/no"]))
    assert not (tmp_path / "no").exists()
    output = predict(
        compose(
            "predict", [*typed, f"checkpoint={fit.checkpoint}", f"output={tmp_path}/out", "views_at_once=2"]
        )
    )
    pictures = sorted((output / "new_views").iterdir())
    assert [path.name for path in pictures] == ["pose 0.png", "pose 1.png", "pose 2.png"]
    pixels = [np.asarray(Image.open(path)) for path in pictures]
    assert all(picture.shape == (*size, 3) for picture in pixels)
    assert (output / "scene.json").is_file()
