# SPDX-License-Identifier: Apache-2.0
"""The classes of objects that a network tells apart: their names, colours and categories of ShapeNet."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from raytran.errors import ConfigError
from raytran.limits import shown

Color = tuple[int, int, int]
"""Red, green, blue in [0, 255]."""

MAX_CLASSES = 500

OTHER = "other"
"""A class of this name takes the objects of all categories that belong to no class."""

PADDING_NAME = "padding"
"""What a network says of a query that holds no object: always its last output, and no class."""

_MAX_NAME = 60
"""Characters."""

_NOT_IN_NAMES = ("/", "\\", "$")
"""Names are parts of paths: of scores in logs, and of nodes in files of meshes and in the viewer. A dollar
sign in a config refers to another setting."""

_PAPER: dict[str, tuple[str, Color]] = {
    "bathtub": ("02808440", (23, 190, 207)),
    "bookshelf": ("02871439", (140, 86, 75)),
    "cabinet": ("02933112", (255, 127, 14)),
    "chair": ("03001627", (31, 119, 180)),
    "display": ("03211117", (148, 103, 189)),
    "sofa": ("04256520", (214, 39, 40)),
    "table": ("04379243", (44, 160, 44)),
    "trashbin": ("02747177", (227, 119, 194)),
    OTHER: ("", (127, 127, 127)),
}
"""ShapeNet's category (Scan2CAD EvaluateBenchmark.py) and the colour of each class of the paper."""

_LEVELS = range(20, 256, 47)
_DARKEST, _LIGHTEST = 60.0, 190.0
"""Of the palette, as grey: it is seen on white pages, and under white text."""


@dataclass(frozen=True)
class Classes:
    """The ``K`` classes that labels 0 to K - 1 stand for; a network adds padding behind them (RayTran §3.2).

    Attributes:
        names: one for each label.
        colors: red, green and blue in [0, 255] of each class, in pictures and meshes alike. Left out: the
            paper's for the names of its classes, and for other names colours that differ from these.
        catids: categories that belong to each class, as annotations name them: eight digits of ShapeNet, or
            any other name. A category that none lists belongs to the class of its name, or else to ``other``.
            Left out: Scan2CAD's for the names of the paper's classes, none for other names.

    Any printable words can be classes of boxes that are only compared. What a network may call its classes is
    less, see ``of``.

    Raises:
        ConfigError: there is no class; names are not distinct printable texts; a colour is none; or two
            classes list the same category.
    """

    names: tuple[str, ...]
    colors: tuple[Color, ...] = ()
    catids: tuple[tuple[str, ...], ...] = ()

    def __post_init__(self) -> None:
        _check_names(self.names)
        # Tuples of plain values, whatever was given: what is hashed and compared.
        object.__setattr__(self, "names", tuple(self.names))
        object.__setattr__(self, "colors", _filled_colors(self.names, self.colors))
        object.__setattr__(self, "catids", _filled_catids(self.names, self.catids))
        listed = [catid for some in self.catids for catid in some]
        if len(set(listed)) < len(listed):
            twice = next(catid for catid in listed if listed.count(catid) > 1)
            raise ConfigError(f"the category {shown(twice)} is listed twice: give it to one class")

    @classmethod
    def of(cls, settings: Any) -> Classes:
        """Return the classes that a config, or the description in a checkpoint, names.

        Args:
            settings: ``names``; and ``colors`` and ``catids``, lists with an entry for each name, or left
                out. An entry that is null stands for what ``Classes`` takes where they are left out, and a
                text in ``catids`` for a list of it. None: the paper's nine.

        Raises:
            ConfigError: it is something else, or see ``Classes``; or there are too many classes, or a name
                is long or has characters that mean something in paths and configs.
        """
        if settings is None:
            return PAPER_CLASSES
        if isinstance(settings, Classes):
            _check_names_of_network(settings.names)
            return settings
        if not isinstance(settings, Mapping) or not set(settings) <= {"names", "colors", "catids"}:
            raise ConfigError("classes are given by names, colors and catids: see conf/classes/paper.yaml")
        lists = {name: given for name, given in settings.items() if given is not None}
        for name, given in lists.items():
            if not isinstance(given, list | tuple):
                raise ConfigError(f"classes.{name}={shown(given)} is no list: write it as [a,b]")
        _check_names_of_network(lists.get("names", ()))
        return cls(lists.get("names", ()), lists.get("colors", ()), lists.get("catids", ()))

    def settings(self) -> dict[str, Any]:
        """Return what ``of`` makes these classes of again: lists and texts."""
        return {
            "names": list(self.names),
            "colors": [list(color) for color in self.colors],
            "catids": [list(some) for some in self.catids],
        }

    def __len__(self) -> int:
        return len(self.names)

    def difference(self, other: Classes) -> str | None:
        """Say in a few words how the names of ``other`` differ from these; None if they are the same."""
        if self.names == other.names:
            return None
        added = [name for name in other.names if name not in self.names]
        lacking = [name for name in self.names if name not in other.names]
        parts = [f"with {shown(added[0])}"] * bool(added) + [f"without {shown(lacking[0])}"] * bool(lacking)
        return f"{len(other)} classes {' and '.join(parts) or 'in another order'}"

    def index(self, name: str) -> int:
        """Return the label of a class.

        Raises:
            ConfigError: there is no class of that name.
        """
        if name not in self.names:
            raise ConfigError(f"{shown(name)} is no class: choose one of {self}")
        return self.names.index(name)

    def label_of(self, category: str) -> int | None:
        """Return the label of objects that an annotation puts into ``category``.

        That is the class that lists it in ``catids``, or the one of that name, or ``other``. None: they
        belong to no class.
        """
        labels = _label_by_category(self)
        return labels.get(category, labels.get(OTHER))

    def names_of(self, labels: Iterable[int]) -> tuple[str, ...]:
        """Return the name of each label."""
        return tuple(self.names[label] for label in labels)

    def hex(self, label: int) -> str:
        """Return a class's colour as ``#rrggbb``."""
        return "#{:02x}{:02x}{:02x}".format(*self.colors[label])

    def __str__(self) -> str:
        return ", ".join(self.names)


def _check_names(names: Sequence[Any]) -> None:
    if not names:
        raise ConfigError("expected at least one class, got 0: name them in classes.names")
    for name in names:
        if not isinstance(name, str):
            raise ConfigError(f'the class {shown(name)} is no text: put it in quotes, as in "{shown(name)}"')
        if not name or not name.isprintable():
            raise ConfigError(f"{shown(name)} is no name of a class: give printable characters")
    if len(set(names)) < len(names):
        twice = next(name for name in names if list(names).count(name) > 1)
        raise ConfigError(f"the class {shown(twice)} is named twice: name each once in classes.names")


def _check_names_of_network(names: Sequence[Any]) -> None:
    """Raise unless a network may call its classes so."""
    if not 0 < len(names) <= MAX_CLASSES:
        raise ConfigError(
            f"expected 1 to {MAX_CLASSES} classes, got {len(names)}: name them in classes.names"
        )
    for name in filter(lambda name: isinstance(name, str), names):
        is_proper = name[:1].isalnum() and name == name.rstrip() and name.isprintable()
        if not is_proper or len(name) > _MAX_NAME:
            raise ConfigError(
                f"{shown(name)} is no name of a class: give 1 to {_MAX_NAME} printable characters, the first "
                "of them a letter or digit"
            )
        if name == PADDING_NAME or any(character in name for character in _NOT_IN_NAMES):
            raise ConfigError(
                f"{shown(name)} cannot be the name of a class: take one without / \\ $, not {PADDING_NAME}"
            )


def _entries(what: str, given: Sequence[Any], names: Sequence[str]) -> Sequence[Any]:
    """Return what is given for each of the names, None where nothing is."""
    if len(given) not in (0, len(names)):
        raise ConfigError(
            f"classes.{what} has {len(given)} entries for {len(names)} names: give one for each, or null"
        )
    return given or [None] * len(names)


def _filled_colors(names: Sequence[str], given: Sequence[Any]) -> tuple[Color, ...]:
    known = {name: color for name, (_, color) in _PAPER.items()} | {
        name: _checked_color(name, color)
        for name, color in zip(names, _entries("colors", given, names), strict=True)
        if color is not None
    }
    of_palette = iter(_palette(sum(name not in known for name in names)))
    return tuple(known[name] if name in known else next(of_palette) for name in names)


def _filled_catids(names: Sequence[str], given: Sequence[Any]) -> tuple[tuple[str, ...], ...]:
    listed = {
        name: _checked_catids(name, some)
        for name, some in zip(names, _entries("catids", given, names), strict=True)
        if some is not None
    }
    taken = {catid for some in listed.values() for catid in some}
    known = {name: (catid,) for name, (catid, _) in _PAPER.items() if catid and catid not in taken}
    return tuple((known | listed).get(name, ()) for name in names)


def _checked_color(name: str, color: Any) -> Color:
    parts = tuple(color) if isinstance(color, list | tuple) else ()
    if len(parts) != 3 or any(type(part) is not int or not 0 <= part <= 255 for part in parts):
        raise ConfigError(
            f"the colour {shown(color)} of the class {name} is none: give red, green and blue from 0 to 255"
        )
    return (parts[0], parts[1], parts[2])


def _checked_catids(name: str, catids: Any) -> tuple[str, ...]:
    listed = (catids,) if isinstance(catids, str) else catids
    if not isinstance(listed, list | tuple) or not all(map(_is_category, listed)):
        raise ConfigError(
            f"the categories {shown(catids)} of the class {name} are no names: put each in quotes, "
            'as in "03001627"'
        )
    return tuple(listed)


def _is_category(value: Any) -> bool:
    is_text = isinstance(value, str) and value.isprintable() and 0 < len(value) <= _MAX_NAME
    return is_text and not any(character in value for character in _NOT_IN_NAMES)


@lru_cache(maxsize=64)
def _label_by_category(classes: Classes) -> dict[str, int]:
    """Return the label of every category that is listed, and of the classes' own names."""
    by_name = {name: label for label, name in enumerate(classes.names)}
    return by_name | {catid: label for label, some in enumerate(classes.catids) for catid in some}


@lru_cache(maxsize=64)
def _palette(count: int) -> tuple[Color, ...]:
    """Return colours, each as far as can be from those before it and from the paper's.

    They are points of a coarse lattice of red, green and blue, neither too dark nor too light.
    """
    lattice = np.stack(np.meshgrid(_LEVELS, _LEVELS, _LEVELS, indexing="ij"), axis=-1).reshape(-1, 3)
    grey = lattice @ np.array([0.299, 0.587, 0.114])
    lattice = lattice[(grey >= _DARKEST) & (grey <= _LIGHTEST)]
    paper = np.array([color for _, color in _PAPER.values()])
    nearest = ((lattice[:, None] - paper) ** 2).sum(axis=-1).min(axis=1)
    colors = []
    for _ in range(count):
        best = lattice[nearest.argmax()]
        nearest = np.minimum(nearest, ((lattice - best) ** 2).sum(axis=-1))
        colors.append((int(best[0]), int(best[1]), int(best[2])))
    return tuple(colors)


PAPER_CLASSES = Classes(tuple(_PAPER))
"""The nine of the paper, which are Scan2CAD's."""

SCAN2CAD_CLASS_BY_CATID: dict[str, str] = {catid: name for name, (catid, _) in _PAPER.items() if catid}
"""Class of each ShapeNet category in Scan2CAD's protocols, whatever a network's classes are; every other
category is ``other``."""
