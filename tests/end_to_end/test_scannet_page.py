# SPDX-License-Identifier: Apache-2.0
"""``docs/scannet-8-gpus.md`` from released files to scores, on generated rooms and two CPU processes."""

from __future__ import annotations

import json

import pytest

from ..docs.test_code_blocks import command_lines, words_of

NETWORK = [
    *("preset=tiny", "views.image_size=[64,64]", "views.num_views=3", "views.predict_views=4"),
    *("model.grid_resolution=[8,8,4]", "model.heads.objects.num_queries=8"),
]
SMALL = {
    "prepare": ["image_size=[32,32]", "processes=1"],
    "curriculum": [
        *NETWORK,
        *(f"schedule.stage{number}.steps=1" for number in (1, 2, 3)),
        *("schedule.log_every=1", "trainer.val_check_interval=1", "watch.pictures=0", "progress_bar=none"),
    ],
    "predict": ["num_views=4", "score_threshold=0", "duplicate_iou=null"],
    "evaluate": ["num_resamples=1"],
}
"""What makes the page's commands quick."""


@pytest.mark.nightly
def test_the_page_from_released_files_to_scores(command, project_root, small_rooms, tmp_path):
    page = (project_root / "docs" / "scannet-8-gpus.md").read_text(encoding="utf-8")
    (tmp_path / "scannet").symlink_to(small_rooms / "scannet")
    (tmp_path / "ShapeNetCore.v2").symlink_to(small_rooms / "shapenet")
    (tmp_path / "full_annotations.json").symlink_to(small_rooms / "scan2cad" / "full_annotations.json")
    (scan,) = (small_rooms / "scannet" / "scannetv2_val.txt").read_text().split()
    ran: list[str] = []
    for verb, rest in command_lines(page):
        if verb in ("train", "plan"):  # of SLURM, and of a GPU
            continue
        ran.append(verb)
        runs = sorted(tmp_path.glob("outputs/tiny/curriculum/*"))
        (words,) = words_of(rest.replace("$scan", scan).replace("trainer=ddp", "trainer=ddp_cpu"))
        if runs:
            place = str(runs[-1].relative_to(tmp_path))
            words = [word.replace("outputs/raytran/curriculum/TIME", place) for word in words]
        small = [] if "check=data/scan2cad" in words else SMALL[verb]
        result = command(verb, *words, *small, folder=tmp_path, starts=2 if verb == "curriculum" else 0)
        assert result.returncode == 0, f"{verb} {words}: {result.stderr}"
        if verb == "predict":
            (tmp_path / "alignments").mkdir()
            found = tmp_path / "predictions" / scan / "scan2cad.csv"
            (tmp_path / "alignments" / f"{scan}.csv").write_text(found.read_text())
    assert ran == ["prepare", "prepare", "curriculum", "evaluate", "predict", "evaluate"]
    metrics = json.loads((tmp_path / "results" / "metrics.json").read_text())
    assert (metrics["dataset"], metrics["split"], metrics["num_views"]) == ("scan2cad", "val", 4)
    metrics = json.loads((tmp_path / "results-of-all" / "metrics.json").read_text())
    assert {"strict", "scan2cad", "vid2cad", "odam"} <= set(metrics)
