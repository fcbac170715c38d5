# SPDX-License-Identifier: Apache-2.0
"""Which class the objects of an annotation's category are of."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from raytran.classes import Classes
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
        if isinstance(category, str):
            known = {_plain(name): name for name in self.classes.names}
            for name, catids in zip(self.classes.names, self.classes.catids, strict=True):
                known = {_plain(catid): name for catid in catids} | known
            renamed = {_plain(name): own for name, own in self.renamed.items()}
            found = renamed.get(_plain(category), known.get(_plain(category)))
            if found is not None or _plain(category) in renamed or self.unknown_left_out:
                return found
        raise DataError(
            f"{where} is of category {shown(category)}, which is no class: choose one of {self.classes}, "
            "name yours in classes.names=[…], or map it with categories={name: class}"
        )


def _plain(name: str) -> str:
    return "_".join(name.replace("-", " ").replace("/", " ").replace("_", " ").lower().split())
