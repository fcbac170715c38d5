# SPDX-License-Identifier: Apache-2.0
"""What a checkpoint says of itself: its stage, network, data, parent, and where it comes from."""

from __future__ import annotations

import copy
import os
import platform
import shlex
import subprocess
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import torch

import raytran
from raytran.checkpoints.file import FORMAT
from raytran.checkpoints.network import with_registered_names
from raytran.data.scan2cad import annotation_digest

_NAMES = {
    "raytran.rooms.ensure.ensure_rooms": "rooms",
    "raytran.rooms.ensure.ensure_rooms_v1": "rooms-v1",
    "raytran.run.rooms.ensure_rooms": "rooms",
    "raytran.run.rooms.ensure_rooms_v1": "rooms-v1",
}
"""What makes a data set → its name, for checkpoints from before configs named it; it lay in ``run`` once."""

_HOW = ("_target_", "_partial_", "processes", "progress", "allowed", "usual")
"""Settings of what makes a data set that change nothing in it."""


@dataclass(frozen=True)
class DataIdentity:
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
    def of_config(config: Mapping[str, Any]) -> DataIdentity:
        """Return the data that the settings of a run, resolved, describe, with the annotation on disk now."""
        data = config.get("data") or {}
        root = data.get("root")
        made = data.get("make") if isinstance(data.get("make"), Mapping) else None
        usual = "scan2cad" if made is None else _NAMES.get(str(made.get("_target_")))
        return DataIdentity(
            name=data.get("name") or usual,
            root=None if root is None else str(root),
            annotation=None if root is None else annotation_digest(Path(root)),
            made=None if made is None else {name: made[name] for name in made if name not in _HOW},
        )

    @staticmethod
    def of_checkpoint(content: Mapping[str, Any]) -> DataIdentity | None:
        """Return the data that a checkpoint was trained on, None if it does not say."""
        if (known := DataIdentity.of_plain(content.get("data"))) is not None:
            return known
        config = content.get("config")
        if not isinstance(config, Mapping) or not isinstance(config.get("data"), Mapping):
            return None
        # From before checkpoints said it. What lies in that folder now need not be what lay there then.
        return DataIdentity.of_plain(asdict(DataIdentity.of_config(config)) | {"annotation": None})

    @staticmethod
    def of_plain(node: Any) -> DataIdentity | None:
        """Return what ``as_plain`` returned, None for anything else."""
        if not isinstance(node, Mapping):
            return None
        values = {field.name: node.get(field.name) for field in fields(DataIdentity)}
        return DataIdentity(**values)

    def as_plain(self) -> dict[str, Any]:
        """Return plain Python, to be written into checkpoints."""
        return asdict(self)

    def is_same(self, other: DataIdentity) -> bool:
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

    def _is_beside(self, other: DataIdentity) -> bool:
        if self.root is None or other.root is None:
            return False
        return Path(self.root).resolve() == Path(other.root).resolve()

    def typed(self) -> str:
        """Return the settings that choose the data, as one types them into a shell."""
        words = [f"data={self.name}" if self.name else "", f"data.root={self.root}" if self.root else ""]
        return " ".join(shlex.quote(word) for word in words if word)

    def __str__(self) -> str:
        return " in ".join(word for word in (self.name, self.root) if word) or "unknown data"


_PACKAGES = (
    "triton",
    "lightning",
    "hydra-core",
    "torchmetrics",
    "numpy",
    "trimesh",
    "scikit-image",
    "embreex",
)


def git_commit(package: Path | None = None) -> str | None:
    """Return the commit of the clone that the package runs from, with ``+changes`` if files differ from it.

    None for an installed wheel, even one that was installed inside somebody else's repository.
    """
    package = package or Path(raytran.__file__).resolve().parent
    top = _git(package, "rev-parse", "--show-toplevel")
    if top is None or Path(top).resolve() / "src" / "raytran" != package:
        return None
    commit = _git(package, "rev-parse", "HEAD")
    changed = _git(package, "status", "--porcelain", "--untracked-files=no")
    return f"{commit}+changes" if commit and changed else commit


def versions() -> dict[str, str]:
    """Return the versions of Python, of this package and of those that its numbers depend on."""
    found = {"python": platform.python_version(), "raytran": raytran.__version__}
    # The metadata of PyPI's wheel do not say which CUDA it is for.
    found["torch"] = str(torch.__version__)
    for name in _PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found


def provenance() -> dict[str, Any]:
    """Return commit, versions, platform and machine as plain Python."""
    return {
        "git_commit": git_commit(),
        "versions": versions(),
        "platform": platform.platform(),
        "machine": machine(),
    }


def machine() -> str:
    """Return what computes here, e.g. ``16 cores, 8 × NVIDIA A100``."""
    cores = os.cpu_count() or 1
    gpus = Counter(torch.cuda.get_device_name(i) for i in range(torch.cuda.device_count()))
    parts = [
        f"{cores} core{'' if cores == 1 else 's'}",
        *(f"{count} × {name}" for name, count in gpus.items()),
    ]
    return ", ".join(parts)


def _git(folder: Path, *arguments: str) -> str | None:
    try:
        done = subprocess.run(
            ["git", "-C", str(folder), *arguments], capture_output=True, text=True, check=True
        )
    except (OSError, subprocess.CalledProcessError):
        return None
    return done.stdout.strip()


def checkpoint_metadata(
    *,
    stage: str,
    preset: str,
    config: Mapping[str, Any],
    parent: Mapping[str, Any] | None,
    warnings: Sequence[str] = (),
) -> dict[str, Any]:
    """Return the plain Python that identifies a checkpoint.

    Args:
        stage: name of the stage.
        preset: name of the preset.
        config: all settings of the run, resolved; ``model`` rebuilds the network, ``views`` holds
            ``image_size`` [H, W], ``num_views`` in training and ``predict_views``.
        parent: the checkpoint that the fit started from, see ``Parent``, or None.
        warnings: what anybody who uses the weights should know.
    """
    return {
        "format": FORMAT,
        "stage": stage,
        "preset": preset,
        "model": with_registered_names(config["model"]),
        "views": copy.deepcopy(config["views"]),
        "config": copy.deepcopy(dict(config)),
        "data": DataIdentity.of_config(config).as_plain(),
        "input_mask": input_mask(config),
        "parent": None if parent is None else dict(parent),
        "warnings": list(warnings),
        "git_commit": git_commit(),
        "versions": versions(),
    }


def input_mask(config: Any) -> str | None:
    """Return the mask that goes in as a fourth channel; checkpoints from before there were two say True."""
    for name in ("data", "dataset", "input_mask"):
        config = config.get(name) if isinstance(config, Mapping) else None
    return "amodal" if config is True else config if isinstance(config, str) else None
