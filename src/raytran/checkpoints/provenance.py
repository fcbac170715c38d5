# SPDX-License-Identifier: Apache-2.0
"""Where a result comes from: commit, versions, machine."""

from __future__ import annotations

import os
import platform
import subprocess
from collections import Counter
from importlib import metadata
from pathlib import Path
from typing import Any

import torch

import raytran

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
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
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
