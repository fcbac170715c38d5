# SPDX-License-Identifier: Apache-2.0
"""The plan view shows boxes to scale and north up."""

from __future__ import annotations

import numpy as np
import torch
from PIL import Image

from raytran.geometry.camera import Cameras
from raytran.pictures.topdown import draw_topdown
from raytran.structs import ObjectSet, ScenePrediction

UPRIGHT = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


def objects(*items: tuple[int, tuple[float, float, float], tuple[float, float, float]]) -> ObjectSet:
    one = torch.ones(len(items), dtype=torch.int64)
    return ObjectSet(
        label=torch.tensor([item[0] for item in items]),
        center=torch.tensor([item[1] for item in items]),
        size=torch.tensor([item[2] for item in items]),
        rotation=UPRIGHT.expand(len(items), 3, 3),
        symmetry=one,
        score=one.float(),
    )


def cameras() -> Cameras:
    pose = torch.eye(4).repeat(3, 1, 1)
    pose[:, 0, 3] = torch.tensor([-1.0, 0.0, 1.0])
    return Cameras(torch.eye(3).repeat(3, 1, 1), pose, (48, 64))


def centre_of(image: np.ndarray, color: tuple[int, int, int], tolerance: int = 60) -> np.ndarray:
    """Mean row and column of the pixels that are near ``color``, the legend at the right left out."""
    near = np.abs(image[:, : int(0.82 * image.shape[1])].astype(int) - color).sum(axis=-1) < tolerance
    assert near.any()
    return np.argwhere(near).mean(axis=0)


def test_north_is_up_and_east_is_right(tmp_path):
    # A sofa (red) in the north-east, a table (green) in the south-west.
    scene = objects((5, (2.0, 1.5, 0.4), (1.0, 0.8, 0.8)), (6, (-2.0, -1.5, 0.4), (1.0, 0.8, 0.8)))
    path = draw_topdown(
        tmp_path / "topdown.png",
        ScenePrediction("room", scene, torch.zeros(3)),
        truth=None,
        cameras=cameras(),
    )
    image = np.asarray(Image.open(path).convert("RGB"))
    sofa, table = centre_of(image, (214, 39, 40)), centre_of(image, (44, 160, 44))
    assert sofa[0] < table[0]
    assert sofa[1] > table[1]


def test_truth_and_occupancy_and_an_empty_prediction(tmp_path):
    occupancy = torch.zeros(8, 8, 4)
    occupancy[6:, 6:, 0] = 1.0
    nothing = ScenePrediction(
        "room", ObjectSet.empty(), torch.zeros(3), occupancy=occupancy, grid_extent=(6.0, 6.0, 3.0)
    )
    truth = objects((5, (-2.0, -1.5, 0.4), (1.0, 0.8, 0.8)), (6, (2.5, 2.5, 0.4), (1.0, 0.8, 0.8)))
    options = {"truth": truth, "cameras": cameras()}
    path = draw_topdown(tmp_path / "topdown.png", nothing, **options)
    image = np.asarray(Image.open(path).convert("RGB")).astype(int)
    assert centre_of(image, (214, 39, 40))[0] > image.shape[0] / 2, "the true sofa lies in the south"
    bare_prediction = ScenePrediction("room", ObjectSet.empty(), torch.zeros(3))
    bare = draw_topdown(tmp_path / "bare.png", bare_prediction, **options)
    change = np.abs(np.asarray(Image.open(bare).convert("RGB")).astype(int) - image).sum(axis=-1) > 30
    # Occupied cells at the far end of x and y darken the north-east and nothing else.
    row, column = np.argwhere(change).mean(axis=0)
    assert row < image.shape[0] / 2
    assert column > image.shape[1] / 2
