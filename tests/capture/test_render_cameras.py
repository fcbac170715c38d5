# SPDX-License-Identifier: Apache-2.0
"""Lists of cameras: both forms, and one sentence for each mistake."""

from __future__ import annotations

import json
import math
import re

import numpy as np
import pytest
import torch

from raytran.capture.render_cameras import MAX_CAMERAS, read_render_cameras
from raytran.errors import DataError

POSE = [[1, 0, 0, 0.5], [0, 0, 1, -2.0], [0, -1, 0, 1.4], [0, 0, 0, 1]]
VIEW = {"name": "door", "world_from_camera": POSE}
SHARED = {"image_size": [480, 640], "intrinsics": [500, 510, 320, 240]}


@pytest.fixture
def write(tmp_path):
    def write_list(content):
        path = tmp_path / "cameras.json"
        path.write_text(content if isinstance(content, str) else json.dumps(content))
        return path

    return write_list


def test_what_views_share_stands_once_and_a_view_may_differ(write):
    other = {"world_from_camera": np.ravel(POSE).tolist(), "image_size": [100, 200]}
    other["intrinsics"] = [[150, 0, 101], [0, 160, 49], [0, 0, 1]]
    found = read_render_cameras(write({**SHARED, "views": [VIEW, other]}))
    assert found.names == ("door", "001")
    assert [lens.size for lens in found.lenses] == [(480, 640), (100, 200)]
    assert torch.equal(found.world_from_camera, torch.tensor([POSE, POSE], dtype=torch.float64))
    cameras = found.scaled_to((120, 160))
    assert cameras.image_size == (120, 160)
    torch.testing.assert_close(
        cameras.intrinsics[0], torch.tensor([[125.0, 0, 80], [0, 127.5, 60], [0, 0, 1]])
    )
    torch.testing.assert_close(
        cameras.intrinsics[1], torch.tensor([[120, 0, 80.8], [0, 192, 58.8], [0, 0, 1.0]])
    )


def test_nerfstudios_list_comes_in_opencv_axes(write):
    opengl = np.array(POSE, dtype=float)
    opengl[:3, 1:3] *= -1
    frame = {"file_path": "images/1.jpg", "transform_matrix": opengl.tolist()}
    lens = {"w": 640, "h": 480, "fl_x": 500, "fl_y": 510, "cx": 320, "cy": 240, "k1": 0.1}
    found = read_render_cameras(write({**lens, "frames": [frame, {**frame, "fl_x": 400}]}))
    assert found.names == ("000", "001")
    assert [one.focal for one in found.lenses] == [(500, 510), (400, 510)]
    assert all(one.is_pinhole for one in found.lenses)
    torch.testing.assert_close(found.world_from_camera[0], torch.tensor(POSE, dtype=torch.float64))
    moved = opengl.copy()
    moved[:3] = moved[[1, 0, 2]]
    moved[2, :] *= -1
    applied = [[0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0]]
    undone = read_render_cameras(
        write({**lens, "applied_transform": applied, "frames": [{"transform_matrix": moved.tolist()}]})
    )
    torch.testing.assert_close(undone.world_from_camera[0], torch.tensor(POSE, dtype=torch.float64))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{", "is no valid JSON"),
        ([], "not a JSON object"),
        ({}, "has neither views nor frames: write cameras as"),
        ({"views": []}, "lists no cameras under views"),
        ({"views": [3]}, "lists no cameras under views"),
        ({"frames": {}}, "lists no cameras under frames"),
        (
            {**SHARED, "views": [VIEW] * (MAX_CAMERAS + 1)},
            f"lists {MAX_CAMERAS + 1} cameras, at most {MAX_CAMERAS}",
        ),
        ({"views": [VIEW]}, r"views\[0\] of .*cameras\.json has no image_size: write \[height, width\]"),
        ({**SHARED, "image_size": [480], "views": [VIEW]}, "has no image_size"),
        ({**SHARED, "image_size": [480, 100_000], "views": [VIEW]}, "8192 pixels a side"),
        ({**SHARED, "image_size": [0, 640], "views": [VIEW]}, "8192 pixels a side"),
        ({"image_size": [480, 640], "views": [VIEW]}, r"has no intrinsics: write \[fx, fy, cx, cy\]"),
        ({**SHARED, "intrinsics": [1, 2], "views": [VIEW]}, "has intrinsics of 2 numbers"),
        ({**SHARED, "intrinsics": "wide", "views": [VIEW]}, "has no intrinsics"),
        ({**SHARED, "intrinsics": [-500, 500, 320, 240], "views": [VIEW]}, "no positive, finite focal"),
        ({**SHARED, "intrinsics": [math.nan, 500, 320, 240], "views": [VIEW]}, "no positive, finite focal"),
        ({**SHARED, "intrinsics": [[500, 3, 320], [0, 500, 240], [0, 0, 1]], "views": [VIEW]}, "mend them"),
        ({**SHARED, "views": [{"name": "a"}]}, "has no world_from_camera where numbers are needed"),
        ({**SHARED, "views": [{"world_from_camera": [[1, 2], [3, 4]]}]}, "does not hold 4x4 numbers"),
        ({**SHARED, "views": [{"world_from_camera": np.zeros((4, 4)).tolist()}]}, "no rotation and place"),
        ({**SHARED, "views": [VIEW, {**VIEW, "name": "DOOR"}]}, r"has the name of views\[0\]"),
        ({**SHARED, "image_size": [10**400, 64], "views": [VIEW]}, "has no image_size"),
        ({**SHARED, "views": [{**VIEW, "name": "../door"}]}, "no file name"),
        ({**SHARED, "views": [{**VIEW, "name": ".."}]}, "no file name"),
        ({**SHARED, "views": [{**VIEW, "name": 7}]}, "no file name"),
        ({"w": 64, "h": 48, "fl_x": 50, "frames": [{}]}, "has no transform_matrix"),
        ({"frames": [{"transform_matrix": POSE}]}, "has no h where a number is needed"),
        (
            {"w": 64, "h": 48, "fl_x": 50, "is_fisheye": True, "frames": [{"transform_matrix": POSE}]},
            "fisheye",
        ),
    ],
)
def test_each_mistake_is_one_sentence(content, message, write):
    with pytest.raises(DataError, match=message) as refused:
        read_render_cameras(write(content))
    assert "\n" not in str(refused.value)


def test_the_lists_that_are_shown_can_be_read(project_root, write):
    shown = re.findall(r"```json\n(.*?)```", (project_root / "docs" / "novel-view.md").read_text(), re.DOTALL)
    first, second = (read_render_cameras(write(block)) for block in shown)
    assert first.names == ("door", "001")
    assert [lens.size for lens in first.lenses] == [(480, 640), (600, 600)]
    # The same camera in both forms.
    torch.testing.assert_close(first.world_from_camera[0], second.world_from_camera[0])
    assert first.lenses[0] == second.lenses[0]


def test_a_missing_list(tmp_path):
    with pytest.raises(DataError, match="check the path"):
        read_render_cameras(tmp_path / "none.json")
