# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest
import trimesh

from raytran.rooms.cad import RECIPES, finish_model
from raytran.rooms.symmetry import measure_symmetry


@pytest.mark.parametrize("category", RECIPES)
def test_generated_furniture_is_measured_as_it_was_designed(category):
    for seed, (_, recipe) in enumerate(RECIPES[category]):
        model = finish_model(category, recipe(np.random.default_rng(seed)))
        assert measure_symmetry(model.vertices, model.faces, model.face_color) == model.symmetry, model.kind


def turned(mesh):
    """Return vertices with the mesh's z axis turned up, and its faces."""
    return mesh.vertices[:, [1, 2, 0]], mesh.faces


@pytest.mark.parametrize(("sides", "expected"), [(3, 1), (4, 4), (5, 1), (6, 2), (8, 4), (64, 0)])
def test_prisms(sides, expected):
    """A regular hexagon is mapped onto itself by 180° but not by 90°; Scan2CAD knows no other turns."""
    vertices, faces = turned(trimesh.creation.cylinder(radius=1.0, height=1.0, sections=sides))
    assert measure_symmetry(vertices, faces) == expected


def test_uneven_triangles_and_doubled_faces_do_not_matter():
    box = trimesh.creation.box(extents=(1.0, 0.5, 1.0))
    fine = trimesh.creation.box(extents=(1.0, 0.5, 1.0)).subdivide().subdivide()
    half = fine.submesh([np.flatnonzero((fine.triangles_center > 0)[:, 0])], append=True)
    both = trimesh.util.concatenate([box, half, half])
    assert measure_symmetry(both.vertices, both.faces) == 4


def test_the_axis_is_the_middle_of_the_box_and_the_unit_is_free():
    mesh = trimesh.creation.box(extents=(2.0, 1.0, 1.0))
    assert measure_symmetry(mesh.vertices * 100 + [500.0, 20.0, -300.0], mesh.faces) == 2


def test_a_part_on_one_side_breaks_it_and_a_knob_does_not():
    top = trimesh.creation.box(extents=(1.0, 0.1, 1.0))
    knob = trimesh.creation.box(extents=(0.03, 0.03, 0.03))
    knob.apply_translation([0.3, 0.06, 0])
    block = trimesh.creation.box(extents=(0.4, 0.4, 0.4))
    block.apply_translation([0.3, 0.2, 0])
    with_knob, with_block = (trimesh.util.concatenate([top, part]) for part in (knob, block))
    assert measure_symmetry(with_knob.vertices, with_knob.faces) == 4
    assert measure_symmetry(with_block.vertices, with_block.faces) == 1


def test_colours_count_and_small_marks_do_not():
    mesh = trimesh.creation.box(extents=(1.0, 0.6, 0.05)).subdivide().subdivide().subdivide()
    color = np.full((len(mesh.faces), 3), 0.8)
    assert measure_symmetry(mesh.vertices, mesh.faces, color) == 2
    screen = mesh.face_normals[:, 2] < -0.9
    assert measure_symmetry(mesh.vertices, mesh.faces, np.where(screen[:, None], 0.1, color)) == 1
    shade = np.where(screen[:, None], 0.75, color)
    assert measure_symmetry(mesh.vertices, mesh.faces, shade) == 2
    color[np.flatnonzero(screen)[0]] = 0.1
    assert measure_symmetry(mesh.vertices, mesh.faces, color) == 2


def test_a_mesh_without_extent_has_none():
    assert measure_symmetry(np.zeros((3, 3)), [[0, 1, 2]]) == 1
