# SPDX-License-Identifier: Apache-2.0
"""Contact sheets, masks and occupancy slices show what is there."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from PIL import Image

from raytran.pictures.panels import draw_frames, draw_masks, draw_new_views, draw_occupancy
from raytran.structs import Views


def grey_views(*levels: int) -> Views:
    images = torch.stack([torch.full((3, 30, 40), level, dtype=torch.uint8) for level in levels])[None]
    count = len(levels)
    return Views(images, torch.eye(3).expand(1, count, 3, 3), torch.eye(4).expand(1, count, 4, 4))


def test_frames_lie_in_reading_order(tmp_path):
    sheet = np.asarray(Image.open(draw_frames(tmp_path / "f.jpg", grey_views(0, 60, 120, 180), columns=2)))
    height, width = sheet.shape[:2]
    corners = [
        sheet[row, column].mean()
        for row in (height // 4, 3 * height // 4)
        for column in (width // 4, 3 * width // 4)
    ]
    assert corners == pytest.approx([0, 60, 120, 180], abs=3)


def test_new_views_lie_below_their_photographs_below_what_was_seen(tmp_path):
    rendered = torch.tensor([0.4, 0.8])[:, None, None, None].expand(2, 3, 30, 40)
    seen, truth = grey_views(0, 20, 40, 60), grey_views(120, 180)
    sheet = np.asarray(Image.open(draw_new_views(tmp_path / "n.jpg", seen, truth, rendered, count=4)))
    height, width = sheet.shape[:2]
    middles = [
        [sheet[(2 * row + 1) * height // 6, (2 * column + 1) * width // 4].mean() for column in (0, 1)]
        for row in range(3)
    ]
    assert middles == [pytest.approx(row, abs=3) for row in ([20, 60], [120, 180], [102, 204])]


def test_masks_are_orange_inside_and_plain_outside(tmp_path):
    predicted = torch.zeros(1, 30, 40)
    predicted[:, :, :20] = 1.0
    truth = torch.zeros(1, 30, 40, dtype=torch.bool)
    truth[:, :, 30:] = True
    sheet = np.asarray(
        Image.open(draw_masks(tmp_path / "m.jpg", grey_views(100), predicted, truth, columns=1))
    )
    red, _, blue = sheet[sheet.shape[0] // 2, sheet.shape[1] // 4].astype(int)
    assert red > blue + 80
    red, _, blue = sheet[sheet.shape[0] // 2, int(sheet.shape[1] * 0.6)].astype(int)
    assert abs(red - blue) < 10
    assert sheet[sheet.shape[0] // 2, int(sheet.shape[1] * 0.75)].min() > 180, (
        "the true mask has a white outline"
    )


def dark_share(path) -> tuple[float, float, float, float]:
    """Share of black pixels in the four quarters: top left, top right, bottom left, bottom right."""
    dark = np.asarray(Image.open(path).convert("L")) < 100
    row, column = dark.shape[0] // 2, dark.shape[1] // 2
    return tuple(
        float(part.mean())
        for half in (dark[:row], dark[row:])
        for part in (half[:, :column], half[:, column:])
    )


def test_low_voxels_show_in_the_left_slices_and_truth_below(tmp_path):
    low, high = torch.zeros(8, 8, 4), torch.zeros(8, 8, 4, dtype=torch.bool)
    low[:, :, 0] = 1.0
    high[:, :, 3] = True
    path = draw_occupancy(tmp_path / "o.png", low, high, height=4.0, slices=4)
    top_left, top_right, bottom_left, bottom_right = dark_share(path)
    assert min(top_left, bottom_right) > 0.2
    assert max(top_right, bottom_left) < 0.1


def test_nothing_of_the_layers_is_cut_at_the_edge(tmp_path):
    path = draw_occupancy(tmp_path / "o.png", torch.ones(40, 40, 8), None, height=3.0)
    image = np.asarray(Image.open(path).convert("L"))
    border = np.concatenate([image[0], image[-1], image[:, 0], image[:, -1]])
    assert border.min() == 255
    # Headings stand above the maps: rows with ink come before the first row that is mostly ink.
    dark = (image < 100).mean(axis=1)
    assert 0 < (dark > 0).argmax() + 8 < (dark > 0.4).argmax()
