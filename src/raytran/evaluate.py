# SPDX-License-Identifier: Apache-2.0
"""Evaluate a checkpoint: ``raytran evaluate checkpoint=CKPT``."""

from __future__ import annotations

from typing import TYPE_CHECKING

from raytran.run.entry import entry_point

if TYPE_CHECKING:
    from omegaconf import DictConfig


@entry_point("evaluate")
def main(cfg: DictConfig) -> None:
    """Run the command."""
    # Imported here so that --help answers at once.
    from raytran.run.evaluate.evaluate import evaluate

    evaluate(cfg)


if __name__ == "__main__":
    main()
