# SPDX-License-Identifier: Apache-2.0
"""Write a data set: ``raytran prepare dataset=rooms output=DIR``."""

from __future__ import annotations

from typing import TYPE_CHECKING

from raytran.run.entry import entry_point

if TYPE_CHECKING:
    from omegaconf import DictConfig


@entry_point("prepare")
def main(cfg: DictConfig) -> None:
    """Run the command."""
    # Imported here so that --help answers at once.
    from raytran.run.prepare.prepare import prepare

    prepare(cfg)


if __name__ == "__main__":
    main()
