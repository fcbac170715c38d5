# SPDX-License-Identifier: Apache-2.0
"""The data doctor's page."""

from __future__ import annotations

import base64
import re
from dataclasses import replace
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from raytran.capture.doctor.depth import SurfacePoints
from raytran.capture.doctor.examine import Examination
from raytran.capture.doctor.finding import Correction, Finding
from raytran.capture.doctor.report import camera_reading, draw_frames, frames_to_show, write_doctor_page
from raytran.capture.frames import RawScan
from raytran.data.scannet.scan import read_scan
from raytran.geometry.rotation import rotation_from_yaw
from raytran.structs import ObjectSet

EXTENT = (9.0, 9.0, 3.5)
GREY = 70


@pytest.fixture
def examination(tmp_path):
    """Five grey frames along x that look along +y at one box and a floor one metre below."""
    folder = tmp_path / "scene0000_00"
    for part in ("color", "pose", "intrinsic"):
        (folder / part).mkdir(parents=True)
    for n in range(5):
        Image.new("RGB", (160, 120), (GREY, GREY, GREY)).save(folder / "color" / f"{n}.jpg")
        pose = np.array([[1.0, 0, 0, 0.1 * n], [0, 0, 1, 0], [0, -1, 0, 1], [0, 0, 0, 1]])
        np.savetxt(folder / "pose" / f"{n}.txt", pose)
    np.savetxt(
        folder / "intrinsic" / "intrinsic_color.txt",
        np.array([[120.0, 0, 80, 0], [0, 120, 60, 0], *np.eye(4)[2:]]),
    )
    raw = RawScan.of(read_scan(folder))
    rng = np.random.default_rng(0)
    ends = np.c_[rng.uniform(-2, 2, 100), rng.uniform(1, 4, 100), np.zeros(100)]
    way = (ends - raw.stored[0, :3, 3]) @ raw.stored[0, :3, :3]
    objects = replace(
        ObjectSet.empty(),
        label=torch.tensor([3]),
        center=torch.tensor([[0.2, 2.5, 0.5]]),
        size=torch.tensor([[0.6, 1.0, 0.6]]),
        rotation=rotation_from_yaw(torch.tensor([0.4])),
        symmetry=torch.tensor([1]),
        score=torch.ones(1),
    )
    return Examination(
        scene_id="scene0000_00",
        path=folder,
        findings=(Finding("camera axes", "ok", "all is well & good"),),
        raw=raw,
        surface=SurfacePoints(np.zeros(100, dtype=np.int64), way / way[:, 2:], way[:, 2], "a test"),
        objects=objects,
        num_matches=123,
    )


@pytest.fixture
def faulty(examination):
    fault = Finding("unit", "fault", "far <away>", "positions in centimetres", "multiply it", "certain")
    return replace(examination, scene_id="scene0001_00", findings=(fault,), correction=Correction(scale=0.01))


def pictures(html):
    found = re.findall(r'src="data:image/(png|jpeg);base64,([^"]+)"', html)
    return [Image.open(BytesIO(base64.b64decode(content))) for _, content in found]


def write(tmp_path, examinations, num_found=None):
    path = tmp_path / "page" / "doctor.html"
    found = len(examinations) if num_found is None else num_found
    write_doctor_page(path, examinations, checked=tmp_path, num_found=found, grid_extent=EXTENT)
    return path.read_text(encoding="utf-8")


def test_the_page_needs_no_other_file_and_shows_a_plan_and_three_frames(tmp_path, examination):
    html = write(tmp_path, [examination])
    assert len(pictures(html)) == 4
    assert not re.search(r'(src|href)="(?!data:|#)', html)
    assert "nothing to mend was found" in html
    assert "all is well &amp; good" in html
    assert [path.name for path in (tmp_path / "page").iterdir()] == ["doctor.html"]


def test_a_fault_comes_first_with_its_advice_and_pictures_of_both_readings(tmp_path, examination, faulty):
    html = write(tmp_path, [examination, faulty])
    assert html.index('id="scene0001_00"') < html.index('id="scene0000_00"')
    assert "positions in centimetres" in html
    assert "multiply it" in html
    assert "far &lt;away&gt;" in html
    assert len(pictures(html)) == 3 * 4
    assert "With the changes above" in html
    assert "1 has something to mend" in html


def test_only_some_scans_have_pictures(tmp_path, faulty, monkeypatch):
    monkeypatch.setattr("raytran.capture.doctor.report._MAX_PICTURED", 2)
    many = [replace(faulty, scene_id=f"scene{n:04d}_00", correction=Correction()) for n in range(14)]
    html = write(tmp_path, many, num_found=900)
    assert len(pictures(html)) == 2 * 4
    assert html.count('<section class="scan"') == 14
    assert "900" in html


def test_a_scan_that_cannot_be_opened_is_listed(tmp_path):
    fault = Finding("files", "fault", "no folder color", "cannot be read", "", "certain")
    html = write(tmp_path, [Examination("scene0009_00", Path("gone"), (fault,))])
    assert "cannot be read" in html
    assert pictures(html) == []


def test_frames_show_the_floor_and_the_box(examination):
    seen = camera_reading(examination, examination.raw, corrected=False)
    content = draw_frames(examination, examination.raw, seen, [0])[0]
    picture = np.asarray(Image.open(BytesIO(content)).convert("RGB")).astype(int)
    assert picture.shape == (360, 480, 3)
    # The floor lies one metre below the camera: nothing of it is above the horizon, its net is below.
    horizon = 180
    plain = np.full(3, GREY)
    left = picture[:, :60]
    assert np.abs(left[: horizon - 10] - plain).max() < 12
    assert np.abs(left[horizon + 40 :] - plain).max() > 40
    # The box, class blue, is around (0.2, 2.5): a little right of the middle.
    middle = picture[160:300, 240:330]
    assert (middle[..., 2] - middle[..., 0]).max() > 60


def test_the_telling_frames_are_those_that_see_boxes(examination):
    seen = camera_reading(examination, examination.raw, corrected=False)
    assert frames_to_show(examination, seen, (120, 160), 3) == [0, 2, 4]
    away = seen.world_from_camera.copy()
    away[[0, 2, 3], :3, :3] = away[0, :3, :3] @ np.diag([-1.0, 1, -1])
    turned = replace(seen, world_from_camera=away)
    assert frames_to_show(examination, turned, (120, 160), 2) == [1, 4]


def test_corrected_cameras_see_points_in_metres(faulty):
    stored = camera_reading(faulty, faulty.raw, corrected=False)
    right = camera_reading(faulty, faulty.raw, corrected=True)
    np.testing.assert_allclose(right.world_from_camera[:, :3, 3], stored.world_from_camera[:, :3, 3] / 100)
    distance = [np.linalg.norm(s.points - s.world_from_camera[0, :3, 3], axis=1) for s in (stored, right)]
    np.testing.assert_allclose(distance[0], 100 * distance[1])
