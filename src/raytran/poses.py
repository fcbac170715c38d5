# SPDX-License-Identifier: Apache-2.0
"""Find the cameras of a film: ``raytran poses walk.mp4 output=DIR``."""

from __future__ import annotations

from typing import TYPE_CHECKING

from raytran.run.entry import entry_point

if TYPE_CHECKING:
    from omegaconf import DictConfig


@entry_point("poses")
def main(cfg: DictConfig) -> None:
    """Run the command."""
    # Imported here so that --help answers at once.
    from raytran.run.poses.poses import poses

    poses(cfg)


if __name__ == "__main__":
    main()
