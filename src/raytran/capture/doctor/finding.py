# SPDX-License-Identifier: Apache-2.0
"""The result of a check, and the correction of the cameras that would mend a fault."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Storage = Literal["as stored", "inverted", "transposed", "rotation transposed"]
"""What was done to a camera-to-world matrix before it was written."""

State = Literal["ok", "note", "fault", "unknown"]
"""``fault``: mend it before training; ``note``: worth knowing; ``unknown``: the data do not tell."""


@dataclass(frozen=True)
class Finding:
    """The result of one check of one scan.

    Attributes:
        check: what was checked, e.g. ``camera axes``.
        state: the result.
        text: what was measured, one sentence with figures.
        cause: short name of the fault, e.g. ``OpenGL camera axes``; empty unless ``fault``.
        fix: what to do, one sentence; empty if there is nothing to do.
        confidence: ``certain`` or ``likely`` for a fault.
    """

    check: str
    state: State
    text: str
    cause: str = ""
    fix: str = ""
    confidence: str = ""


@dataclass(frozen=True)
class Correction:
    """How stored cameras become right ones; the default changes nothing.

    A stored matrix S becomes ``world_transform · scaled(undo_storage(S) · camera_rotation)``.

    Attributes:
        storage: how S was written; ``inverted`` is camera_from_world.
        camera_rotation: ``(3, 3)`` rotation of the camera axes, applied on the right.
        scale: metres per stored unit.
        world_transform: ``(4, 4)`` right_world_from_stored_world.
        intrinsics: ``(n, 3, 3)`` for the stored image size, or None if the stored ones are right.
    """

    storage: Storage = "as stored"
    camera_rotation: NDArray[np.float64] = field(default_factory=lambda: np.eye(3))
    scale: float = 1.0
    world_transform: NDArray[np.float64] = field(default_factory=lambda: np.eye(4))
    intrinsics: NDArray[np.float64] | None = None

    @property
    def changes_cameras(self) -> bool:
        """Whether any camera moves or sees differently."""
        return (
            self.storage != "as stored"
            or self.scale != 1.0
            or self.intrinsics is not None
            or not np.allclose(self.camera_rotation, np.eye(3))
            or not np.allclose(self.world_transform, np.eye(4))
        )

    def apply(self, stored: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return world_from_camera ``(n, 4, 4)``, metres, of the stored matrices ``(n, 4, 4)``."""
        poses = stored.copy()
        if self.storage == "transposed":
            poses[:, :3] = stored[:, :, :3].transpose(0, 2, 1)
        elif self.storage == "rotation transposed":
            poses[:, :3, :3] = stored[:, :3, :3].transpose(0, 2, 1)
        poses[:, 3] = (0.0, 0.0, 0.0, 1.0)  # What is written there is no part of a pose.
        if self.storage == "inverted":
            poses[:] = np.linalg.inv(poses)
        poses[:, :3, :3] = poses[:, :3, :3] @ self.camera_rotation
        poses[:, :3, 3] *= self.scale
        return self.world_transform @ poses
