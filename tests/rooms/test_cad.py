# SPDX-License-Identifier: Apache-2.0
"""Generated CAD models: ShapeNet's frame, true symmetry labels, variety, determinism."""

from __future__ import annotations

from collections import Counter
from functools import cache

import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

from raytran.classes import PAPER_CLASSES
from raytran.errors import ConfigError
from raytran.rooms.cad import RECIPES, CadModel, finish_model, sample_model

EVERY_RECIPE = [(category, recipe) for category, recipes in RECIPES.items() for _, recipe in recipes]
NAMES = [f"{category}-{recipe.__name__}" for category, recipe in EVERY_RECIPE]
SEEDS = range(2)


@cache
def models(index: int) -> list[CadModel]:
    category, recipe = EVERY_RECIPE[index]
    return [finish_model(category, recipe(np.random.default_rng(seed))) for seed in SEEDS]


def turned(model: CadModel, degrees: float) -> np.ndarray:
    cos, sin = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return model.vertices @ np.array([[cos, 0, -sin], [0, 1, 0], [sin, 0, cos]])


def vertex_gap(model: CadModel, degrees: float) -> float:
    """Greatest distance of a turned vertex to the nearest vertex, in box diagonals."""
    return float(cKDTree(model.vertices).query(turned(model, degrees))[0].max())


def surface_gap(model: CadModel, degrees: float) -> float:
    """Greatest distance of a turned vertex to the surface, in box diagonals, good to about 0.01."""
    mesh = trimesh.Trimesh(model.vertices, model.faces, process=False)
    samples, face = trimesh.sample.sample_surface(mesh, 20000, seed=0)
    points = turned(model, degrees)
    nearest = cKDTree(samples).query(points, k=8)[1]
    triangles = mesh.triangles[face[nearest]].reshape(-1, 3, 3)
    repeated = np.repeat(points, 8, axis=0)
    distance = np.linalg.norm(trimesh.triangles.closest_point(triangles, repeated) - repeated, axis=1)
    return float(distance.reshape(-1, 8).min(axis=1).max())


@pytest.mark.parametrize("index", range(len(EVERY_RECIPE)), ids=NAMES)
def test_models_are_in_the_frame_of_shapenet(index: int) -> None:
    for model in models(index):
        extent = np.ptp(model.vertices, axis=0)
        assert np.linalg.norm(extent) == pytest.approx(1.0)
        np.testing.assert_allclose(model.vertices.mean(axis=0), 0.0, atol=1e-12)
        np.testing.assert_allclose(extent * np.linalg.norm(model.size_m), model.size_m)
        assert (model.size_m > 0.1).all()
        assert (model.size_m < 3.0).all()
        assert model.support in {"floor", "wall", "table", "bed"}


@pytest.mark.parametrize("index", range(len(EVERY_RECIPE)), ids=NAMES)
def test_faces_are_sound(index: int) -> None:
    for model in models(index):
        assert 90 <= len(model.faces) <= 3000
        assert model.faces.min() >= 0
        assert model.faces.max() < len(model.vertices)
        assert model.face_color.shape == (len(model.faces), 3)
        assert model.face_color.min() >= 0
        assert model.face_color.max() <= 1
        # Equal group, equal colour; different group, different colour.
        pairs = {
            (group, *color) for group, color in zip(model.face_group, model.face_color.tolist(), strict=True)
        }
        assert len(pairs) == len({pair[0] for pair in pairs}) == len({pair[1:] for pair in pairs})
        edges = np.concatenate([model.faces[:, [0, 1]], model.faces[:, [1, 2]], model.faces[:, [2, 0]]])
        forward = Counter(map(tuple, edges.tolist()))
        assert all(count == forward[b, a] for (a, b), count in forward.items())


@pytest.mark.parametrize("index", range(len(EVERY_RECIPE)), ids=NAMES)
def test_every_part_is_wound_outwards(index: int) -> None:
    _, recipe = EVERY_RECIPE[index]
    for seed in SEEDS:
        for part, _ in recipe(np.random.default_rng(seed)).parts:
            a, b, c = (part.vertices[part.faces] - part.vertices.mean(axis=0)).transpose(1, 0, 2)
            assert np.einsum("fi,fi->", a, np.cross(b, c)) > 0


@pytest.mark.parametrize("index", range(len(EVERY_RECIPE)), ids=NAMES)
def test_claimed_symmetry_holds(index: int) -> None:
    for model in models(index):
        if model.symmetry in (2, 4):
            assert vertex_gap(model, 360 / model.symmetry) < 1e-6
        elif model.symmetry == 0:
            assert vertex_gap(model, 45) < 1e-6
            assert surface_gap(model, 17) < 0.012


@pytest.mark.parametrize("index", range(len(EVERY_RECIPE)), ids=NAMES)
def test_no_higher_symmetry_is_hidden(index: int) -> None:
    for model in models(index)[:2]:
        if model.symmetry != 0:
            assert surface_gap(model, {1: 180, 2: 90, 4: 45}[model.symmetry]) > 0.012


@cache
def draws(category: str) -> list[CadModel]:
    rng = np.random.default_rng(0)
    return [sample_model(category, rng) for _ in range(100)]


def test_kinds_of_the_issue_are_all_drawn() -> None:
    drawn = {
        category: {(model.kind, model.symmetry) for model in draws(category)}
        for category in PAPER_CLASSES.names
    }
    assert drawn["chair"] >= {
        ("dining chair", 1),
        ("armed chair", 1),
        ("office chair", 1),
        ("stool", 0),
        ("stool", 4),
    }
    assert drawn["table"] >= {("dining table", 0), ("dining table", 4), ("dining table", 2), ("desk", 1)}
    assert drawn["bookshelf"] >= {("bookshelf", 1), ("open shelf", 2)}
    assert drawn["cabinet"] >= {("chest of drawers", 1), ("wardrobe", 1), ("night stand", 1)}
    assert drawn["sofa"] == {("sofa", 1), ("corner sofa", 1)}
    assert drawn["display"] >= {("monitor", 1), ("television", 1)}
    assert drawn["trashbin"] >= {("round bin", 0), ("square bin", 4), ("oblong bin", 2)}
    assert drawn["bathtub"] == {("bathtub", 1), ("bathtub", 2)}
    assert {kind for kind, _ in drawn["other"]} >= {"bed", "floor lamp", "table lamp", "printer", "pillow"}


def test_catids_are_those_of_scan2cad() -> None:
    found = {category: {model.catid for model in draws(category)} for category in PAPER_CLASSES.names}
    assert found == {
        "bathtub": {"02808440"},
        "bookshelf": {"02871439"},
        "cabinet": {"02933112"},
        "chair": {"03001627"},
        "display": {"03211117"},
        "sofa": {"04256520"},
        "table": {"04379243"},
        "trashbin": {"02747177"},
        "other": {"02818832", "03636649", "04004475", "03938244"},
    }


@pytest.mark.parametrize("category", PAPER_CLASSES.names)
def test_a_seed_names_one_model(category: str) -> None:
    first, again = (sample_model(category, np.random.default_rng(7)) for _ in range(2))
    other = sample_model(category, np.random.default_rng(8))
    assert first.model_id == again.model_id != other.model_id
    np.testing.assert_array_equal(first.vertices, again.vertices)
    assert len(first.model_id) == 32
    assert set(first.model_id) <= set("0123456789abcdef")


@pytest.mark.parametrize("name", ["four_legged_chair", "office_chair", "armchair", "straight_sofa", "bed"])
def test_backs_are_at_the_back(name: str) -> None:
    index = next(i for i, (_, recipe) in enumerate(EVERY_RECIPE) if recipe.__name__ == name)
    for model in models(index):
        high = model.vertices[:, 1] > model.vertices[:, 1].min() + 0.85 * np.ptp(model.vertices[:, 1])
        middle = (model.vertices[:, 2].min() + model.vertices[:, 2].max()) / 2
        assert (model.vertices[high, 2] > middle).all()


def test_screens_face_the_front() -> None:
    for seed in range(8):
        model = sample_model("display", np.random.default_rng(seed))
        dark = np.isclose(model.face_color, (0.03, 0.03, 0.04)).all(axis=1)
        a, b, c = model.vertices[model.faces[dark]].transpose(1, 0, 2)
        corners = np.concatenate([a, b, c])
        assert corners[:, 2].max() < np.median(model.vertices[:, 2]) + 0.02
        area = np.cross(b - a, c - a) / 2
        facing = area[area[:, 2] < 0, 2].sum()
        whole = np.ptp(model.vertices[:, 0]) * np.ptp(model.vertices[:, 1])
        assert -facing > 0.5 * whole


def test_unknown_class_is_refused() -> None:
    with pytest.raises(ConfigError, match="unknown furniture class 'piano'"):
        sample_model("piano", np.random.default_rng(0))
