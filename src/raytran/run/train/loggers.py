# SPDX-License-Identifier: Apache-2.0
"""Loggers that need more than a constructor call, and reading back what the CSV logger wrote."""

from __future__ import annotations

import logging
import os
import secrets
from netrc import NetrcParseError, netrc
from pathlib import Path
from typing import Any
from urllib.parse import urlparse

from raytran.data.files import write_text
from raytran.errors import ConfigError
from raytran.training.metrics_table import read_table

_log = logging.getLogger(__name__)

METRICS = "metrics.csv"


WANDB_ID = "wandb-id.txt"


def wandb_logger(*, project: str, name: str, save_dir: str) -> Any:
    """Return a logger to Weights & Biases, offline where the machine has no key; WANDB_MODE overrides.

    A resumed run goes on as the same run there: its id is kept in ``wandb-id.txt`` in the run's folder.
    """
    from lightning.pytorch.loggers import WandbLogger

    offline = "WANDB_MODE" not in os.environ and not _has_wandb_key()
    if offline:
        _log.info("no W&B key found: logging offline in %s (send it later with `wandb sync`)", save_dir)
    Path(save_dir).mkdir(parents=True, exist_ok=True)
    return WandbLogger(
        project=project,
        name=name,
        save_dir=save_dir,
        offline=offline,
        id=_kept_id(Path(save_dir) / WANDB_ID),
        resume=None if offline else "allow",  # offline, `wandb sync` puts parts of one id together
    )


def _kept_id(path: Path) -> str:
    """Return the id in a file; a new one, written there, where there is none."""
    if not path.is_file():
        # Only the first rank talks to W&B, so it does not matter whose id is kept if several begin at once.
        write_text(path, secrets.token_hex(4) + "\n")
    return path.read_text(encoding="utf-8").strip()


def _has_wandb_key() -> bool:
    """Look where ``wandb login`` and its documentation put a key, without asking a server."""
    if os.environ.get("WANDB_API_KEY") or os.environ.get("WANDB_IDENTITY_TOKEN_FILE"):
        return True
    host = urlparse(os.environ.get("WANDB_BASE_URL", "https://api.wandb.ai")).hostname or ""
    try:
        return netrc(os.environ.get("NETRC") or Path.home() / ".netrc").authenticators(host) is not None
    except (OSError, NetrcParseError):
        return False


def tensorboard_logger(*, save_dir: str) -> Any:
    """Return a logger for TensorBoard that writes into ``<save_dir>/tensorboard``, also after a resume.

    Raises:
        ConfigError: the package is not installed.
    """
    from raytran.training.tensorboard import ContinuedTensorBoard

    try:
        return ContinuedTensorBoard(save_dir=save_dir, name="tensorboard", version="")
    except ModuleNotFoundError as error:
        raise ConfigError(
            "TensorBoard is not installed: pip install 'raytran[tensorboard]', or choose another logger="
        ) from error


def read_history(folder: Path) -> dict[str, list[tuple[int, float]]]:
    """Return what a run logged: name → (step, value) pairs by rising step.

    Args:
        folder: of the run.
    """
    return read_table(folder / METRICS)
