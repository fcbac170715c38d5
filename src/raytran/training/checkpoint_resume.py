# SPDX-License-Identifier: Apache-2.0
"""What a checkpoint must say beyond the weights for a resumed run to go on as if it had never stopped."""

from __future__ import annotations

import random
from typing import Any

import numpy as np
import torch
from torch import Tensor

from raytran.errors import CheckpointError


def random_states(device: torch.device) -> dict[str, Any]:
    """Return the states of all sources of randomness of this process, as tensors and plain Python."""
    version, numbers, gauss = random.getstate()
    numpy = np.random.get_state(legacy=False)  # noqa: NPY002 - the global source is meant
    return {
        "python": [version, list(numbers), gauss],
        "numpy": {
            "key": numpy["state"]["key"].tolist(),
            "pos": int(numpy["state"]["pos"]),
            "has_gauss": int(numpy["has_gauss"]),
            "gauss": float(numpy["gauss"]),
        },
        "torch": torch.get_rng_state(),
        "cuda": torch.cuda.get_rng_state(device) if device.type == "cuda" else None,
    }


def set_random_states(states: dict[str, Any], device: torch.device) -> None:
    """Put the sources of randomness where ``random_states`` found them.

    Raises:
        CheckpointError: ``states`` is not what ``random_states`` gave.
    """
    try:
        version, numbers, gauss = states["python"]
        random.setstate((version, tuple(numbers), gauss))
        numpy = states["numpy"]
        key = np.array(numpy["key"], dtype=np.uint32)
        np.random.set_state(("MT19937", key, numpy["pos"], numpy["has_gauss"], numpy["gauss"]))  # noqa: NPY002
        torch.set_rng_state(states["torch"])
        if device.type == "cuda" and isinstance(states["cuda"], Tensor):
            torch.cuda.set_rng_state(states["cuda"], device)
    except (LookupError, TypeError, ValueError, RuntimeError, AttributeError) as error:
        raise CheckpointError(
            "the random states in the checkpoint are damaged: start a new run with init_from="
        ) from error


def loop_state(step: int, *, accumulate: int, validation_due: bool) -> dict[str, Any]:
    """Return Lightning's counters after ``step`` optimiser steps of one endless epoch.

    Lightning saves its counters as they stand in the hook that asks for it, and reads them back with rules of
    its own for each hook: a checkpoint written between a step and its validation, or in front of the next
    step, would skip a validation or count a step twice. Written anew from the step number they mean one
    thing: the step is done, and so is what followed it, but for the validation if that is due.

    Args:
        step: optimiser steps done, at least 1.
        accumulate: batches to a step.
        validation_due: the run stopped in the validation after this step.
    """

    def both(**counters: int) -> dict[str, dict[str, int]]:
        return {"total": dict(counters), "current": dict(counters)}

    batches = step * accumulate
    loops = {
        "state_dict": {},
        "epoch_progress": both(ready=1, started=1, processed=0, completed=0),
        # "completed" lags by one as in on_train_batch_end; Lightning counts it and the logged step up again.
        "epoch_loop.batch_progress": {
            **both(ready=batches, started=batches, processed=batches, completed=batches - 1),
            "is_last_batch": False,
        },
        "epoch_loop.state_dict": {"_batches_that_stepped": step - 2 if validation_due else step - 1},
        "epoch_loop.scheduler_progress": both(ready=step, completed=step),
        "epoch_loop.automatic_optimization.optim_progress": {
            "optimizer": {
                "step": both(ready=step, completed=step),
                "zero_grad": both(ready=step, started=step, completed=step),
            }
        },
    }
    if validation_due:
        # One validation batch begun and not done: Lightning goes back and validates, from the first scene.
        loops["epoch_loop.val_loop.batch_progress"] = {
            "total": {"ready": 1, "started": 1, "processed": 0, "completed": 0},
            "current": {"ready": 0, "started": 0, "processed": 0, "completed": 0},
            "is_last_batch": False,
        }
    return {"fit_loop": loops}
