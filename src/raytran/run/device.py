# SPDX-License-Identifier: Apache-2.0
"""Which device a command outside of Lightning's Trainer uses."""

from __future__ import annotations

import torch

from raytran.errors import ConfigError


def choose_device(name: str) -> torch.device:
    """Return the device called ``name``; ``auto`` is the first GPU if there is one, else the CPU.

    Raises:
        ConfigError: there is no such device.
    """
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        device = torch.device(name)
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError) as error:
        reason = str(error).splitlines()[0]
        raise ConfigError(f"cannot use device={name} ({reason}): choose auto or cpu") from error
    return device
