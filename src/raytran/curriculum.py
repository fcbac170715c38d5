# SPDX-License-Identifier: Apache-2.0
"""Train the three stages one after another: ``raytran curriculum preset=raytran|small|…``."""

from __future__ import annotations

from typing import TYPE_CHECKING

from raytran.run.entry import entry_point

if TYPE_CHECKING:
    from omegaconf import DictConfig


@entry_point("curriculum")
def main(cfg: DictConfig) -> None:
    """Run the command."""
    # Imported here so that --help answers at once.
    from raytran.run.train.curriculum import curriculum

    curriculum(cfg)


if __name__ == "__main__":
    main()
