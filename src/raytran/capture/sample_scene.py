# SPDX-License-Identifier: Apache-2.0
"""The scene that raytran carries, for a first look: 24 frames of a generated room in ScanNet's form.

It is ``scene9003_00`` of rooms-v1's test rooms, whose furniture and textures no weights that raytran carries
have learned from; ``raytran prepare dataset=rooms-v1`` makes it anew.
"""

from __future__ import annotations

from pathlib import Path

SAMPLE = "sample"
"""What one types for it."""

_FOLDER = Path(__file__).parent / "sample"


def scene_path(typed: str | Path) -> Path:
    """Return the absolute path of a scene as typed; ``sample``, if there is none so called, is raytran's."""
    path = Path(typed)
    return _FOLDER if str(typed) == SAMPLE and not path.exists() else path.resolve()
