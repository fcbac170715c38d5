# SPDX-License-Identifier: Apache-2.0
"""Which data a run is trained on, as far as a later stage must know to tell whether they are its own."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from raytran.data.scan2cad import annotation_digest

_NAMES = {
    "raytran.rooms.ensure.ensure_rooms": "rooms",
    "raytran.rooms.ensure.ensure_rooms_v1": "rooms-v1",
    "raytran.run.rooms.ensure_rooms": "rooms",
    "raytran.run.rooms.ensure_rooms_v1": "rooms-v1",
}
"""What makes a data set → its name, for checkpoints from before configs named it; it lay in ``run`` once."""

_HOW = ("_target_", "_partial_", "processes", "progress")
"""Settings of what makes a data set that change nothing in it."""


@dataclass(frozen=True)
class KnownData:
    """The data of one run.

    Attributes:
        name: of the data set, ``data.name``; None if it has none.
        root: its folder as it was typed; None if that is not known.
        annotation: digest of its annotation; None if that is not known, or not made yet.
        made: the settings that it is made with; None if it is given.
    """

    name: str | None
    root: str | None
    annotation: str | None = None
    made: Mapping[str, Any] | None = None

    @staticmethod
    def of_config(config: Mapping[str, Any]) -> KnownData:
        """Return the data that the settings of a run, resolved, describe, with the annotation on disk now."""
        data = config.get("data") or {}
        root = data.get("root")
        made = data.get("make") if isinstance(data.get("make"), Mapping) else None
        usual = "scan2cad" if made is None else _NAMES.get(str(made.get("_target_")))
        return KnownData(
            name=data.get("name") or usual,
            root=None if root is None else str(root),
            annotation=None if root is None else annotation_digest(Path(root)),
            made=None if made is None else {name: made[name] for name in made if name not in _HOW},
        )

    @staticmethod
    def of_checkpoint(content: Mapping[str, Any]) -> KnownData | None:
        """Return the data that a checkpoint was trained on, None if it does not say."""
        if (known := KnownData.of_plain(content.get("data"))) is not None:
            return known
        config = content.get("config")
        if not isinstance(config, Mapping) or not isinstance(config.get("data"), Mapping):
            return None
        # From before checkpoints said it. What lies in that folder now need not be what lay there then.
        return KnownData.of_plain(asdict(KnownData.of_config(config)) | {"annotation": None})

    @staticmethod
    def of_plain(node: Any) -> KnownData | None:
        """Return what ``as_plain`` returned, None for anything else."""
        if not isinstance(node, Mapping):
            return None
        values = {field.name: node.get(field.name) for field in fields(KnownData)}
        return KnownData(**values)

    def as_plain(self) -> dict[str, Any]:
        """Return plain Python, to be written into checkpoints."""
        return asdict(self)

    def is_same(self, other: KnownData) -> bool:
        """Say whether both are one data set, wherever it lies now.

        The annotation decides, which moves along with a folder and is the same in a copy. Data that are given
        may have grown: in one folder they are the same too. Where an annotation is not known, data that are
        made are the same if they have one name and are made with the same settings, others if they have one
        name and folder.
        """
        given = self.made is None and other.made is None
        if self.annotation and other.annotation:
            return self.annotation == other.annotation or (given and self._is_beside(other))
        return self.name == other.name and (self._is_beside(other) if given else self.made == other.made)

    def _is_beside(self, other: KnownData) -> bool:
        if self.root is None or other.root is None:
            return False
        return Path(self.root).resolve() == Path(other.root).resolve()

    def typed(self) -> str:
        """Return the settings that choose the data."""
        words = [f"data={self.name}" if self.name else "", f"data.root={self.root}" if self.root else ""]
        return " ".join(word for word in words if word)

    def __str__(self) -> str:
        return " in ".join(word for word in (self.name, self.root) if word) or "unknown data"
