# SPDX-License-Identifier: Apache-2.0
"""The whole path on generated rooms, without a download, on a CPU: ``raytran demo``."""

from __future__ import annotations

from typing import TYPE_CHECKING

from raytran.run.entry import entry_point, typed_settings

if TYPE_CHECKING:
    from omegaconf import DictConfig


@entry_point("demo")
def main(cfg: DictConfig) -> None:
    """Run the command."""
    # Imported here so that --help answers at once.
    from hydra.core.hydra_config import HydraConfig

    from raytran.run.demo.demo import demo

    demo(cfg, typed_settings(HydraConfig.get()))


if __name__ == "__main__":
    main()
