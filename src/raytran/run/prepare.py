# SPDX-License-Identifier: Apache-2.0
"""Write a data set to disk."""

from __future__ import annotations

import logging
from pathlib import Path

from omegaconf import DictConfig

from raytran.data.rooms.generate import RoomsReport, generate_rooms
from raytran.errors import ConfigError
from raytran.run.build import plain

_log = logging.getLogger(__name__)

_ROOMS = (
    "num_train",
    "num_val",
    "seed",
    "frames",
    "image_size",
    "min_objects",
    "max_objects",
    "room_size",
    "processes",
)


def prepare(cfg: DictConfig) -> RoomsReport:
    """Run ``python -m raytran.prepare``; see ``conf/prepare.yaml``.

    Raises:
        ConfigError: the data set is unknown.
        DataError: ``output`` holds rooms made with other settings.
    """
    if cfg.dataset != "rooms":
        raise ConfigError(f"unknown dataset={cfg.dataset}: only dataset=rooms can be prepared")
    output = Path(cfg.output)
    report = generate_rooms(output, **{name: plain(cfg)[name] for name in _ROOMS})
    _log.info("rooms are in %s; train on them with data.root=%s", output.resolve(), output)
    return report
