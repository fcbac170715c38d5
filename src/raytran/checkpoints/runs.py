# SPDX-License-Identifier: Apache-2.0
"""The folders of runs: where a new one goes, which one to continue, which finished stage to start from.

A run lives in ``<outputs>/<preset>/<experiment>/<time>``. It holds ``checkpoints/last.ckpt`` and the one
before it while it goes on and, once its last step is done, ``finished.json``.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

from raytran.data.files import write_json
from raytran.data.locks import exclusive_lock
from raytran.data.text import as_name, read_json_object
from raytran.errors import CheckpointError, ConfigError, DataError, RaytranError
from raytran.limits import MAX_STEPS, as_count

STAGE_NAMES = {"occupancy": "stage1", "joint": "stage2", "shape": "stage3", "view": "novel_view"}
"""Former name of a stage → its name."""

LAST = Path("checkpoints") / "last.ckpt"
PREVIOUS = LAST.with_name("previous.ckpt")
FINISHED = "finished.json"
_LOCK = ".lock"


@dataclass(frozen=True)
class Finished:
    """What ``finished.json`` says.

    Attributes:
        stage: name of the stage that was trained.
        preset: the preset.
        experiment: the experiment.
        checkpoint: path of the final checkpoint, relative to the run's folder.
        steps: optimiser steps taken.
        time: when it finished, UTC, ISO 8601.
        data: what it was trained on, see ``DataIdentity``; None for a curriculum, and for older runs.
    """

    stage: str
    preset: str
    experiment: str
    checkpoint: str
    steps: int
    time: str
    data: dict[str, Any] | None = None


@contextmanager
def one_at_a_time(folder: Path) -> Iterator[int]:
    """Keep other processes from training in ``folder`` until the block ends or this process is killed.

    Gives the descriptor of the lock. A process that inherits it keeps the folder too.

    Raises:
        ConfigError: one does already.
    """

    def taken(who: str) -> ConfigError:
        return ConfigError(f"another process trains in {folder} ({who}): wait for it to end, or stop it")

    with exclusive_lock(folder / _LOCK, if_taken=taken) as descriptor:
        yield descriptor


def write_finished(
    folder: Path,
    *,
    stage: str,
    preset: str,
    experiment: str,
    steps: int,
    data: dict[str, Any] | None = None,
) -> Finished:
    """Mark the run in ``folder`` as finished and return the mark."""
    now = datetime.now(UTC).isoformat()
    mark = Finished(stage, preset, experiment, LAST.as_posix(), steps, now, data)
    write_json(folder / FINISHED, asdict(mark))
    return mark


def read_finished(folder: Path) -> Finished | None:
    """Return the mark of the run in ``folder``, None if it has not finished.

    Raises:
        CheckpointError: the file is damaged.
    """
    path = folder / FINISHED
    if not path.is_file():
        return None
    try:
        mark = Finished(**read_json_object(path))
        _check_mark(mark)
    except (DataError, TypeError) as error:
        raise CheckpointError(
            f"{path} is damaged: delete it and run that stage again with resume=auto"
        ) from error
    return replace(mark, stage=STAGE_NAMES.get(mark.stage, mark.stage))


def _check_mark(mark: Finished) -> None:
    """Raise DataError unless every part of a mark is what it should be."""
    for name in ("stage", "preset", "experiment", "time"):
        as_name(getattr(mark, name), name)
    as_count(mark.steps, 0, MAX_STEPS, "steps")
    checkpoint = Path(as_name(mark.checkpoint, "checkpoint"))
    if checkpoint.is_absolute() or ".." in checkpoint.parts or not isinstance(mark.data, dict | None):
        raise DataError("checkpoint leads out of the run's folder, or data is no object")


def finished_runs(
    outputs: Path, *, preset: str, stage: str, experiment: str | None = None
) -> list[tuple[Path, Finished]]:
    """Return the checkpoints of the finished runs of ``stage`` with ``preset`` and their marks, newest first.

    Args:
        outputs: top folder of all runs.
        preset: the preset.
        stage: name of the stage.
        experiment: the experiment; None for any. Networks of two experiments may differ (a fourth channel).
    """
    found = []
    for path in (outputs / preset).glob(f"**/{FINISHED}"):
        mark = read_finished(path.parent)
        if mark is None or (mark.stage, mark.preset) != (stage, preset):
            continue
        if experiment in (None, mark.experiment):
            checkpoint = path.parent / mark.checkpoint
            if checkpoint.is_file():
                found.append((checkpoint, mark))
    return sorted(found, key=lambda run: (run[1].time, run[0]), reverse=True)


def newest_unfinished(parent: Path, holds: Path) -> Path | None:
    """Return the newest folder in ``parent`` that has the file ``holds`` but no ``finished.json``.

    A checkpoint that is gone counts as long as the one before it is there.
    """
    if not parent.is_dir():
        return None
    names = [LAST, PREVIOUS] if holds == LAST else [holds]
    found = [
        (path.stat().st_mtime, folder)
        for folder in parent.iterdir()
        for path in (folder / name for name in names)
        if path.is_file() and not (folder / FINISHED).exists()
    ]
    return max(found)[1] if found else None


def run_folder(outputs: str, preset: str, experiment: str, resume: str, holds: str = LAST.as_posix()) -> str:
    """Return the folder for a run: that of the run to continue, or a new one named by the time.

    Args:
        outputs: top folder of all runs.
        preset: the preset.
        experiment: the experiment.
        resume: ``none``, ``auto``, or a checkpoint inside the folder of the run to continue.
        holds: the file that tells a folder worth continuing.

    Raises:
        ConfigError: ``resume`` names a file that is not the checkpoint of a run.
    """
    parent = Path(outputs) / preset / experiment
    if resume == "auto":
        unfinished = newest_unfinished(parent, Path(holds))
        if unfinished is not None:
            return str(unfinished)
    elif resume != "none":
        checkpoint = Path(resume)
        if checkpoint.parent.name != LAST.parent.name:
            raise ConfigError(
                f"resume={resume} is not inside the folder of a run (…/checkpoints/last.ckpt): "
                "give resume=auto, or init_from=CHECKPOINT to start a new run from its weights"
            )
        return str(checkpoint.parent.parent)
    return str(parent / name_by_time())


_WAIT = timedelta(minutes=10)
_REFUSED = "refused: "


def first_ranks(name: str, choose: Callable[[], str]) -> str:
    """Return what the first of torchrun's ranks chooses; without torchrun, what this process chooses.

    The ranks read clocks and folders each at its own moment: left alone, they would choose several folders.

    Args:
        name: of the choice, the same on all ranks.
        choose: makes the choice.

    Raises:
        RaytranError: the choice cannot be made, or the first rank cannot be asked.
    """
    if "TORCHELASTIC_RUN_ID" not in os.environ or os.environ.get("WORLD_SIZE", "1") == "1":
        return choose()
    # torchrun keeps a key-value store for its workers; after a restart of the group the keys are new ones.
    key = f"raytran/{os.environ.get('TORCHELASTIC_RESTART_COUNT', '0')}/{name}"
    from torch.distributed import TCPStore

    try:
        store = TCPStore(os.environ["MASTER_ADDR"], int(os.environ["MASTER_PORT"]), timeout=_WAIT)
        if os.environ["RANK"] != "0":
            choice = store.get(key).decode()
            if choice.startswith(_REFUSED):
                raise ConfigError(choice.removeprefix(_REFUSED))
            return choice
    except (RuntimeError, KeyError, ValueError) as error:
        raise ConfigError(
            f"this process cannot ask torchrun's first one for {name} ({error}): give output_dir= to all"
        ) from error
    try:
        choice = choose()
    except RaytranError as error:
        store.set(key, f"{_REFUSED}{error}")
        raise
    store.set(key, choice)
    return choice


def name_by_time() -> str:
    """Return the name of a new run's folder: the time, or in SLURM's jobs of several tasks the job's number.

    Raises:
        ConfigError: several nodes were started by hand, whose clocks differ.
    """
    if os.environ.get("SLURM_NTASKS", "1") != "1" and "SLURM_PROCID" in os.environ:
        return f"job_{os.environ['SLURM_JOB_ID']}_{os.environ.get('SLURM_STEP_ID', '0')}"
    if (
        "NODE_RANK" in os.environ
        and "TORCHELASTIC_RUN_ID" not in os.environ
        and "LOCAL_RANK" not in os.environ
    ):
        raise ConfigError(
            "with NODE_RANK set by hand the nodes cannot agree on a folder: "
            "start them with torchrun or srun, or give the same output_dir= to all"
        )
    return datetime.now().strftime("%Y-%m-%d_%H-%M-%S")
