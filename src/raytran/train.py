# SPDX-License-Identifier: Apache-2.0
"""Train one stage: ``raytran train experiment=stage1|stage2|stage3 preset=raytran|small|…``."""

from __future__ import annotations

from typing import TYPE_CHECKING

from raytran.run.entry import entry_point

if TYPE_CHECKING:
    from omegaconf import DictConfig


@entry_point("train")
def main(cfg: DictConfig) -> None:
    """Run the command."""
    # Imported here so that --help answers at once.
    from raytran.run.train.fit import train
    from raytran.run.train.next_command import tell_after_stage

    tell_after_stage(cfg, train(cfg))


if __name__ == "__main__":
    main()
