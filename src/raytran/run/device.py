# SPDX-License-Identifier: Apache-2.0
"""Which device a command outside of Lightning's Trainer uses, and how exactly devices compute in float32."""

from __future__ import annotations

import torch

from raytran.errors import ConfigError

MATMUL_PRECISIONS = ("auto", "highest", "high", "medium")

CUDNN_FAULTY = range(90800, 91500)
"""9.8 to 9.14: torch from 2.9 on does not use them for 16-bit 3D convolutions (its ``Convolution.cpp``)."""


def choose_device(name: str) -> torch.device:
    """Return the device called ``name``; ``auto`` is a GPU of NVIDIA or AMD, else Apple's, else the CPU.

    Raises:
        ConfigError: there is no such device.
    """
    if name == "auto":
        if torch.cuda.is_available():
            return torch.device("cuda")
        return torch.device("mps" if torch.backends.mps.is_available() else "cpu")
    try:
        device = torch.device(name)
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError, NotImplementedError) as error:
        reason = str(error).splitlines()[0]
        if reason.startswith("Expected one of"):  # torch lists all it has ever known
            reason = "there is none of that name; a GPU is cuda, or cuda:1"
        raise ConfigError(f"cannot use device={name} ({reason}): choose auto or cpu") from error
    return device


def device_name(device: torch.device) -> str:
    """Return how to call a device in the log: ``the CPU (2 threads)``, or ``cuda:0 (NVIDIA H200)``."""
    if device.type == "cuda":
        return f"{device} ({torch.cuda.get_device_name(device)})"
    if device.type == "cpu":
        threads = torch.get_num_threads()
        return f"the CPU ({threads} thread{'s' if threads != 1 else ''})"
    return str(device)


def check_matmul_precision(name: str) -> None:
    """Do nothing for a precision that exists.

    Raises:
        ConfigError: there is no such precision.
    """
    if name not in MATMUL_PRECISIONS:
        raise ConfigError(f"unknown matmul_precision={name}: choose one of {', '.join(MATMUL_PRECISIONS)}")


def set_matmul_precision(name: str, device: torch.device) -> None:
    """Set for the whole process how exactly float32 matrices are multiplied and, on a GPU, convolved.

    ``auto`` leaves CPUs as they are: ``high`` would change results on those that know TF32. On a GPU it is
    ``high``: torch's own default there is TF32 for convolutions, and float32 at a fraction of the speed for
    the rest. Emulated on a CPU with raytran's weights, TF32 in products as well moved the centres of 35 boxes
    by 0.06 mm in the mean, TF32 in convolutions by 0.18 mm.

    Args:
        name: ``auto``, or a name of ``torch.set_float32_matmul_precision``.
        device: where the network runs.

    Raises:
        ConfigError: there is no such precision.
    """
    check_matmul_precision(name)
    on_gpu = device.type == "cuda"
    precision = ("high" if on_gpu else "highest") if name == "auto" else name
    torch.set_float32_matmul_precision(precision)
    if on_gpu:
        torch.backends.cudnn.allow_tf32 = precision != "highest"


def cudnn_warning(device: torch.device, precision: str) -> str | None:
    """Return what to say of a cuDNN whose 16-bit 3D convolutions are of no use, None where all is well.

    Args:
        device: where the network runs.
        precision: Lightning's name of it.
    """
    version = torch.backends.cudnn.version() or 0
    if device.type != "cuda" or "16" not in precision or version not in CUDNN_FAULTY:
        return None
    name = f"{version // 10000}.{version // 100 % 100}"
    return (
        f"cuDNN {name} has faulty 3D convolutions in 16 bits, which torch from 2.9 on replaces by slow ones "
        "that need several times the memory: install torch 2.11 or newer, or cuDNN 9.15 or newer "
        "(pytorch issues 163539, 166643)"
    )
