# SPDX-License-Identifier: Apache-2.0
"""The switches that people type, with their types, and what a run was given."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from raytran.checkpoints.network import trusted_packages
from raytran.errors import ConfigError
from raytran.run.device import check_matmul_precision

CONFIG = "config.yaml"
"""File with all settings of a run, in its folder."""

PROGRESS_BARS = ("rich", "tqdm", "none")
PARENT_CHECKS = ("scores", "stage", "none")


def does_compile(choice: Any) -> bool:
    """Return whether the network is compiled.

    ``auto`` leaves it: that a compiled network is right and faster on a GPU has not been measured yet.

    Raises:
        ConfigError: there is no such choice.
    """
    if not isinstance(choice, bool) and choice != "auto":
        raise ConfigError(f"unknown compile={choice}: choose auto, true or false")
    return choice is True


@dataclass
class RunConfig:
    """Top level of ``conf/train.yaml``, checked before anything is built.

    Attributes:
        preset: name of the preset, part of the run's folder.
        experiment: name of the experiment, part of the run's folder.
        seed: of weights, order and frames.
        outputs: top folder of all runs, searched by ``init_from=auto``.
        output_dir: folder of this run.
        init_from: ``auto``, ``none``, or a checkpoint whose weights to start from.
        check_parent: ``scores`` refuses a parent of another stage or one that has not learned its task,
            ``stage`` only the former, ``none`` nothing.
        resume: ``none``, ``auto``, or the checkpoint of an interrupted run to continue.
        matmul_precision: of float32 products and convolutions, see ``set_matmul_precision``.
        compile: run the network through ``torch.compile``: true, false or ``auto``, see ``does_compile``.
        checkpoint_every: optimiser steps between two writings of the last checkpoint.
        progress_bar: ``rich``, ``tqdm`` or ``none``.
        trust: packages of one's own whose classes the network names, see ``trusted_packages``.
    """

    preset: str
    experiment: str
    seed: int
    outputs: str
    output_dir: str
    init_from: str
    check_parent: str
    resume: str
    matmul_precision: str
    compile: Any
    checkpoint_every: int
    progress_bar: str
    trust: list[str]

    @staticmethod
    def read(cfg: DictConfig) -> RunConfig:
        """Return the checked switches of a composed config.

        Raises:
            ConfigError: a switch has a value of the wrong type or none that exists.
        """
        values = {field.name: cfg[field.name] for field in fields(RunConfig)}
        try:
            typed = OmegaConf.to_object(OmegaConf.merge(OmegaConf.structured(RunConfig), values))
        except OmegaConfBaseException as error:
            raise ConfigError(f"{error.full_key}: {str(error).splitlines()[0]}") from error
        if not isinstance(typed, RunConfig):
            raise ConfigError(f"expected the settings of a run, got {type(typed).__name__}")
        if typed.progress_bar not in PROGRESS_BARS:
            raise ConfigError(
                f"unknown progress_bar={typed.progress_bar}: choose one of {', '.join(PROGRESS_BARS)}"
            )
        check_matmul_precision(typed.matmul_precision)
        does_compile(typed.compile)
        if typed.check_parent not in PARENT_CHECKS:
            raise ConfigError(
                f"unknown check_parent={typed.check_parent}: choose one of {', '.join(PARENT_CHECKS)}"
            )
        if typed.checkpoint_every < 1:
            raise ConfigError(f"checkpoint_every must be at least 1, got {typed.checkpoint_every}")
        trusted_packages(typed.trust)
        return typed


def given_steps(folder: Path) -> int | None:
    """Return how many steps the run in ``folder`` was to take, below 0 for no end, None if it does not say.

    It may have finished with fewer, where its scores got no better.
    """
    try:
        steps = OmegaConf.select(OmegaConf.load(folder / CONFIG), "trainer.max_steps")
    except (OSError, ValueError, YAMLError, OmegaConfBaseException):
        return None
    return steps if isinstance(steps, int) else None
