# SPDX-License-Identifier: Apache-2.0
"""Generates CAD models: a class and a random generator give a piece of furniture."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from raytran.errors import ConfigError
from raytran.rooms.kinds import CATID_BY_CLASS
from raytran.rooms.parametric import (
    bathtubs,
    bins,
    cabinets,
    chairs,
    displays,
    others,
    shelves,
    sofas,
    tables,
)
from raytran.rooms.parametric.parts import Design

Recipe = Callable[[np.random.Generator], Design]

RECIPES: dict[str, tuple[tuple[float, Recipe], ...]] = {
    "bathtub": ((0.6, bathtubs.built_in_bathtub), (0.4, bathtubs.oval_bathtub)),
    "bookshelf": (
        (0.45, shelves.bookcase),
        (0.20, shelves.open_rack),
        (0.15, shelves.cube_shelf),
        (0.10, shelves.step_shelf),
        (0.10, shelves.ladder_shelf),
    ),
    "cabinet": (
        (0.28, cabinets.chest_of_drawers),
        (0.20, cabinets.wardrobe),
        (0.20, cabinets.sideboard),
        (0.16, cabinets.night_stand),
        (0.16, cabinets.tv_cabinet),
    ),
    "chair": (
        (0.34, chairs.four_legged_chair),
        (0.10, chairs.cantilever_chair),
        (0.28, chairs.office_chair),
        (0.12, chairs.armchair),
        (0.06, chairs.pedestal_stool),
        (0.06, chairs.legged_stool),
        (0.04, chairs.pouffe),
    ),
    "display": ((0.55, displays.monitor), (0.35, displays.television), (0.10, displays.tube_television)),
    "sofa": ((0.65, sofas.straight_sofa), (0.35, sofas.corner_sofa)),
    "table": (
        (0.20, tables.round_table),
        (0.15, tables.square_table),
        (0.20, tables.dining_table),
        (0.15, tables.coffee_table),
        (0.20, tables.drawer_desk),
        (0.10, tables.corner_desk),
    ),
    "trashbin": (
        (0.30, bins.round_bin),
        (0.12, bins.dome_bin),
        (0.30, bins.angular_bin),
        (0.18, bins.pedal_bin),
        (0.10, bins.wheeled_bin),
    ),
    "other": (
        (0.30, others.bed),
        (0.15, others.pillow),
        (0.14, others.floor_lamp),
        (0.06, others.arc_lamp),
        (0.13, others.table_lamp),
        (0.06, others.desk_lamp),
        (0.11, others.printer),
        (0.05, others.copier),
    ),
}
"""The generators of each class, each with its probability."""

OTHER_IDS: dict[str, str] = {
    "bed": "02818832",
    "floor lamp": "03636649",
    "table lamp": "03636649",
    "printer": "04004475",
    "copier": "04004475",
    "pillow": "03938244",
}
"""ShapeNet's synset of every kind in the class ``other``."""

CLUTTER = "clutter"
"""Category of models that are of no class: they are seen but not annotated, and are never written."""


@dataclass(frozen=True)
class CadModel:
    """A CAD model in the frame of ShapeNetCore v2: +Y up, front -Z, box diagonal 1, origin the mean vertex.

    Attributes:
        catid: ShapeNet's synset.
        model_id: 32 hexadecimal digits that name the geometry and colours.
        category: one of the paper's classes, or ``CLUTTER``.
        kind: kind of furniture, e.g. ``office chair``.
        vertices: ``(V, 3)`` float64.
        faces: ``(F, 3)`` int64, wound outwards; several closed parts that may overlap.
        face_color: ``(F, 3)`` RGB in [0, 1].
        face_group: ``(F,)`` int64 material index, one per colour.
        symmetry: number of equal rotations about the +Y axis through the origin that map the model onto
            itself: 1, 2, 4, or 0 for a body of revolution.
        size_m: ``(3,)`` real size along the object's axes, metres; one factor scales ``vertices`` to it.
        support: where it stands: ``floor``, ``wall`` (on the floor, its back +Z to a wall), ``table`` (on a
            table, desk or low cabinet) or ``bed`` (on a bed or sofa).
        source: folder in ShapeNet's layout that it was read from; None for a generated model.
    """

    catid: str
    model_id: str
    category: str
    kind: str
    vertices: NDArray[np.float64]
    faces: NDArray[np.int64]
    face_color: NDArray[np.float64]
    face_group: NDArray[np.int64]
    symmetry: int
    size_m: NDArray[np.float64]
    support: str
    source: Path | None = None


def sample_model(category: str, rng: np.random.Generator) -> CadModel:
    """Draw a model of a class; the same state of ``rng`` gives the same model.

    Raises:
        ConfigError: there is no such class.
    """
    if category not in RECIPES:
        raise ConfigError(f"unknown furniture class {category!r}; use one of {', '.join(RECIPES)}")
    weights, recipes = zip(*RECIPES[category], strict=True)
    share = np.array(weights) / sum(weights)
    design = recipes[int(rng.choice(len(recipes), p=share))](rng)
    return finish_model(category, design)


def finish_model(category: str, design: Design) -> CadModel:
    """Join the parts of a design and bring them into ShapeNet's normalised frame."""
    vertices, faces = _join(design)
    colors = sorted({part.color for part in design.parts})
    counts = [len(part.part.faces) for part in design.parts]
    group = np.repeat([colors.index(part.color) for part in design.parts], counts).astype(np.int64)
    size = np.ptp(vertices, axis=0)
    normalised = (vertices - vertices.mean(axis=0)) / np.linalg.norm(size)
    face_color = np.array(colors, dtype=np.float64)[group]
    digest = hashlib.sha256(
        np.round(vertices, 6).tobytes() + faces.tobytes() + np.round(face_color, 4).tobytes()
    )
    return CadModel(
        catid=OTHER_IDS[design.kind] if category == "other" else CATID_BY_CLASS.get(category, ""),
        model_id=digest.hexdigest()[:32],
        category=category,
        kind=design.kind,
        vertices=normalised,
        faces=faces,
        face_color=face_color,
        face_group=group,
        symmetry=design.symmetry,
        size_m=size,
        support=design.support,
    )


def _join(design: Design) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Concatenate all parts into one mesh, in metres."""
    parts = [colored.part for colored in design.parts]
    starts = np.cumsum([0, *(len(part.vertices) for part in parts[:-1])])
    vertices = np.concatenate([part.vertices for part in parts])
    faces = np.concatenate([part.faces + start for part, start in zip(parts, starts, strict=True)])
    return vertices, faces.astype(np.int64)
