# SPDX-License-Identifier: Apache-2.0
"""Export a network: ``raytran export_model checkpoint=CKPT output=FILE.safetensors``."""

from __future__ import annotations

from typing import TYPE_CHECKING

from raytran.run.entry import entry_point

if TYPE_CHECKING:
    from omegaconf import DictConfig


@entry_point("export_model")
def main(cfg: DictConfig) -> None:
    """Run the command."""
    # Imported here so that --help answers at once.
    from raytran.run.export.export_model import export_model

    export_model(cfg)


if __name__ == "__main__":
    main()
