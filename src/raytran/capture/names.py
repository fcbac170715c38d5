# SPDX-License-Identifier: Apache-2.0
"""Names and places: which files of a folder are images, which of them a list means, what frames are called.

Lists of images come from other machines: from Windows with its backslashes, from a Mac that spells ``ü`` with
two characters, with the folders of who made them, or from before the images were converted. An image that is
not there under its exact name is sought under these other spellings, below the folder and nowhere else.
"""

from __future__ import annotations

import logging
import os
import posixpath
import re
import unicodedata
from collections import defaultdict
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath

from raytran.data.images import IMAGE_ENDINGS
from raytran.data.scan import NO_POSE, numbers_first
from raytran.errors import DataError

_log = logging.getLogger(__name__)

IMAGE_FOLDERS = ("images", "input", "rgb", "color", "image", "frames")
"""Folders of colour images that programs leave out of the names in their lists."""

UNNAMED = "no image is named"
UNCLEAR = "which image is meant is unclear"
"""Reasons why a frame is dropped, beside those of ``raytran.data.scan``."""

_OUTSIDE = "image is outside of the scene"

_FOREIGN_ENDINGS = (".dng", ".exr", ".ppm", ".gif")
"""Endings of images that people convert to one of ``IMAGE_ENDINGS``, which keeps the rest of the name."""

_MAX_FOLDERS = 1000
_MAX_DEPTH = 4
"""Bounds of the search for a folder of images below a scene."""

_MAX_NAME = 120
"""Characters of a frame's name: file systems end names at 255 bytes."""

_Key = tuple[str, ...]
"""Folded parts of a path."""


def is_hidden(name: str) -> bool:
    """Whether a file is none of the user's, as ``._0.jpg`` of macOS and ``__MACOSX`` of its zips."""
    return name.startswith(".") or name == "__MACOSX"


def images_in(folder: Path) -> list[Path]:
    """Return the images in a folder, in the order of the numbers in their names; hidden files are none.

    Raises:
        DataError: it cannot be read.
    """
    try:
        names = [name for name in os.listdir(folder) if _ending(name) in IMAGE_ENDINGS]
    except OSError as error:
        raise DataError(f"cannot read the folder {folder} ({error.strerror}): check the path") from error
    visible = [name for name in names if not is_hidden(name)]
    return [folder / name for name in sorted(visible, key=numbers_first)]


def frame_name(image: str) -> str:
    """Return the name of a frame from its image's path in a folder, without ``images/`` and ending.

    Folders are joined by an underscore, so that it may serve as a file name.
    """
    path = PurePosixPath(image)
    stem = str(path.with_name(_stem(path.name))) if path.name else image
    joined = stem.removeprefix("images/").replace("/", "_")
    return "".join(letter if letter.isprintable() else "_" for letter in joined)[-_MAX_NAME:]


def unlike(names: Sequence[str], taken: Collection[str] = ()) -> list[str]:
    """Return names of which no two are the same file on any file system: later ones get a number.

    Args:
        names: what ``frame_name`` makes of ``left/1_0.jpg`` and of ``left_1/0.jpg`` is the same.
        taken: names that none may have.
    """
    used = {_folded(name) for name in taken}
    first = {_folded(name) for name in names}
    result = []
    for name in names:
        number, other = 1, name
        while _folded(other) in used or (number > 1 and _folded(other) in first):
            number += 1
            other = f"{name}-{number}"
        used.add(_folded(other))
        result.append(other)
    return result


def unposed_images(images: Collection[Path], root: Path, taken: Collection[str]) -> dict[str, str]:
    """Return the images in the folders of some images that are none of these, with the reason.

    Args:
        images: that have a pose, below ``root``.
        root: folder from which frames are named.
        taken: names of the frames.
    """
    folders = sorted({image.parent for image in images})
    known = set(images)
    others = [
        path for folder in folders if os.path.isdir(folder) for path in images_in(folder) if path not in known
    ]
    names = [frame_name(path.relative_to(os.path.abspath(root)).as_posix()) for path in others]
    return dict.fromkeys(unlike(names, taken), NO_POSE)


def path_inside(folder: Path, name: str, listed_in: Path) -> Path:
    """Return the path of a file that a list names.

    Raises:
        DataError: the name leads out of the folder; a list from a stranger must not have files read that
            lie elsewhere.
    """
    root = os.path.abspath(folder)
    path = os.path.abspath(os.path.join(root, name)) if "\0" not in name else ""
    if not path.startswith(root + os.sep):
        raise DataError(
            f"{listed_in} names the image {name[-100:]!r}, which is outside {folder}: "
            "move the images there and write relative paths"
        )
    return Path(path)


@dataclass(frozen=True)
class Located:
    """Where the images of a list are.

    Attributes:
        names: as listed.
        places: of each name its path, where the image is or would have to be; or the reason why it has none.
        respelled: names and the images that were found for them under other spellings.
    """

    names: tuple[str, ...]
    places: tuple[Path | str, ...]
    respelled: dict[str, Path] = field(default_factory=dict)

    @property
    def num_found(self) -> int:
        """How many names have an image."""
        return sum(isinstance(place, Path) and os.path.isfile(place) for place in self.places)

    def report(self, listed_in: Path, root: Path) -> None:
        """Say how many images were found under other spellings.

        Raises:
            DataError: a name leads out of the folder, and no image below it can be meant.
        """
        if _OUTSIDE in self.places:
            path_inside(root, self.names[self.places.index(_OUTSIDE)], listed_in)
        if self.respelled:
            name, path = next(iter(self.respelled.items()))
            _log.info(
                "%s: %d images were found under other spellings than it gives, e.g. %s for %s",
                *(listed_in, len(self.respelled), Path(*path.parts[-2:]), name[-100:]),
            )


def locate(names: Sequence[str], root: Path) -> Located:
    r"""Find the images that a list names below a folder.

    One that is not there under its exact name is sought, in this order, with a backslash read as a slash,
    upper and lower case and the forms of Unicode taken for equal, another image ending or none; and if its
    folder is not there, in the one folder that agrees with the end of its path, as the whole of ``images``
    does with ``C:\Users\me\walk\images``. Where two images could be meant, or two names mean one image,
    none is taken.

    Args:
        names: as listed.
        root: the folder.
    """
    search = _Search(Path(os.path.abspath(root)))
    places: list[Path | str] = [search.exact(name) for name in names]
    missing = [
        i for i, place in enumerate(places) if not isinstance(place, Path) or not os.path.isfile(place)
    ]
    for i in missing:
        places[i] = search.in_place(names[i]) or places[i]
    astray = [i for i in missing if not search.is_there(places[i])]
    # A folder whose images the list names as they are is no other one by another name.
    settled = {place.parent for place in places if isinstance(place, Path) and search.is_there(place)}
    moved = search.in_moved_folders([names[i] for i in astray], settled)
    for i, found in zip(astray, moved, strict=True):
        places[i] = found or places[i]
    # Two names for one image: whichever is wrong, none of them is certain, unless one is exact.
    unsure = frozenset(missing)
    exact = {place for i, place in enumerate(places) if i not in unsure}
    spellings: defaultdict[Path | str, set[_Key]] = defaultdict(set)
    for i in missing:
        spellings[places[i]].add(tuple(map(_folded, _parts(names[i]))))
    respelled = {}
    for i in missing:
        place = places[i]
        if isinstance(place, Path) and search.is_there(place):
            if place in exact:
                places[i] = search.exact(names[i])
            elif len(spellings[place]) > 1:
                places[i] = UNCLEAR
            elif not _lacks_ending_only(names[i], place):
                respelled[names[i]] = place
    return Located(tuple(names), tuple(places), respelled)


class _Search:
    """Looks for images below a folder; every folder is listed once."""

    def __init__(self, root: Path) -> None:
        self._root = root
        self._listings: dict[Path, tuple[list[str], list[str]]] = {}

    def exact(self, name: str) -> Path | str:
        """Return the path that a name spells, or the reason why there can be none."""
        if not name.strip():
            return UNNAMED
        try:
            return path_inside(self._root, name, self._root)
        except DataError:
            return _OUTSIDE

    def is_there(self, place: Path | str) -> bool:
        """Whether a place is an image, or unclear for good."""
        return os.path.isfile(place) if isinstance(place, Path) else place == UNCLEAR

    def in_place(self, name: str) -> Path | str | None:
        """Return the image that a name means if only its spelling differs; None if there is none."""
        parts = _parts(name)
        folder = self._folder(parts[:-1]) if parts and not name.startswith("/") else None
        return None if folder is None else self._image(folder, parts[-1])

    def in_moved_folders(self, names: Sequence[str], settled: Collection[Path]) -> list[Path | str | None]:
        """Return the images of names whose folders are not there, from the folders that agree with these.

        Args:
            names: as listed.
            settled: folders that are none of them.
        """
        results: list[Path | str | None] = [None] * len(names)
        groups: dict[_Key, list[int]] = {}
        for i, name in enumerate(names):
            parts = _parts(name)
            if parts:
                groups.setdefault(tuple(map(_folded, parts[:-1])), []).append(i)
        for given, members in groups.items():
            in_place = None if names[members[0]].startswith("/") else self._folder(given)
            if in_place is not None and self._listing(in_place)[1]:
                continue
            found: list[list[Path | str | None]] = [
                [self._image(folder, _parts(names[i])[-1]) for i in members]
                for key, folder in self._folders()
                if folder != in_place and folder not in settled and _agree(given, key)
            ]
            counts = [sum(isinstance(path, Path) for path in paths) for paths in found]
            if counts and max(counts) > 0 and 2 * max(counts) >= len(members):
                best = found[counts.index(max(counts))] if counts.count(max(counts)) == 1 else None
                for position, i in enumerate(members):
                    results[i] = UNCLEAR if best is None else best[position]
        return results

    def _folder(self, parts: Sequence[str]) -> Path | None:
        """Return the one folder that parts of a path spell, or None."""
        folder = self._root
        for part in parts:
            names = self._listing(folder)[0]
            fitting = [part] if part in names else [name for name in names if _folded(name) == _folded(part)]
            if len(fitting) != 1:
                return None
            folder = folder / fitting[0]
        return folder

    def _image(self, folder: Path, name: str) -> Path | str | None:
        """Return the one image in a folder that a name means."""
        names = self._listing(folder)[1]
        if name in names:
            return folder / name
        same = [other for other in names if _folded(other) == _folded(name)]
        if not same:
            stem = _folded(_stem(name))
            same = [other for other in names if _folded(_stem(other)) == stem]
            exact = [other for other in same if _stem(other) == name]
            if _stem(name) == name and exact:  # a name without ending means the first ending that is there
                same = [min(exact, key=lambda other: IMAGE_ENDINGS.index(_ending(other)))]
        if len(same) > 1:
            return UNCLEAR
        return folder / same[0] if same else None

    def _folders(self) -> list[tuple[_Key, Path]]:
        """Return the folders with images below the root, with the folded parts of their paths."""
        return [
            (tuple(map(_folded, folder.relative_to(self._root).parts)), folder)
            for folder in self._walk(self._root, _MAX_DEPTH)
            if self._listing(folder)[1]
        ]

    def _walk(self, folder: Path, depth: int) -> Iterator[Path]:
        if len(self._listings) > _MAX_FOLDERS:
            return
        yield folder
        if depth:
            for name in self._listing(folder)[0]:
                yield from self._walk(folder / name, depth - 1)

    def _listing(self, folder: Path) -> tuple[list[str], list[str]]:
        """Return the names of the folders and of the images in a folder."""
        if folder not in self._listings:
            folders: list[str] = []
            images: list[str] = []
            try:
                with os.scandir(folder) as entries:
                    for entry in entries:
                        if is_hidden(entry.name):
                            continue
                        if _ending(entry.name) in IMAGE_ENDINGS:
                            images.append(entry.name)
                        elif entry.is_dir():
                            folders.append(entry.name)
            except OSError:
                pass  # what cannot be listed holds nothing that could be read
            self._listings[folder] = (sorted(folders), sorted(images))
        return self._listings[folder]


def _agree(given: _Key, folder: _Key) -> bool:
    """Whether a folder below the root may be the one that a list gives by another path.

    The whole of one path must be the end of the other; folders of images may be left out of the list.
    """
    if len(folder) <= len(given):
        return given[len(given) - len(folder) :] == folder
    ahead, end = folder[: len(folder) - len(given)], folder[len(folder) - len(given) :]
    return end == given and all(part in IMAGE_FOLDERS for part in ahead)


def _lacks_ending_only(name: str, place: Path) -> bool:
    """Whether a name is that of an image but for the ending, which many programs leave out."""
    return _stem(name) == name and str(place.with_suffix("")).endswith(os.path.normpath(name))


def _parts(name: str) -> list[str]:
    """Return the parts of a path from any machine, without its drive and what leads upwards."""
    path = posixpath.normpath(name.replace("\\", "/").replace("\0", ""))
    return [
        part for part in path.split("/") if part not in ("", ".", "..") and not re.fullmatch(r"\w+:", part)
    ]


def _folded(name: str) -> str:
    """Return a name in which case and the forms of Unicode are equal."""
    return unicodedata.normalize("NFC", unicodedata.normalize("NFC", name).casefold())


def _ending(name: str) -> str:
    return os.path.splitext(name)[1].lower()


def _stem(name: str) -> str:
    """Return a name without its ending, if that is one of an image: ``frame_1305.17`` has none."""
    stem, ending = os.path.splitext(name)
    return stem if ending.lower() in (*IMAGE_ENDINGS, *_FOREIGN_ENDINGS) else name
