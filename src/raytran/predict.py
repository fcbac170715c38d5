# SPDX-License-Identifier: Apache-2.0
"""Predict the objects of a scene: ``raytran predict checkpoint=CKPT scene=FOLDER output=DIR``."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

from raytran.run.entry import entry_point

if TYPE_CHECKING:
    from omegaconf import DictConfig


@entry_point("predict")
def main(cfg: DictConfig) -> None:
    """Run the command."""
    logging.getLogger(__name__).info("predicting %s: loading the network …", cfg.scene)

    # Imported here so that --help answers at once.
    from raytran.run.predict.predict import predict

    predict(cfg)


if __name__ == "__main__":
    main()
