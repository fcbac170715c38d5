# SPDX-License-Identifier: Apache-2.0
"""Imports Sweet Home 3D's furniture libraries as CAD models in the layout of ShapeNetCore v2.

``furniture.csv`` beside this file lists the pieces that are furniture of the nine classes, each checked in
pictures, and the rotation that corrects the one in the catalogue where that is wrong.
"""

from __future__ import annotations

import csv
import hashlib
import io
import logging
from dataclasses import asdict, astuple, dataclass, fields
from functools import partial
from pathlib import Path

import numpy as np

from raytran.data.files import UNFINISHED, sweep, write_text
from raytran.data.workers import work_on
from raytran.errors import DataError, page
from raytran.rooms.cad import CadModel
from raytran.rooms.kinds import KINDS
from raytran.rooms.shapenet_files import write_model
from raytran.rooms.sweethome3d.catalogue import FurnitureLibrary, Piece
from raytran.rooms.sweethome3d.mesh import read_piece
from raytran.rooms.symmetry import measure_symmetry

_log = logging.getLogger(__name__)

_FORMAT = "raytran.furniture/1"
"""Rises when the same library no longer gives the same models."""

HELD_OUT = ("Blend Swap CC-BY", "Kator Legaz catalog")
"""Libraries of which all models, and all models by the same makers, are held out for validation rooms."""

_TABLE = Path(__file__).with_name("furniture.csv")


@dataclass(frozen=True)
class Listed:
    """A row of ``furniture.csv``: what a piece is, and the correction of its rotation about +Y, degrees."""

    piece: str
    category: str
    kind: str
    turn_deg: float


@dataclass(frozen=True)
class Credit:
    """A row of ``credits.csv``: who made a model, and under which licence."""

    model: str
    name: str
    creator: str
    licence: str
    library: str
    piece: str


@dataclass(frozen=True)
class FurnitureReport:
    """What a call of ``import_furniture`` did.

    Attributes:
        root: folder of the models.
        credits: of every model in the folder.
        made: number of models that this call wrote.
        left_out: listed pieces that could not be used, with the reason.
    """

    root: Path
    credits: tuple[Credit, ...]
    made: int
    left_out: dict[str, str]


def read_table() -> dict[str, Listed]:
    """Return the rows of ``furniture.csv`` by the id of their piece."""
    with _TABLE.open(encoding="utf-8", newline="") as file:
        return {
            row["piece"]: Listed(row["piece"], row["category"], row["kind"], float(row["turn_deg"]))
            for row in csv.DictReader(file)
        }


def import_furniture(
    source: Path, output: Path, *, processes: int = 0, progress: bool = True
) -> FurnitureReport:
    """Write the listed furniture of one or several ``.sh3f`` libraries, or go on where a call was killed.

    Each model becomes ``output/<catid>/<id>/models/model_normalized.*``; its ``.json`` also holds ``unit``
    ("m": ``min`` and ``max`` are its real size), ``kind``, ``symmetry``, ``split`` (``train``, or ``val`` for
    the libraries in ``HELD_OUT`` and their makers) and ``source``. ``credits.csv`` and ``LICENCES.txt`` go
    beside the models; whoever passes the models on must pass these on too.

    Args:
        source: a ``.sh3f`` file, or a folder with such files anywhere below it.
        output: folder to write to.
        processes: worker processes, 0 for one per core.
        progress: show a progress bar.

    Raises:
        DataError: ``source`` holds no library, or none of the listed pieces.
    """
    paths = sorted(source.rglob("*.sh3f")) if source.is_dir() else [source]
    if not paths:
        raise DataError(
            f"no furniture library (*.sh3f) lies in {source}; give its folder, see {page('data.md')}"
        )
    output.mkdir(parents=True, exist_ok=True)
    sweep(output, f"{UNFINISHED}*", f"*/*/{UNFINISHED}*")
    table, jobs, licences, left_out = read_table(), [], [], dict[str, str]()
    for path in paths:
        with FurnitureLibrary(path) as library:
            jobs += [(path, library.name, piece) for piece in library.pieces if piece in table]
            left_out |= {piece: why for piece, why in library.damaged.items() if piece in table}
            licences.append(f"{library.name} ({path.name})\n\n{library.licence_text()}")
    if not jobs:
        raise DataError(f"no library in {source} holds listed furniture; give those of Sweet Home 3D")
    write = partial(_write_piece, output, _held_out_makers(paths))
    rows, made = list[Credit](), 0
    for piece, result in work_on(jobs, write, label="furniture", processes=processes, progress=progress):
        if isinstance(result, str):
            left_out[piece] = result
        else:
            rows.append(result[0])
            made += result[1]
    for piece, why in sorted(left_out.items()):
        _log.warning("left out %s: %s", piece, why)
    rows.sort(key=lambda row: row.piece)
    _write_credits(output, rows, licences)
    return FurnitureReport(output, tuple(rows), made, dict(sorted(left_out.items())))


def _held_out_makers(paths: list[Path]) -> frozenset[str]:
    """Return who made the models of the held-out libraries."""
    makers: set[str] = set()
    for path in paths:
        with FurnitureLibrary(path) as library:
            if library.name in HELD_OUT:
                makers |= {piece.creator for piece in library.pieces.values()}
    return frozenset(makers)


def _write_piece(
    output: Path, held_out: frozenset[str], job: tuple[Path, str, str]
) -> tuple[str, tuple[Credit, bool] | str]:
    """Write a piece unless it exists.

    Returns:
        its id, and either its credit with whether it was new, or why it cannot be used.
    """
    path, library_name, piece_id = job
    listed = read_table()[piece_id]
    with FurnitureLibrary(path) as library:
        piece = library.pieces[piece_id]
        model_id = _model_id(library, piece, listed)
        catid = KINDS[listed.kind].catid
        credit = Credit(
            f"{catid}/{model_id}", piece.name, piece.creator, piece.licence, library_name, piece_id
        )
        if (output / catid / model_id / "models").is_dir():
            return piece_id, (credit, False)
        try:
            model = _cad_model(library, piece, listed, model_id)
        except DataError as error:
            return piece_id, str(error)
    extra = {
        "unit": "m",
        "kind": listed.kind,
        "symmetry": model.symmetry,
        "split": "val" if piece.creator in held_out else "train",
        "source": asdict(credit),
    }
    write_model(model, output, extra=extra)
    return piece_id, (credit, True)


def _model_id(library: FurnitureLibrary, piece: Piece, listed: Listed) -> str:
    """Return the id of a model, a digest of its inputs: whether it exists is known without making it."""
    facts = [_FORMAT, *asdict(listed).values(), *piece.size_m, *piece.rotation.ravel()]
    facts.append(library.checksum(piece.model))
    return hashlib.sha256("|".join(str(fact) for fact in facts).encode()).hexdigest()[:32]


def _cad_model(library: FurnitureLibrary, piece: Piece, listed: Listed, model_id: str) -> CadModel:
    mesh, kind = read_piece(library, piece, listed.turn_deg), KINDS[listed.kind]
    size, face_color = np.ptp(mesh.vertices, axis=0), mesh.group_color[mesh.face_group]
    return CadModel(
        catid=kind.catid,
        model_id=model_id,
        category=kind.category,
        kind=listed.kind,
        vertices=(mesh.vertices - mesh.vertices.mean(axis=0)) / np.linalg.norm(size),
        faces=mesh.faces,
        face_color=face_color,
        face_group=mesh.face_group,
        symmetry=measure_symmetry(mesh.vertices, mesh.faces, face_color),
        size_m=size,
        support=kind.support,
    )


def _write_credits(output: Path, rows: list[Credit], licences: list[str]) -> None:
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(field.name for field in fields(Credit))
    writer.writerows(astuple(row) for row in rows)
    write_text(output / "credits.csv", text.getvalue())
    head = (
        "3D models of furniture from libraries of Sweet Home 3D, changed: turned, scaled to one size,\n"
        "welded, textures replaced by their mean colour. credits.csv names who made each.\n"
        "Keep both files with the models. The libraries' own notices follow.\n"
    )
    write_text(output / "LICENCES.txt", "\n\n".join([head, *licences]))
