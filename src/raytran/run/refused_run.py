# SPDX-License-Identifier: Apache-2.0
"""A command that is refused leaves no folder, though Hydra makes that of a run before anything is checked."""

from __future__ import annotations

import contextlib
import logging
import os
import shutil
from pathlib import Path

from raytran.checkpoints.runs import one_at_a_time
from raytran.errors import RaytranError

_BEFORE_TRAINING = {
    *("train.log", "curriculum.log", ".lock", "config.yaml", "provenance.json", "curriculum.json"),
    *("hydra.yaml", "overrides.yaml", "multirun.yaml", "sweep.json"),
}
"""Files of a run in which no step was taken, or of a sweep in which no job began."""


def remove_refused_run(folder: Path, *, outputs: Path) -> None:
    """Remove the folder of a run in which nothing has been done, and those above it that are empty then.

    Args:
        folder: of the run or sweep; left as it is if it holds anything of value, or if another process works
            in it.
        outputs: top folder of all runs, the last to be removed.
    """
    is_first_rank = all(os.environ.get(name, "0") == "0" for name in ("RANK", "LOCAL_RANK", "SLURM_PROCID"))
    if not is_first_rank or not folder.is_dir():
        return
    files = (Path(place, name) for place, _, names in os.walk(folder) for name in names)
    if any(file.name not in _BEFORE_TRAINING for file in files):
        return
    for handler in logging.getLogger().handlers[:]:
        if (
            isinstance(handler, logging.FileHandler)
            and Path(handler.baseFilename).parent == folder.absolute()
        ):
            handler.close()
            logging.getLogger().removeHandler(handler)
    with contextlib.suppress(OSError, RaytranError):
        with one_at_a_time(folder):
            pass  # nobody works there
        shutil.rmtree(folder)
        for above in folder.absolute().parents:
            if above.is_relative_to(outputs.absolute()):
                above.rmdir()
