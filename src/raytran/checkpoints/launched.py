# SPDX-License-Identifier: Apache-2.0
"""Ranks that torchrun or SLURM's srun has started agree on a folder before Lightning connects them."""

from __future__ import annotations

import os
from collections.abc import Callable
from datetime import datetime, timedelta

from raytran.errors import ConfigError, RaytranError

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
    # A store that torchrun keeps for its workers, in which a restarted group finds another shelf.
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
