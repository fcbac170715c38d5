# SPDX-License-Identifier: Apache-2.0
"""Look at predicted scenes in a browser: ``raytran view FOLDER``."""

from __future__ import annotations

from typing import TYPE_CHECKING

from raytran.run.entry import entry_point

if TYPE_CHECKING:
    from omegaconf import DictConfig


@entry_point("view")
def main(cfg: DictConfig) -> None:
    """Run the command."""
    # Imported here so that --help answers at once.
    from raytran.run.view import view

    view(cfg)


if __name__ == "__main__":
    main()
