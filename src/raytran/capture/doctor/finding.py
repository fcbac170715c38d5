# SPDX-License-Identifier: Apache-2.0
"""What a check found, and the change of the cameras that would mend it."""

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
        check: what was asked, e.g. ``camera axes``.
        state: the answer.
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
    """How stored cameras become right ones; as made it changes nothing.

    A stored matrix S becomes ``world_turn · scaled(undone(S) · camera_turn)``.

    Attributes:
        storage: how S was written; ``inverted`` is camera_from_world.
        camera_turn: ``(3, 3)`` turn of the camera axes, applied on the right.
        scale: metres per stored unit.
        world_turn: ``(4, 4)`` right_world_from_stored_world.
        intrinsics: ``(3, 3)`` for the stored image size, or None if the stored ones are right.
    """

    storage: Storage = "as stored"
    camera_turn: NDArray[np.float64] = field(default_factory=lambda: np.eye(3))
    scale: float = 1.0
    world_turn: NDArray[np.float64] = field(default_factory=lambda: np.eye(4))
    intrinsics: NDArray[np.float64] | None = None

    @property
    def changes_cameras(self) -> bool:
        """Whether any camera moves or sees differently."""
        still = np.allclose(self.camera_turn, np.eye(3)) and np.allclose(self.world_turn, np.eye(4))
        changed = self.storage != "as stored" or self.scale != 1.0 or self.intrinsics is not None
        return changed or not still

    def apply(self, stored: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return world_from_camera ``(n, 4, 4)``, metres, of the stored matrices."""
        poses = stored.copy()
        if self.storage == "transposed":
            poses[:, :3] = stored[:, :, :3].transpose(0, 2, 1)
        elif self.storage == "rotation transposed":
            poses[:, :3, :3] = stored[:, :3, :3].transpose(0, 2, 1)
        poses[:, 3] = (0.0, 0.0, 0.0, 1.0)  # Whatever stands there is no part of a pose.
        if self.storage == "inverted":
            poses[:] = np.linalg.inv(poses)
        poses[:, :3, :3] = poses[:, :3, :3] @ self.camera_turn
        poses[:, :3, 3] *= self.scale
        return self.world_turn @ poses
