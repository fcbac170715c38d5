# SPDX-License-Identifier: Apache-2.0
"""Plan memory and time: ``raytran plan data.views=96 gpu=16GB``."""

from __future__ import annotations

from typing import TYPE_CHECKING

from raytran.run.entry import entry_point

if TYPE_CHECKING:
    from omegaconf import DictConfig


@entry_point("plan")
def main(cfg: DictConfig) -> None:
    """Run the command."""
    # Imported here so that --help answers at once.
    from raytran.run.plan.plan import plan

    plan(cfg)


if __name__ == "__main__":
    main()
