# SPDX-License-Identifier: Apache-2.0
"""Part 1: is this machine fit for training?"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from importlib import metadata
from typing import Any

import torch
from record import circumstances

from gpu_day.context import Context

BAD_CUDNN = (90800, 91500)
"""cuDNN 9.8 to 9.14: PyTorch does without it in 3D convolutions of 16 bits (pytorch #163539, #166643), which
then take several times the memory."""

SHARED_MEMORY = 0.25e9
"""Bytes of /dev/shm that a GPU's loader wants: four workers, two scenes of 25 MB each (paper preset)."""


def examine(context: Context) -> None:
    """Look at versions, memory shared between processes, and what joins the GPUs."""
    checks = context.checks
    checks.machine(_machine())
    with checks.attempt("GPUs"):
        names = [torch.cuda.get_device_name(index) for index in range(torch.cuda.device_count())]
        checks.add("GPUs", measured=", ".join(names) or "none", notes=_said("nvidia-smi"))
    with checks.attempt("torch"):
        checks.add("torch", measured=f"{torch.__version__}, CUDA {torch.version.cuda or 'none'}")
    _triton(context)
    _cudnn(context)
    _shared_memory(context)
    if torch.cuda.device_count() > 1:
        topology = _said("nvidia-smi", "topo", "-m")
        checks.add(
            "how the GPUs are joined",
            measured="below" if topology else "nvidia-smi does not say",
            notes=topology,
        )
    with checks.attempt("packages", "pip check finds nothing"):
        done = subprocess.run(
            [sys.executable, "-m", "pip", "check"], capture_output=True, text=True, check=False
        )
        said = (done.stdout + done.stderr).strip().splitlines()
        checks.add(
            "packages",
            bar="pip check finds nothing",
            measured=f"{said[0] if said else 'nothing said'}{' …' if len(said) > 1 else ''}",
            passed=done.returncode == 0,
            notes=said if done.returncode else (),
        )


def _machine() -> dict[str, Any]:
    about = circumstances() | {"cudnn": torch.backends.cudnn.version(), "nccl": ""}
    count = torch.cuda.device_count()
    if count:
        about["gpu"] = f"{count} × {about['gpu']}"
        about["nccl"] = ".".join(map(str, torch.cuda.nccl.version()))
    return about


def _triton(context: Context) -> None:
    bar = "installed, and the one that this torch asks for"
    with context.checks.attempt("Triton", bar):
        found = metadata.version("triton")
        wanted = [line for line in metadata.requires("torch") or [] if line.lower().startswith("triton")]
        asked = wanted[0].split(";")[0].strip() if wanted else ""
        fits = not asked or _satisfies(found, asked)
        context.checks.add(
            "Triton", bar=bar, measured=f"{found}{f' for {asked}' if asked else ''}", passed=fits
        )


def _satisfies(version: str, requirement: str) -> bool:
    from packaging.requirements import Requirement

    return Requirement(requirement).specifier.contains(version)


def _cudnn(context: Context) -> None:
    version, bar = torch.backends.cudnn.version(), "not 9.8 to 9.14"
    if version is None:
        context.checks.add("cuDNN", bar=bar, why="this torch has none")
        return
    words = f"{version // 10000}.{version // 100 % 100}.{version % 100}"
    bad = BAD_CUDNN[0] <= version < BAD_CUDNN[1]
    remedy = (
        "3D convolutions of 16 bits go without it: install another torch, or a newer nvidia-cudnn"
        if bad
        else ""
    )
    context.checks.add("cuDNN", bar=bar, measured=words, passed=not bad, why=remedy)


def _shared_memory(context: Context) -> None:
    wanted = SHARED_MEMORY * max(torch.cuda.device_count(), 1)
    bar = f"/dev/shm ≥ {wanted / 1e9:.2g} GB, for the loaders"
    with context.checks.attempt("shared memory", bar):
        size = shutil.disk_usage("/dev/shm").total
        remedy = "" if size >= wanted else "start the container with --shm-size=8g or --ipc=host"
        context.checks.add(
            "shared memory", bar=bar, measured=f"{size / 1e9:.2f} GB", passed=size >= wanted, why=remedy
        )


def _said(*command: str) -> list[str]:
    """Return the lines that a command prints, none if there is no such command."""
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, check=True, env=os.environ | {"LC_ALL": "C"}
        )
    except (OSError, subprocess.CalledProcessError):
        return []
    return done.stdout.rstrip().splitlines()
