# SPDX-License-Identifier: Apache-2.0
"""Loggers of runs that are stopped and resumed: a CSV table, TensorBoard, Weights & Biases."""

from __future__ import annotations

import csv
import io
import logging
import os
import secrets
from netrc import NetrcParseError, netrc
from pathlib import Path
from typing import Any
from urllib.parse import urlparse

from lightning.pytorch.loggers import Logger, TensorBoardLogger
from lightning.pytorch.utilities import rank_zero_only

from raytran.data.files import write_text
from raytran.errors import ConfigError

_log = logging.getLogger(__name__)

METRICS = "metrics.csv"
WANDB_ID = "wandb-id.txt"

_GROUP_RECORDS = ("sweep.json", "curriculum.json")
"""Files by which the folder of a sweep or of a curriculum is known."""


def was_logged_step(trainer: Any) -> bool:
    """Say, after a step, whether it is one of those whose losses Lightning logs."""
    return trainer.global_step % trainer.log_every_n_steps == 0


def is_logged_step(trainer: Any) -> bool:
    """Say, in a step, whether its losses will be shown."""
    return (trainer.global_step + 1) % trainer.log_every_n_steps == 0


class MetricsTable(Logger):
    """One CSV file for a whole run: a resumed run appends to it, without a step that comes twice.

    (Lightning's own logger starts another file then, or deletes the one that is there.)

    Args:
        path: the file. Its first columns are ``step`` and ``epoch``.
    """

    def __init__(self, path: str | Path) -> None:
        super().__init__()
        self.path = Path(path)
        self._columns = ["step", "epoch"]
        self._waiting: list[dict[str, Any]] = []
        self._failed = False

    @property
    def name(self) -> str:
        """Return the name of the file without its ending."""
        return self.path.stem

    @property
    def version(self) -> int:
        """Return 0: there is one table."""
        return 0

    @property
    def save_dir(self) -> str:
        """Return the folder of the file."""
        return str(self.path.parent)

    @rank_zero_only
    def log_metrics(self, metrics: dict[str, Any], step: int | None = None) -> None:
        """Add values to the row of their step; ``save`` writes it."""
        if self._waiting and self._waiting[-1]["step"] == step:
            self._waiting[-1] |= metrics
        else:
            self._waiting.append({**metrics, "step": step})

    @rank_zero_only
    def log_hyperparams(self, *_: Any, **__: Any) -> None:
        """Do nothing: ``config.yaml`` holds the settings."""

    @rank_zero_only
    def save(self) -> None:
        """Write the rows that wait; on a full disk they wait on."""
        if not self._waiting:
            return
        known = set(self._columns)
        new = sorted({name for row in self._waiting for name in row} - known)
        try:
            if new or not self.path.is_file():
                rows = [*self._read(), *self._waiting]
                self._columns += new
                self._rewrite(rows)
            else:
                with self.path.open("a", newline="", encoding="utf-8") as file:
                    writer = csv.DictWriter(file, self._columns, lineterminator="\n")
                    writer.writerows(self._waiting)
        except OSError as error:
            if not self._failed:
                reason = error.strerror
                _log.warning("cannot write %s (%s): make room there; training goes on", self.path, reason)
            self._failed = True
            return
        self._failed = False
        self._waiting.clear()

    @rank_zero_only
    def finalize(self, status: str) -> None:
        """Write the rows that wait."""
        self.save()

    @rank_zero_only
    def continue_from(self, step: int) -> None:
        """Forget what was logged at ``step`` and later: the run does these steps again."""
        if not self.path.is_file():
            return
        rows = [row for row in self._read() if int(row["step"]) < step]
        self._rewrite(rows)

    def _read(self) -> list[dict[str, Any]]:
        """Return the rows of the file, but for a last line that a kill cut short; take over its columns."""
        if not self.path.is_file():
            return []
        lines = self.path.read_text(encoding="utf-8").splitlines(keepends=True)
        rows = csv.DictReader(line for line in lines if line.endswith("\n"))
        self._columns = list(rows.fieldnames or self._columns)
        return list(rows)

    def _rewrite(self, rows: list[dict[str, Any]]) -> None:
        text = io.StringIO()
        writer = csv.DictWriter(text, self._columns, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
        write_text(self.path, text.getvalue())


def read_history(folder: Path) -> dict[str, list[tuple[int, float]]]:
    """Return what a run logged: name → (step, value) pairs by rising step.

    Args:
        folder: of the run.
    """
    path = folder / METRICS
    if not path.is_file():
        return {}
    history: dict[str, dict[int, float]] = {}
    with path.open(newline="", encoding="utf-8") as file:
        for row in csv.DictReader(file):
            for name, value in row.items():
                if name not in ("step", "epoch") and value:
                    history.setdefault(name, {})[int(row["step"])] = float(value)
    return {name: sorted(values.items()) for name, values in history.items()}


class ContinuedTensorBoard(TensorBoardLogger):
    """Writes further event files into the folder of a run; what is logged twice after a resume shows once."""

    @rank_zero_only
    def continue_from(self, step: int) -> None:
        """Forget what was logged at ``step`` and later: the run does these steps again."""
        if step == 0:
            return
        if self._experiment is not None:
            self._experiment.close()
            self._experiment = None
        # TensorBoard leaves out events of these steps in files that were begun before the next one is.
        self._kwargs["purge_step"] = step


def tensorboard_logger(*, save_dir: str) -> Any:
    """Return a logger for TensorBoard that writes into ``<save_dir>/tensorboard``, also after a resume.

    Raises:
        ConfigError: the package is not installed.
    """
    try:
        return ContinuedTensorBoard(save_dir=save_dir, name="tensorboard", version="")
    except ModuleNotFoundError as error:
        raise ConfigError(
            "TensorBoard is not installed: pip install 'raytran[tensorboard]', or choose another logger="
        ) from error


def wandb_logger(*, project: str, name: str, save_dir: str) -> Any:
    """Return a logger to Weights & Biases, offline where the machine has no key; WANDB_MODE overrides.

    A resumed run goes on as the same run there: its id is kept in ``wandb-id.txt`` in the run's folder. The
    runs of a sweep or a curriculum form a group.
    """
    # Imported here: it takes a second, and most runs do without.
    from lightning.pytorch.loggers import WandbLogger

    folder = Path(save_dir)
    offline = "WANDB_MODE" not in os.environ and not _has_wandb_key()
    if offline:
        _log.info("no W&B key found: logging offline in %s (send it later with `wandb sync`)", folder)
    folder.mkdir(parents=True, exist_ok=True)
    group, job = group_and_job(folder)
    return WandbLogger(
        project=project,
        name=f"{name} {job}".strip(),
        group=group,
        save_dir=save_dir,
        offline=offline,
        id=_kept_id(folder / WANDB_ID),
        resume=None if offline else "allow",  # offline, `wandb sync` puts parts of one id together
    )


def group_and_job(folder: Path) -> tuple[str | None, str]:
    """Return the sweep or curriculum that a run belongs to and its name in there; None and "" without one.

    Args:
        folder: of the run, e.g. ``outputs/sweeps/2026-01-31_12-00-00/0_seed=1``, which gives
            ``("sweeps 2026-01-31_12-00-00", "0_seed=1")``.
    """
    folder = folder.absolute()
    groups = [path for path in folder.parents if any((path / record).is_file() for record in _GROUP_RECORDS)]
    if not groups:
        return None, ""
    outermost = groups[-1]  # a sweep of curricula is one group
    return f"{outermost.parent.name} {outermost.name}", folder.relative_to(outermost).as_posix()


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
