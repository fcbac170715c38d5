# SPDX-License-Identifier: Apache-2.0
"""Furniture libraries of Sweet Home 3D: ``.sh3f`` files, zips of OBJ models with a catalogue.

Nothing is unpacked to disk: entries are read by their name in the zip, so a name such as ``../../x`` leads
nowhere, and an entry that claims to be larger than a model can be is not read.
"""

from __future__ import annotations

import math
import posixpath
import re
import zipfile
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from trimesh.resolvers import Resolver

from raytran.errors import DataError

LARGEST_ENTRY = 64 * 2**20
"""Bytes of the largest file inside a library that is read; the largest model of furniture has 9 MB."""

_CATALOGUE = "PluginFurnitureCatalog.properties"
_LICENCE = "LICENSE.TXT"

_MOST_UNPACKED = 100
"""Bytes of an entry for each byte that it is packed into: text of models has some ten."""
_KEY_VALUE = re.compile(r"([^=:\s]+)\s*[=:]\s*(.*)")
_ESCAPE = re.compile(r"\\(u[0-9a-fA-F]{4}|.)")
_SIZES = ("width", "height", "depth")
_PLAUSIBLE_CM = (1.0, 2000.0)


@dataclass(frozen=True)
class Piece:
    """One entry of a catalogue.

    Attributes:
        name: what it is, in English.
        creator: who made the model.
        licence: as the catalogue words it.
        model: name of its OBJ file in the zip.
        size_m: ``(3,)`` width, height and depth, metres.
        rotation: ``(3, 3)`` turn that brings the OBJ upright, its front to +Z.
    """

    name: str
    creator: str
    licence: str
    model: str
    size_m: NDArray[np.float64]
    rotation: NDArray[np.float64]


class FurnitureLibrary:
    """An open ``.sh3f`` file; use it in a ``with`` statement.

    Attributes:
        path: the file.
        name: what the library calls itself, else the file's name.
        pieces: catalogue entries by their id, e.g. ``Scopia#bed1``.
        damaged: ids of entries that cannot be used, with the reason.

    Raises:
        DataError: the file is missing or no furniture library.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            self._zip = zipfile.ZipFile(path)
        except OSError as error:
            raise DataError(f"cannot read the library {path}: {error.strerror}; check the path") from error
        except zipfile.BadZipFile as error:
            raise DataError(f"{path} is no furniture library ({error}); copy the .sh3f again") from error
        self.pieces: dict[str, Piece] = {}
        self.damaged: dict[str, str] = {}
        try:
            self._read_catalogue()
        except DataError:
            self._zip.close()
            raise

    def __enter__(self) -> FurnitureLibrary:
        return self

    def __exit__(self, *error: object) -> None:
        self._zip.close()

    def read(self, name: str) -> bytes:
        """Return the content of an entry of the zip.

        Raises:
            DataError: it is missing, damaged, or too large.
        """
        try:
            entry = self._zip.getinfo(name)
            if entry.file_size > LARGEST_ENTRY:
                raise DataError(
                    f"{name} in {self.path} claims {entry.file_size / 2**20:.0f} MB; "
                    f"more than {LARGEST_ENTRY / 2**20:.0f} MB is no furniture"
                )
            if entry.file_size > _MOST_UNPACKED * entry.compress_size + 2**24:
                raise DataError(f"{name} in {self.path} is packed as no model is: copy the library again")
            return self._zip.read(entry)
        except KeyError as error:
            raise DataError(f"{self.path} has no {name}; copy the library again") from error
        except (OSError, EOFError, ValueError, RuntimeError, NotImplementedError) as error:
            raise DataError(f"{name} in {self.path} cannot be read ({error}); copy it again") from error
        except (zipfile.BadZipFile, zlib.error) as error:
            raise DataError(f"{name} in {self.path} is damaged ({error}); copy the library again") from error

    def checksum(self, name: str) -> int:
        """Return the CRC-32 that the zip lists for an entry, 0 if there is none of that name."""
        return self._zip.getinfo(name).CRC if name in self._zip.NameToInfo else 0

    def licence_text(self) -> str:
        """Return the library's licence file, empty if it has none."""
        if _LICENCE not in self._zip.NameToInfo:
            return ""
        return self.read(_LICENCE).decode("utf-8", errors="replace").replace("\r\n", "\n")

    def files_beside(self, name: str) -> Resolver:
        """Return what ``trimesh`` asks for the materials and textures named in the model ``name``."""
        return _InZip(self, posixpath.dirname(name))

    def _read_catalogue(self) -> None:
        fields: dict[str, dict[str, str]] = {}
        for key, value in _properties(self.read(_CATALOGUE).decode("latin-1")):
            name, _, number = key.partition("#")
            fields.setdefault(number, {})[name] = value
        facts = fields.pop("", {})
        self.name = facts.get("name", self.path.stem)
        for entry in fields.values():
            if "id" not in entry:
                continue
            try:
                self.pieces[entry["id"]] = _piece(entry, facts.get("license", "unknown"))
            except (KeyError, ValueError) as error:
                self.damaged[entry["id"]] = f"its catalogue entry is damaged ({error})"


class _InZip(Resolver):
    """Files of one folder of a library, by names relative to it."""

    def __init__(self, library: FurnitureLibrary, folder: str) -> None:
        self._library, self._folder = library, folder

    def get(self, name: str) -> bytes:
        try:
            return self._library.read(posixpath.normpath(posixpath.join(self._folder, name.strip())))
        except DataError as error:
            # trimesh goes on without a texture whose resolver finds none.
            raise FileNotFoundError(str(error)) from error

    def write(self, name: str, data: Any) -> None:
        raise NotImplementedError("furniture libraries are only read")

    def namespaced(self, namespace: str) -> _InZip:
        return _InZip(self._library, posixpath.join(self._folder, namespace))

    def keys(self) -> tuple[str, ...]:
        return ()


def _properties(text: str) -> Iterator[tuple[str, str]]:
    """Read Java properties: lines ``key=value``, letters beyond Latin-1 escaped."""
    for line in text.splitlines():
        stripped = line.strip()
        match = None if stripped.startswith(("#", "!")) else _KEY_VALUE.fullmatch(stripped)
        if match:
            yield match[1], _ESCAPE.sub(_unescaped, match[2])


def _unescaped(match: re.Match[str]) -> str:
    word = match[1]
    return chr(int(word[1:], 16)) if len(word) == 5 else word


def _piece(entry: dict[str, str], licence: str) -> Piece:
    size = np.array([float(entry[side]) for side in _SIZES])
    low, high = _PLAUSIBLE_CM
    if not all(math.isfinite(side) and low <= side <= high for side in size):
        raise ValueError(f"a side of {size.tolist()} cm is not between {low:g} and {high:g} cm")
    rotation = np.array([float(word) for word in entry.get("modelRotation", "1 0 0 0 1 0 0 0 1").split()])
    rotation = rotation.reshape(3, 3)
    if not np.allclose(rotation @ rotation.T, np.eye(3), atol=0.01):
        raise ValueError("modelRotation is no rotation")
    return Piece(
        name=entry.get("name", entry["id"]),
        creator=entry.get("creator", "unknown"),
        licence=entry.get("license", licence),
        model=entry["model"].lstrip("/"),
        size_m=size / 100,
        rotation=rotation,
    )
