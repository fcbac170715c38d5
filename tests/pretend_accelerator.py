# SPDX-License-Identifier: Apache-2.0
"""The pretend GPU for Lightning's Trainer."""

from __future__ import annotations

import torch
from lightning.pytorch.accelerators import Accelerator, AcceleratorRegistry
from lightning.pytorch.strategies import SingleDeviceStrategy, StrategyRegistry

from .pretend_device import DEVICE, NAME


def register_with_lightning():
    """Let ``trainer.accelerator`` and ``trainer.strategy`` be ``pretend``.

    Under autocast set ``trainer.precision_plugin.device`` too: Lightning takes all but the CPU for CUDA.
    """
    AcceleratorRegistry.register(NAME, PretendAccelerator, override=True)
    StrategyRegistry.register(NAME, SingleDeviceStrategy, override=True, device=torch.device(DEVICE))


class PretendAccelerator(Accelerator):
    """What Lightning wants to know of a device."""

    def setup_device(self, device):
        pass

    def teardown(self):
        pass

    @staticmethod
    def parse_devices(devices):
        return devices

    @staticmethod
    def get_parallel_devices(devices):
        return [torch.device(DEVICE)]

    @staticmethod
    def auto_device_count():
        return 1

    @staticmethod
    def is_available():
        return True

    @staticmethod
    def name():
        return NAME
