# SPDX-License-Identifier: Apache-2.0
"""TensorBoard for runs that are stopped and resumed."""

from __future__ import annotations

from lightning.pytorch.loggers import TensorBoardLogger
from lightning.pytorch.utilities import rank_zero_only


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
