# SPDX-License-Identifier: Apache-2.0
"""The building blocks of furniture are closed, wound outwards, and of the size they were asked for."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from raytran.rooms.parametric import parts


def as_mesh(part: parts.Part) -> trimesh.Trimesh:
    return trimesh.Trimesh(part.vertices, part.faces, process=False)


TUBE = parts.tube([(0, 0, 0), (0, 0.5, 0), (0.1, 0.9, 0)], [0.05, 0.04, 0.05])
PARTS = {
    "box": parts.box((1, 2, 3), (0.2, 0.3, 0.4)),
    "cushion": parts.cushion((0, 0, 0), (0.5, 0.2, 0.4)),
    "lathe": parts.lathe([(0.3, 0.0), (0.2, 0.5), (0.3, 1.0)]),
    "vessel": parts.lathe([(0.3, 0.0), (0.3, 1.0), (0.25, 1.0), (0.25, 0.05)]),
    "hoop": parts.lathe([(0.3, 0.0), (0.35, 0.0), (0.35, 0.1), (0.3, 0.1)], closed=True),
    "tube": TUBE,
    "level tube": parts.tube([(-1, 0, 0), (1, 0, 0)], 0.1),
    "deep tube": parts.tube([(0, 0, 1), (0, 0, -1)], 0.1),
    "turned": parts.turned(TUBE, 37.0),
    "tilted": parts.tilted(TUBE, 20.0, (0, 0.5, 0)),
    "mirrored": parts.mirrored(TUBE),
}


@pytest.mark.parametrize("name", PARTS)
def test_parts_are_closed_and_wound_outwards(name: str) -> None:
    mesh = as_mesh(PARTS[name])
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert mesh.volume > 0


def test_box_has_its_extent_place_and_volume() -> None:
    mesh = as_mesh(parts.box((1, 2, 3), (0.2, 0.3, 0.4)))
    np.testing.assert_allclose(mesh.bounds, [[0.9, 1.85, 2.8], [1.1, 2.15, 3.2]])
    assert mesh.volume == pytest.approx(0.024)


def test_cushion_keeps_its_extent_and_loses_its_edges() -> None:
    mesh = as_mesh(parts.cushion((0, 0, 0), (0.5, 0.2, 0.4), corner=0.05, edge=0.03))
    np.testing.assert_allclose(mesh.extents, [0.5, 0.2, 0.4])
    assert 0.9 * 0.04 < mesh.volume < 0.04


def test_lathe_approaches_a_cylinder() -> None:
    mesh = as_mesh(parts.lathe([(0.5, 0.0), (0.5, 2.0)], segments=64))
    # Area of a regular 64-gon of circumradius 0.5 times the height.
    assert mesh.volume == pytest.approx(2.0 * 0.5 * 64 * 0.25 * np.sin(2 * np.pi / 64))


def test_vessel_is_hollow() -> None:
    mesh = as_mesh(parts.stack([parts.rectangle(1, 1)] * 2 + [parts.rectangle(0.8, 0.8)] * 2, [0, 1, 1, 0.1]))
    assert mesh.volume == pytest.approx(1 - 0.64 * 0.9)


def test_tube_along_an_axis_is_a_prism_of_that_length() -> None:
    mesh = as_mesh(parts.tube([(0, 0, -1), (0, 0, 2)], 0.1, segments=4))
    np.testing.assert_allclose(mesh.extents, [0.2, 0.2, 3.0], atol=1e-12)
    assert mesh.volume == pytest.approx(0.02 * 3)


@pytest.mark.parametrize(("degrees", "front"), [(90, (-1, 0, 0)), (180, (0, 0, 1)), (-90, (1, 0, 0))])
def test_turned_is_counter_clockwise_from_above(degrees: float, front: tuple[float, float, float]) -> None:
    part = parts.Part(np.array([[0.0, 0.0, -1.0]]), np.zeros((0, 3), dtype=np.int64))
    np.testing.assert_array_equal(parts.turned(part, degrees).vertices, [front])


def test_tilted_leans_the_top_backwards() -> None:
    part = parts.Part(np.array([[0.0, 2.0, 0.0]]), np.zeros((0, 3), dtype=np.int64))
    np.testing.assert_allclose(parts.tilted(part, 30, (0, 1, 0)).vertices, [[0, 1 + np.sqrt(0.75), 0.5]])


def test_corners_are_symmetric_under_half_a_turn() -> None:
    copies = parts.corners(parts.box((1, 0, 2), (0.1, 0.2, 0.3)))
    centers = {tuple(np.round(copy.vertices.mean(axis=0), 9)) for copy in copies}
    assert centers == {(1, 0, 2), (-1, 0, 2), (1, 0, -2), (-1, 0, -2)}
    assert all(as_mesh(copy).volume > 0 for copy in copies)
