# SPDX-License-Identifier: Apache-2.0
"""Loggers of runs that are stopped and resumed: a CSV table, TensorBoard, Weights & Biases, MLflow."""

from __future__ import annotations

import csv
import io
import logging
import os
import secrets
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from netrc import NetrcParseError, netrc
from pathlib import Path
from typing import Any
from urllib.parse import urlparse

from lightning.pytorch.loggers import Logger, MLFlowLogger, TensorBoardLogger
from lightning.pytorch.utilities import rank_zero_only

from raytran.checkpoints.sweeps import RECORD, differences, read_record
from raytran.data.files import write_text
from raytran.errors import ConfigError
from raytran.training.history import read_table, step_of

_log = logging.getLogger(__name__)

WANDB_ID = "wandb-id.txt"
MLFLOW_ID = "mlflow-id.txt"

_OFFLINE = ("offline", "dryrun")
"""Values of WANDB_MODE with which W&B keeps to this machine; the second is its former name."""

_GROUP_RECORDS = (RECORD, "curriculum.json")
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
        is_known = {name for row in self._waiting for name in row} <= set(self._columns)
        try:
            # After a write that failed the file may end anywhere.
            if is_known and not self._failed and self.path.is_file():
                self._append(self._waiting)
            else:
                self._rewrite([*self._read(), *self._waiting])
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
        rows = [row for row in self._read() if (step_of(row) or 0) < step]
        self._rewrite(rows)

    def _append(self, rows: list[dict[str, Any]]) -> None:
        text = io.StringIO()
        csv.DictWriter(text, self._columns, lineterminator="\n").writerows(rows)
        size = self.path.stat().st_size
        try:
            with self.path.open("a", newline="", encoding="utf-8") as file:
                file.write(text.getvalue())
        except OSError:
            os.truncate(self.path, size)  # the disk was full in the middle of a row
            raise

    def _read(self) -> list[dict[str, Any]]:
        """Return the rows of the file and take over its columns."""
        columns, rows = read_table(self.path)
        self._columns = columns or self._columns
        return rows

    def _rewrite(self, rows: list[dict[str, Any]]) -> None:
        """Write the file anew; its columns count as known only once they are in it."""
        new = {name for row in rows for name in row} - set(self._columns)
        columns = [*self._columns, *sorted(new)]
        text = io.StringIO()
        writer = csv.DictWriter(text, columns, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
        write_text(self.path, text.getvalue())
        self._columns = columns


class ContinuedTensorBoard(TensorBoardLogger):
    """Writes further event files into the folder of a run; what is logged twice after a resume shows once.

    Where the files cannot be written, on a full disk for instance, that is said once and the run goes on.
    """

    _is_failure_told = False

    @rank_zero_only
    def log_metrics(self, metrics: Mapping[str, float], step: int | None = None) -> None:
        """Log values."""
        with self._told_once():
            super().log_metrics(metrics, step)

    @rank_zero_only
    def save(self) -> None:
        """Write what waits."""
        with self._told_once():
            super().save()

    @rank_zero_only
    def finalize(self, status: str) -> None:
        """Write what waits and close the file."""
        with self._told_once():
            super().finalize(status)

    @contextmanager
    def _told_once(self) -> Iterator[None]:
        try:
            yield
        except (OSError, ValueError) as error:
            failure = error if isinstance(error, OSError) else error.__cause__  # Lightning wraps it
            if not isinstance(failure, OSError):
                raise
            if not self._is_failure_told:
                said = "no more events for TensorBoard in %s (%s): make room there; training goes on"
                _log.warning(said, self.log_dir, failure.strerror)
            self._is_failure_told = True

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
        logger = ContinuedTensorBoard(save_dir=save_dir, name="tensorboard", version="")
    except ModuleNotFoundError as error:
        raise ConfigError(
            "TensorBoard is not installed: pip install 'raytran[tensorboard]', or choose another logger="
        ) from error
    threading.excepthook = partial(_leave_out_event_writers, before=threading.excepthook)
    return logger


def _leave_out_event_writers(
    failure: threading.ExceptHookArgs, *, before: Callable[[threading.ExceptHookArgs], Any]
) -> None:
    """Show why a thread ended, unless it writes events and could not: the logger says that."""
    is_writer = type(failure.thread).__name__ == "_AsyncWriterThread"
    if not (is_writer and isinstance(failure.exc_value, OSError)):
        before(failure)


def wandb_logger(*, project: str, name: str, save_dir: str, tags: Sequence[str | None] = ()) -> Any:
    """Return a logger to Weights & Biases, offline where the machine has no key; WANDB_MODE overrides.

    A resumed run goes on as the same run there: its id is kept in ``wandb-id.txt`` in the run's folder. But
    what was logged offline cannot be continued: ``wandb sync`` of a part may replace what was sent of another
    with the same id (wandb issues 3841, 5865). So each offline part, and what follows one, is a run of its
    own, ``NAME part 2``, in one group with the others. The runs of a sweep or a curriculum form a group too.

    Args:
        project: that the runs are in.
        name: of the run; a job of a sweep adds what is its own, ``seed=1``.
        save_dir: the run's folder.
        tags: by which runs are found again; None is left out.
    """
    # Imported here: it takes a second, and most runs do without.
    from lightning.pytorch.loggers import WandbLogger

    folder = Path(save_dir)
    mode = os.environ.get("WANDB_MODE")
    offline = mode in _OFFLINE or (mode is None and not _has_wandb_key())
    if mode is None and offline:
        _log.info("no W&B key found: logging offline in %s (send it later with `wandb sync`)", folder)
    folder.mkdir(parents=True, exist_ok=True)
    group, job = group_and_job(folder)
    ids = _ids_of_parts(folder, offline=offline)
    if group is None and (offline or len(ids) > 1):
        group = f"{folder.absolute().parent.name} {folder.absolute().name}"
    part = f"part {len(ids)}" if len(ids) > 1 else ""
    logger = WandbLogger(
        project=project,
        name=" ".join(word for word in (name, job, part) if word),
        group=group,
        save_dir=save_dir,
        offline=offline,
        id=ids[-1],
        resume=None if offline else "allow",
        tags=[str(tag) for tag in dict.fromkeys(tags) if tag],
    )
    # Lightning hands on a setting that W&B no longer has, and warns of.
    logger._wandb_init.pop("anonymous", None)
    return logger


class ContinuedMLFlow(MLFlowLogger):
    """One MLflow run for a whole run, also after a resume: its id is kept in ``mlflow-id.txt``.

    MLflow forgets no value: steps that a resumed run does again have two. Where its store cannot be written
    or reached, that is said once and the run goes on.

    Args:
        folder: of the run.
        **settings: see Lightning's logger.
    """

    def __init__(self, *, folder: Path, **settings: Any) -> None:
        self._id_file = folder / MLFLOW_ID
        known = self._id_file.read_text(encoding="utf-8").strip() if self._id_file.is_file() else ""
        super().__init__(run_id=known or None, **settings)
        self._is_continued = bool(known)
        self._is_failure_told = False

    @rank_zero_only
    def log_hyperparams(self, params: Any) -> None:
        """Log the settings of a new run: MLflow lets nobody change them."""
        with self._told_once():
            if not self._is_continued:
                super().log_hyperparams(params)
            if not self._id_file.is_file():
                write_text(self._id_file, f"{self.run_id}\n")

    @rank_zero_only
    def log_metrics(self, metrics: Mapping[str, float], step: int | None = None) -> None:
        """Log values."""
        with self._told_once():
            super().log_metrics(metrics, step)

    @rank_zero_only
    def log_pictures(self, pictures: Mapping[str, Path], step: int) -> None:
        """Keep pictures of a step as artifacts.

        Args:
            pictures: files by name, ``<scene>/masks`` and so on.
            step: of the run.
        """
        with self._told_once():
            for name, path in pictures.items():
                folder = f"pictures/step-{step:06d}/{name.rpartition('/')[0]}"
                self.experiment.log_artifact(self.run_id, str(path), folder)

    @rank_zero_only
    def finalize(self, status: str = "success") -> None:
        """Mark the run as ended."""
        with self._told_once():
            super().finalize(status)

    @contextmanager
    def _told_once(self) -> Iterator[None]:
        from mlflow.exceptions import MlflowException

        try:
            yield
        except (OSError, MlflowException) as error:
            if not self._is_failure_told:
                reason = str(error).partition("\n")[0]
                _log.warning("MLflow is not told everything (%s); training goes on", reason)
            self._is_failure_told = True


def mlflow_logger(*, experiment: str, name: str, save_dir: str, store: str) -> Any:
    """Return a logger to the MLflow server of MLFLOW_TRACKING_URI, else to ``<store>/mlflow.db``.

    The runs of a sweep or a curriculum have its name as their tag ``group``.

    Raises:
        ConfigError: the package is not installed.
    """
    folder = Path(save_dir)
    group, job = group_and_job(folder)
    settings: dict[str, Any] = {}
    if not os.environ.get("MLFLOW_TRACKING_URI"):
        root = Path(store).absolute()
        root.mkdir(parents=True, exist_ok=True)
        settings["tracking_uri"] = f"sqlite:///{root / 'mlflow.db'}"
        settings["artifact_location"] = (root / "mlflow").as_uri()
    else:
        settings["tracking_uri"] = os.environ["MLFLOW_TRACKING_URI"]
    try:
        return ContinuedMLFlow(
            folder=folder,
            experiment_name=experiment,
            run_name=" ".join(word for word in (name, job) if word),
            tags={} if group is None else {"group": group},
            **settings,
        )
    except ModuleNotFoundError as error:
        raise ConfigError(
            "MLflow is not installed: pip install 'raytran[mlflow]', or choose another logger="
        ) from error


def group_and_job(folder: Path) -> tuple[str | None, str]:
    """Return the sweep or curriculum that a run belongs to and its name in there; None and "" without one.

    Args:
        folder: of the run, e.g. ``outputs/sweeps/2026-01-31_12-00-00/0``, which gives
            ``("sweeps 2026-01-31_12-00-00", "seed=1")``, by what tells the job from the others of the sweep.
    """
    folder = folder.absolute()
    groups = [path for path in folder.parents if any((path / record).is_file() for record in _GROUP_RECORDS)]
    if not groups:
        return None, ""
    outermost = groups[-1]  # a sweep of curricula is one group
    return f"{outermost.parent.name} {outermost.name}", _name_in(outermost, folder.relative_to(outermost))


def _name_in(group: Path, run: Path) -> str:
    """Return the name of a run in its group: its folder, but for a job of a sweep what is its own."""
    if not (group / RECORD).is_file():
        return run.as_posix()
    try:
        record = read_record(group)
    except ConfigError:
        return run.as_posix()  # a name is nothing to end a run for
    for job, own in zip(record["jobs"], differences(record), strict=True):
        if own and run.is_relative_to(job["folder"]):
            stage = run.relative_to(job["folder"]).parts
            return " ".join([*own, *stage])
    return run.as_posix()


def _ids_of_parts(folder: Path, *, offline: bool) -> list[str]:
    """Return the ids of a run's parts, the last of them that to log with, and write down a new one.

    An id is used again for a run that was online and is so now, and if nothing was logged with it yet.
    """
    path = folder / WANDB_ID
    ids = path.read_text(encoding="utf-8").split() if path.is_file() else []
    if ids and getattr(rank_zero_only, "rank", 0) != 0:
        return ids  # only the first rank talks to W&B
    if not ids or any(folder.glob(f"wandb/{'*' if offline else 'offline-'}run-*-{ids[-1]}")):
        ids.append(secrets.token_hex(4))
        write_text(path, "".join(f"{known}\n" for known in ids))
    return ids


def _has_wandb_key() -> bool:
    """Look where ``wandb login`` and its documentation put a key, without asking a server."""
    if os.environ.get("WANDB_API_KEY") or os.environ.get("WANDB_IDENTITY_TOKEN_FILE"):
        return True
    host = urlparse(os.environ.get("WANDB_BASE_URL", "https://api.wandb.ai")).hostname or ""
    try:
        return netrc(os.environ.get("NETRC") or Path.home() / ".netrc").authenticators(host) is not None
    except (OSError, NetrcParseError):
        return False
