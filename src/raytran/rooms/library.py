# SPDX-License-Identifier: Apache-2.0
"""The CAD models that rooms are furnished from: given ones in ShapeNet's layout, and generated ones."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import asdict, dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from raytran.classes import OTHER, PAPER_CLASSES, SCAN2CAD_CLASS_BY_CATID
from raytran.data.files import write_json
from raytran.data.shapenet.meshes import read_face_colors
from raytran.data.shapenet.models import mesh_path, model_names, read_mesh
from raytran.data.text import read_json_object
from raytran.data.workers import work_on
from raytran.errors import DataError
from raytran.limits import BOX_SIDE, COORDINATE, as_numbers
from raytran.rooms.cad import OTHER_IDS, CadModel, sample_model
from raytran.rooms.kinds import KINDS, KNOWN_CATIDS, draw_size, guess_kind
from raytran.rooms.symmetry import measure_symmetry

MODELS_PER_CATEGORY = 150
"""Models of one synset that are examined; of more, these are chosen by the hashes of their names."""

MOST_FACES = 100_000
"""Models with more triangles are left out: a few of them in a room make every step slow."""

MODELS_PER_CLASS = 100
"""Generated models of one class that the rooms of one split share, as scans share those of Scan2CAD."""

FEW = 5
"""Where a library has fewer models of a kind, generated ones are added up to this number."""

SPLITS = ("train", "val")

_HELD_OUT_SHARE = 0.2
_MIN_EXTENT = 0.003
"""Models of which a side of the box is shorter than this share of its diagonal are left out as flat."""


@dataclass(frozen=True)
class LibraryModel:
    """What a room's layout asks of a CAD model before it is read.

    Attributes:
        catid: ShapeNet's synset.
        model_id: ShapeNet's name of the model.
        category: one of the paper's classes.
        kind: name in ``KINDS``.
        symmetry: as in ``CadModel``; from the model's ``.json``, or measured.
        size_m: real size along the object's axes, metres; from the model's ``.json``, or drawn.
        split: ``train`` or ``val``, of the rooms that may hold it.
    """

    catid: str
    model_id: str
    category: str
    kind: str
    symmetry: int
    size_m: tuple[float, float, float]
    split: str


@dataclass(frozen=True)
class CadLibrary:
    """CAD models for rooms.

    Attributes:
        root: the folder in ShapeNet's layout.
        models: those that can be used, by synset and name.
        left_out: ``catid/id`` of the others that were examined, with the reason.
        digest: of the names of all models in the folder, used or not.
    """

    root: Path
    models: tuple[LibraryModel, ...]
    left_out: dict[str, str]
    digest: str

    def load(self, model: LibraryModel) -> CadModel:
        """Read one of ``models``.

        Raises:
            DataError: its file was changed or lost meanwhile.
        """
        return _load(self.root, model)


def list_models(root: Path) -> list[tuple[str, str]]:
    """Return synset and name of every model below ``root`` whose synset rooms are furnished from.

    Raises:
        DataError: there is none.
    """
    names = [(catid, name) for catid in sorted(KNOWN_CATIDS) for name in model_names(root, catid)]
    if not names:
        raise DataError(
            f"no CAD model of furniture lies in {root}; give a folder of ShapeNetCore, or one made by "
            "prepare dataset=cads"
        )
    return names


def digest_of(names: list[tuple[str, str]]) -> str:
    """Return what ``CadLibrary.digest`` holds."""
    return hashlib.sha256("\n".join("/".join(name) for name in names).encode()).hexdigest()[:16]


def survey(root: Path, *, processes: int = 0, progress: bool = True) -> CadLibrary:
    """Examine the models of a folder: which can be used, how large and how symmetric they are.

    Args:
        root: folder in ShapeNet's layout.
        processes: worker processes, 0 for one per core.
        progress: show a progress bar.

    Raises:
        DataError: there is no model that can be used.
    """
    names = list_models(root)
    chosen = [name for catid in KNOWN_CATIDS for name in _chosen([n for n in names if n[0] == catid])]
    results = dict(
        work_on(chosen, partial(_examine, root), label="CADs", processes=processes, progress=progress)
    )
    ordered = {name: results[name] for name in sorted(chosen)}
    models = tuple(result for result in ordered.values() if isinstance(result, LibraryModel))
    left_out = {"/".join(name): result for name, result in ordered.items() if isinstance(result, str)}
    if not models:
        name, why = next(iter(left_out.items()))
        raise DataError(f"none of the {len(left_out)} CAD models in {root} can be used; {name}: {why}")
    return CadLibrary(root, models, left_out, digest_of(names))


def write_library(library: CadLibrary, path: Path) -> None:
    """Write what ``survey`` found, without the folder's path."""
    counts = Counter(f"{model.split} {model.category}" for model in library.models)
    write_json(
        path,
        {
            "digest": library.digest,
            "counts": dict(sorted(counts.items())),
            "left_out": library.left_out,
            "models": [asdict(model) for model in library.models],
        },
    )


@lru_cache(maxsize=4)
def read_library(path: Path, root: Path) -> CadLibrary:
    """Read what ``write_library`` wrote of the models in ``root``.

    Raises:
        DataError: the file is missing or damaged.
    """
    values = read_json_object(path)
    try:
        models = tuple(
            LibraryModel(
                **model
                | {"size_m": tuple(as_numbers(model["size_m"], (3,), BOX_SIDE, f"size_m in {path}").tolist())}
            )
            for model in values["models"]
        )
        return CadLibrary(root, models, values["left_out"], values["digest"])
    except (KeyError, TypeError) as error:
        raise DataError(
            f"{path} is damaged ({str(error)[:80]}); remove it and give the same command again"
        ) from error


def _chosen(names: list[tuple[str, str]]) -> list[tuple[str, str]]:
    return sorted(names, key=_hash_of)[:MODELS_PER_CATEGORY]


def _hash_of(name: tuple[str, str]) -> int:
    return int.from_bytes(hashlib.sha256("/".join(name).encode()).digest()[:8], "big")


def _examine(root: Path, name: tuple[str, str]) -> tuple[tuple[str, str], LibraryModel | str]:
    """Return a model's name with what is known of it, or with why it cannot be used."""
    try:
        return name, _model(root, *name)
    except DataError as error:
        return name, str(error)


def _model(root: Path, catid: str, model_id: str) -> LibraryModel:
    mesh, path = read_mesh(root, catid, model_id), mesh_path(root, catid, model_id)
    extent, count = np.ptp(mesh.vertices, axis=0), len(mesh.faces)
    if count > MOST_FACES:
        raise DataError(f"{path} has {count:,} triangles, more than {MOST_FACES:,}; simplify it to use it")
    if abs(np.linalg.norm(extent) - 1) > 0.01:
        raise DataError(f"{path} is not normalised: the diagonal of its box is not 1; scale it")
    if extent.min() < _MIN_EXTENT:
        raise DataError(f"{path} is flat; a box needs three sides")
    facts = _facts(path)
    rng = np.random.default_rng(_hash_of((catid, model_id)))
    kind = facts.get("kind")
    if kind not in KINDS or KINDS[kind].catid != catid:
        kind = guess_kind(catid, extent.tolist())
    size = _size_of(facts)
    drawn = draw_size(catid, extent, rng) if size is None else size
    held_out = rng.random() < _HELD_OUT_SHARE
    symmetry = facts.get("symmetry")
    if symmetry not in (0, 1, 2, 4):
        group, colors = read_face_colors(path, count)
        symmetry = measure_symmetry(mesh.vertices, mesh.faces, colors[group])
    return LibraryModel(
        catid=catid,
        model_id=model_id,
        category=SCAN2CAD_CLASS_BY_CATID.get(catid, OTHER),
        kind=kind,
        symmetry=symmetry,
        # One factor takes the normalised model to its real size: its diagonal in metres.
        size_m=tuple((extent / np.linalg.norm(extent) * np.linalg.norm(drawn)).round(6).tolist()),
        split=facts["split"] if facts.get("split") in SPLITS else SPLITS[held_out],
    )


def _facts(path: Path) -> dict[str, Any]:
    """Return a model's ``.json``, empty if it has none that can be read."""
    try:
        return read_json_object(path.with_suffix(".json"))
    except DataError:
        return {}


def _size_of(facts: dict[str, Any]) -> np.ndarray | None:
    """Return the real size in a ``.json`` in metres; None for ShapeNet's, whose unit is not known."""
    if facts.get("unit") != "m":
        return None
    try:
        high, low = (as_numbers(facts.get(key), (3,), COORDINATE, key) for key in ("max", "min"))
        return as_numbers((high - low).tolist(), (3,), BOX_SIDE, "max - min")
    except DataError:
        return None


@lru_cache(maxsize=256)
def _load(root: Path, model: LibraryModel) -> CadModel:
    mesh = read_mesh(root, model.catid, model.model_id)
    group, colors = read_face_colors(mesh_path(root, model.catid, model.model_id), len(mesh.faces))
    return CadModel(
        catid=model.catid,
        model_id=model.model_id,
        category=model.category,
        kind=model.kind,
        vertices=np.asarray(mesh.vertices),
        faces=np.asarray(mesh.faces),
        face_color=colors[group],
        face_group=group,
        symmetry=model.symmetry,
        size_m=np.array(model.size_m),
        support=KINDS[model.kind].support,
        source=root,
    )


@dataclass(frozen=True)
class ModelPool:
    """The CAD models that the rooms of one seed and split draw from.

    Attributes:
        seed: seed of the rooms.
        library: CAD models given; None for generated ones alone.
        split: whose models of the library are drawn, ``train`` or ``val``; None for all.
        numbers: of the generated models of each class.
        mixed: draw as often from the generated models as from the library; else from these only to fill up.
    """

    seed: int
    library: CadLibrary | None = None
    split: str | None = "train"
    numbers: Sequence[int] = range(MODELS_PER_CLASS)
    mixed: bool = False

    def draw(
        self, category: str, rng: np.random.Generator, *, kinds: Collection[str] = ()
    ) -> CadModel | None:
        """Draw a model of a class, of one of ``kinds`` unless these are empty; None if there is none.

        Generated models are drawn where no library is given, or where it has fewer than ``FEW`` that fit.
        """
        if self.library is not None:
            given = [
                model
                for model in self.library.models
                if self.split in (None, model.split)
                and model.category == category
                and (not kinds or model.kind in kinds)
            ]
            generated = category != "other" or not kinds or any(kind in OTHER_IDS for kind in kinds)
            if not (given or generated):
                return None
            filled = 2 * len(given) if self.mixed and generated else max(len(given), FEW if generated else 0)
            number = int(rng.integers(max(filled, 1)))
            if number < len(given):
                return self.library.load(given[number])
        for position in rng.integers(len(self.numbers), size=60):
            model = _generated(self.seed, category, self.numbers[position])
            if not kinds or model.kind in kinds:
                return model
        return None

    def has(self, kind: str) -> bool:
        """Say whether the library, in this split, has a model of a kind."""
        models = () if self.library is None else self.library.models
        return any(model.kind == kind and self.split in (None, model.split) for model in models)


@lru_cache(maxsize=2048)
def _generated(seed: int, category: str, number: int) -> CadModel:
    # Scenes are seeded by two numbers, models by three: the streams never meet.
    return sample_model(category, np.random.default_rng([seed, PAPER_CLASSES.index(category), number]))
