# SPDX-License-Identifier: Apache-2.0
"""RayTran: every object of a room, with class, 9-DoF pose and mesh, from a posed RGB video."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    from raytran.model import RayTran

__version__ = "0.1.0"


def load(checkpoint: str | Path = "default", *, trust: Iterable[str] = ()) -> RayTran:
    """Return the model of a checkpoint, in evaluation mode, on the CPU.

    Args:
        checkpoint: a ``.ckpt`` file that training wrote, a ``.safetensors`` file that was exported from one,
            ``default`` for the weights that the package carries (``raytran/weights/README.md``), or
            ``hf:owner/name[/FILE.safetensors][@revision]`` for weights on the Hugging Face hub.
        trust: top-level packages of your own whose networks the file may name, e.g. ``("mylab",)``: they are
            imported and run. A file can never add to them.

    Raises:
        CheckpointError: the file is missing or damaged, or names a class of a package that is not trusted, or
            the package was built without weights, or the hub cannot be reached.
        ConfigError: ``trust`` is no list of packages.
    """
    # Imported here so that ``import raytran`` stays light.
    from raytran.checkpoints.load import load_model

    return load_model(checkpoint, trust=trust)
