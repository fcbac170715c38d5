# SPDX-License-Identifier: Apache-2.0
"""Which class the objects of an annotation's category are of."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

from raytran.classes import Classes
from raytran.data.cache import digest, file_digest
from raytran.errors import ConfigError, DataError
from raytran.limits import shown


@dataclass(frozen=True)
class Categories:
    """The categories of an annotation that count, and as what.

    Attributes:
        classes: that objects can be of.
        renamed: categories by other names → the name of their class; None: such objects are left out.
        unknown_left_out: whether objects of all other categories are left out, rather than an error.

    Raises:
        ConfigError: ``renamed`` names no class.
    """

    classes: Classes
    renamed: Mapping[str, str | None] = field(default_factory=dict)
    unknown_left_out: bool = False

    def __post_init__(self) -> None:
        for name, own in self.renamed.items():
            if own is not None and own not in self.classes.names:
                raise ConfigError(
                    f"categories.{name}={own} names no class: choose one of {self.classes}, or null"
                )

    def class_of(self, category: object, where: str) -> str | None:
        """Return the name of a category's class, None if its objects are left out.

        Names count alike whether their words are parted by blanks, - or _, in capitals or not.

        Args:
            category: what an annotation says, of any type.
            where: whose it is, for messages.

        Raises:
            DataError: it is no class.
        """
        if isinstance(category, str) and (_plain(category) in self._class_by_name or self.unknown_left_out):
            return self._class_by_name.get(_plain(category))
        raise DataError(
            f"{where} is of category {shown(category)}, which is no class: choose one of {self.classes}, "
            "name yours in classes.names=[…], or map it with categories={name: class}"
        )

    def state_of(self, annotation: Path) -> str:
        """Return a digest of an annotation's file and of what its categories count as."""
        return digest(file_digest(annotation), self.classes.names, sorted(self.renamed.items()))

    @cached_property
    def _class_by_name(self) -> Mapping[str, str | None]:
        """What each name counts as: as it was renamed, else the class of that name, else of that category."""
        # Of two that read the same, the first listed counts.
        pairs = reversed([*zip(self.classes.names, self.classes.catids, strict=True)])
        return {
            **{_plain(catid): name for name, catids in pairs for catid in catids},
            **{_plain(name): name for name in self.classes.names},
            **{_plain(name): own for name, own in self.renamed.items()},
        }


def _plain(name: str) -> str:
    return "_".join(name.replace("-", " ").replace("/", " ").replace("_", " ").lower().split())
