# SPDX-License-Identifier: Apache-2.0
"""Unit, up and volume."""

from __future__ import annotations

import numpy as np
import pytest

from raytran.capture.doctor.world import check_unit, check_up, check_volume, turn_to_z

DISTANCES = np.random.default_rng(0).uniform(1, 4, 200)


@pytest.mark.parametrize(
    ("factor", "cause", "metres"),
    [(100, "positions in centimetres", 0.01), (1000, "positions in millimetres", 0.001)],
)
@pytest.mark.parametrize("with_maps", [False, True])
def test_other_units_are_named(factor, cause, metres, with_maps):
    measured = np.where(np.arange(200) % 3 > 0, DISTANCES * 1.1, np.nan) if with_maps else None
    scale, finding = check_unit(DISTANCES * factor, measured)
    assert scale == metres
    assert (finding.state, finding.cause) == ("fault", cause)
    assert finding.confidence == ("certain" if with_maps else "likely")
    assert f"{metres}" in finding.fix


def test_feet_need_depth_maps():
    assert check_unit(DISTANCES * 3.2808, None)[1].state == "ok"
    scale, finding = check_unit(DISTANCES * 3.2808, DISTANCES)
    assert finding.cause == "positions in feet"
    assert scale == 0.3048


def test_a_scale_that_no_unit_explains_is_guessed_from_the_size_of_rooms():
    scale, finding = check_unit(DISTANCES * 1e9, None)
    assert finding.cause == "positions in no known unit"
    assert 1 < np.median(DISTANCES) * 1e9 * scale < 5


def test_an_arbitrary_scale_is_measured():
    scale, finding = check_unit(DISTANCES * 1.7, DISTANCES)
    assert finding.cause == "positions in no known unit"
    assert scale == pytest.approx(1 / 1.7)


def test_metres_are_right_and_few_points_tell_nothing():
    assert check_unit(DISTANCES, None) == (1.0, check_unit(DISTANCES, None)[1])
    assert check_unit(DISTANCES, None)[1].state == "ok"
    assert check_unit(DISTANCES, DISTANCES * 1.15)[1].state == "ok"
    assert check_unit(DISTANCES[:10] * 1000, None)[1].state == "unknown"


AXES = {"+y": (0, 1, 0), "-y": (0, -1, 0), "+x": (1, 0, 0), "-x": (-1, 0, 0), "-z": (0, 0, -1)}


@pytest.mark.parametrize("name", AXES)
def test_another_up_is_named_and_mended(walk, name):
    turn = turn_to_z(np.array(AXES[name], dtype=float))
    np.testing.assert_allclose(turn @ AXES[name], [0, 0, 1], atol=1e-12)
    assert np.linalg.det(turn) == pytest.approx(1)
    lying = walk[0].copy()
    lying[:, :3] = turn.T @ lying[:, :3]
    found, finding = check_up(lying)
    np.testing.assert_array_equal(found, turn)
    assert (finding.state, finding.cause, finding.confidence) == ("fault", f"wrong up ({name})", "certain")
    assert str(turn.astype(int).tolist()) in finding.fix


def test_a_level_walk_is_right_and_a_leaning_one_is_noted(walk):
    assert check_up(walk[0])[1].state == "ok"
    lean = np.radians(20)
    turn = np.array([[1, 0, 0], [0, np.cos(lean), -np.sin(lean)], [0, np.sin(lean), np.cos(lean)]])
    leaning = walk[0].copy()
    leaning[:, :3] = turn @ leaning[:, :3]
    turn, finding = check_up(leaning)
    assert turn is None
    assert finding.state == "note"
    assert "20°" in finding.text


def test_one_way_of_looking_tells_up_by_the_tops_of_the_images(walk):
    still = np.tile(walk[0][:1], (5, 1, 1))
    turn, finding = check_up(still)
    assert turn is None
    assert finding.state == "ok"
    still[:, :3] = np.diag([1.0, -1.0, -1.0]) @ still[:, :3]
    assert check_up(still)[1].confidence == "likely"
    down = np.radians(40)
    pitch = np.array([[1, 0, 0], [0, np.cos(down), np.sin(down)], [0, -np.sin(down), np.cos(down)]])
    looks_down = np.tile(walk[0][:1], (5, 1, 1))
    looks_down[:, :3, :3] = looks_down[:, :3, :3] @ pitch
    assert check_up(looks_down)[1].state == "ok"


def test_a_world_that_leans_far_is_levelled(walk):
    lean = np.radians(60)
    turn = np.array([[1, 0, 0], [0, np.cos(lean), -np.sin(lean)], [0, np.sin(lean), np.cos(lean)]])
    leaning = walk[0].copy()
    leaning[:, :3] = turn @ leaning[:, :3]
    found, finding = check_up(leaning)
    assert finding.cause == "world not level"
    np.testing.assert_allclose(found, turn.T, atol=0.05)
    assert str(found.round(4).tolist()) in finding.fix


def test_the_volume_holds_a_room_but_not_a_hall():
    corners = np.stack(np.meshgrid([-1.0, 1.0], [-1.0, 1.0], [0.0]), axis=-1).reshape(-1, 3)
    extent = (9.0, 9.0, 3.5)
    nothing = np.zeros((0, 3))
    assert check_volume(corners, nothing, extent).state == "ok"
    assert check_volume(corners * 6, nothing, extent).cause == "cameras outside the volume"
    few = np.concatenate([np.zeros((20, 3)), [[5.0, 0, 0]]])
    finding = check_volume(few, nothing, extent)
    assert finding.state == "note"
    assert finding.text.startswith("1 of 21 cameras")
    boxes = np.array([[0.0, 0, 0], [20, 0, 0], [30, 0, 0]])
    assert check_volume(corners, boxes, extent).cause == "objects outside the volume"
    assert check_volume(corners, boxes[:2], extent).state == "note"
