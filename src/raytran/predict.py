# SPDX-License-Identifier: Apache-2.0
"""``python -m raytran.predict checkpoint=CKPT scene=FOLDER output=DIR``: a scene's objects and meshes."""

from __future__ import annotations

from omegaconf import DictConfig

from raytran.run.entry import entry_point
from raytran.run.predict import predict


@entry_point("predict")
def main(cfg: DictConfig) -> None:
    """Predict one scene."""
    predict(cfg)


if __name__ == "__main__":
    main()
