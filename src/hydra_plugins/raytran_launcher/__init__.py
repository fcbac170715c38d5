# SPDX-License-Identifier: Apache-2.0
"""The launcher of sweeps where Hydra looks for plugins; ``raytran.run.sweep.launcher`` does the work."""

from __future__ import annotations

from collections.abc import Sequence

from hydra.core.utils import JobReturn
from hydra.plugins.launcher import Launcher
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig


class ProcessLauncher(Launcher):
    """Runs each job of a sweep as a command of its own.

    Args:
        parallel: jobs at a time, or ``auto``.
    """

    def __init__(self, parallel: int | str = "auto") -> None:
        self._parallel = parallel
        self._config: DictConfig | None = None
        self._context: HydraContext | None = None

    def setup(self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig) -> None:
        """Take what Hydra knows about this sweep."""
        self._config, self._context = config, hydra_context

    def launch(self, job_overrides: Sequence[Sequence[str]], initial_job_idx: int) -> Sequence[JobReturn]:
        """Run the jobs and return how each ended, in order."""
        # Imported here: Hydra imports every plugin whatever the command.
        from raytran.run.sweep.launcher import launch

        if self._config is None or self._context is None:
            raise RuntimeError("launch() was called before setup()")
        return launch(self._config, self._context.config_loader, job_overrides, parallel=self._parallel)
