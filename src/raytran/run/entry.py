# SPDX-License-Identifier: Apache-2.0
"""What all commands share: Hydra around a function, errors of the user's making as one sentence."""

from __future__ import annotations

import functools
import os
import re
import sys
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import hydra
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import ConfigCompositionException, InstantiationException, OverrideParseException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from raytran.checkpoints.runs import STAGE_NAMES, first_ranks, run_folder
from raytran.errors import ConfigError, RaytranError
from raytran.run.config_dir import config_dir
from raytran.run.sweep.folder import register_sweep_resolver

_FULL_ERROR = "HYDRA_FULL_ERROR"
"""Hydra's own switch: with it set to 1, errors are shown at length."""

_RENAMED = (
    (r"experiment=(gt_masks|unprojection)_(\w+)", r"variant=\1 experiment=\2"),
    (r"experiment=frames_(\d+)", r"num_views=\1"),
    (r"experiment=objects_(\d+)", r"max_objects=\1"),
    (r"model\.backbone\.resnet\.", "model.backbone.encoder."),
    (r"model\.backbone\.norm_momentum=", "norm_momentum="),
    (r"model\.backbone\.start_levels=0", "model.backbone.voxel_network=null"),
    (r"model\.heads\.objects\.windowed=false", "model.heads.objects.voxel_attention=null"),
    (r"model\.heads\.objects\.refines=center", "model.heads.objects.refinement=null"),
    (r"model\.backbone\.start_levels=.*", "model/extensions=[unet3d]"),
    (r"model\.heads\.objects\.windowed=.*", "model/extensions=[windowed_attention]"),
    (r"model\.heads\.objects\.refines=.*", "model/extensions=[box_refinement]"),
    (r"model\.heads\.objects\.num_copies=.*", "model/extensions=[denoising]"),
    (r"model=unprojection", "model/backbone=unprojection"),
    (r"model/encoder=raytran", "model/encoder=resnet18"),
    (r"model/encoder=(tiny|small)", r"model/encoder=resnet18_\1"),
    (r"model/encoder=laptop", "model/encoder=efficientnet_lite0_laptop"),
    *((rf"(stage=|schedule\.){old}\b", rf"\g<1>{new}") for old, new in STAGE_NAMES.items()),
)
"""Settings of earlier versions as they were typed, and as they are typed now."""

_WITH_VALUE = {
    *("--cfg", "-c", "--config-dir", "-cd", "--config-path", "-cp", "--config-name", "-cn", "--info", "-i"),
}
"""Hydra's options that a word of their own may follow."""

_TYPED_FULL_ERROR = os.environ.get(_FULL_ERROR)

_SPIN_COUNT = "GOMP_SPINCOUNT"
"""How often an OpenMP thread asks whether there is work before it sleeps."""


def entry_point(config_name: str) -> Callable[[Callable[[DictConfig], Any]], Callable[[], Any]]:
    """Turn ``function(cfg)`` into a command configured by ``conf/<config_name>.yaml``.

    ``cfg.output_dir``, where there is one, is set to the absolute folder of this run. A ``RaytranError`` is
    printed as one sentence and the command exits with 1; any other exception is a defect, shown at length.
    """
    register_resolvers()
    register_sweep_resolver()
    _let_threads_sleep()

    def decorate(function: Callable[[DictConfig], Any]) -> Callable[[], Any]:
        typed = _TYPED_FULL_ERROR

        @functools.wraps(function)
        def task(cfg: DictConfig) -> Any:
            _set_full_error(typed)
            if "output_dir" in cfg:
                # Lightning starts further ranks with hydra.run.dir of the first: all share one folder.
                cfg.output_dir = HydraConfig.get().runtime.output_dir
            return run_or_exit(function, cfg)

        try:
            main = hydra.main(version_base="1.3", config_path=str(config_dir()), config_name=config_name)
        except ConfigError as error:
            _exit_with(error)
        return functools.partial(_compose_or_exit, main(task), typed)

    return decorate


def _let_threads_sleep() -> None:
    """Let torch's OpenMP threads wait for each other 0.1 ms and not several; before torch is imported.

    As soon as anything else wants the cores, threads that spin take them from those that they wait for: with
    as many other processes as cores, a prediction used two and a half times the processor time.
    """
    if "OMP_WAIT_POLICY" not in os.environ:
        os.environ.setdefault(_SPIN_COUNT, "10000")


def _compose_or_exit(command: Callable[[], Any], typed: str | None) -> Any:
    """Run a command; a setting that does not exist becomes a sentence instead of Hydra's paragraph."""
    _set_full_error("1")  # Hydra then raises instead of printing; the task restores what the user has set
    try:
        return command()
    except ConfigCompositionException as error:
        _set_full_error(typed)
        _exit_with(_no_such_setting(error, sys.argv[1:]))
    except OverrideParseException as error:
        _set_full_error(typed)
        _exit_with(ConfigError(f"{_first_line(error)}: settings are written key=value"))
    except RaytranError as error:  # of a sweep; those of a single run do not come so far
        _set_full_error(typed)
        _exit_with(error)
    except RuntimeError as error:
        _set_full_error(typed)
        if not str(error).startswith("Unknown plugin class"):
            raise
        extras = "'raytran[sweep]' brings Optuna's sweeper, 'raytran[cluster]' the launcher for SLURM"
        _exit_with(ConfigError(f"{_first_line(error)}: it is not installed; pip install {extras}"))
    except OmegaConfBaseException as error:
        _set_full_error(typed)
        # A resolver of ours that objects is wrapped by OmegaConf; its message is the clearer one.
        _exit_with(ConfigError(_first_line(error).split("resolving interpolation: ")[-1]))


def _no_such_setting(error: ConfigCompositionException, typed: Sequence[str]) -> ConfigError:
    """Return what to say of settings that Hydra does not know; of those it knew once, what they are now."""
    for word in typed:
        for pattern, now in _RENAMED:
            if re.match(pattern, word):
                return ConfigError(f"{word} is called {re.sub(pattern, now, word)} now: give that instead")
    return ConfigError(f"{_first_line(error)}: there is no such setting or choice (--help lists them)")


def _first_line(error: Exception) -> str:
    return str(error).splitlines()[0].rstrip(".")


def _set_full_error(value: str | None) -> None:
    if value is None:
        os.environ.pop(_FULL_ERROR, None)
    else:
        os.environ[_FULL_ERROR] = value


def user_environment() -> dict[str, str]:
    """Return the environment as the user has set it, for another command to be started with."""
    environment = {name: value for name, value in os.environ.items() if name != _FULL_ERROR}
    return environment if _TYPED_FULL_ERROR is None else environment | {_FULL_ERROR: _TYPED_FULL_ERROR}


def typed_config_dir(hydra_config: Any) -> list[str]:
    """Return ``--config-dir FOLDER`` if it was typed, so that another command finds the same configs.

    Args:
        hydra_config: the part ``hydra`` of the config of the command at work.
    """
    sources = hydra_config.runtime.config_sources
    folders = [str(Path(source.path).absolute()) for source in sources if source.provider == "command-line"]
    return ["--config-dir", *folders] if folders else []


def run_or_exit(function: Callable[[DictConfig], Any], cfg: DictConfig) -> Any:
    """Return ``function(cfg)``; a mistake of the user's becomes a sentence on stderr and exit code 1."""
    try:
        return function(cfg)
    except RaytranError as error:
        _exit_with(error)
    except InstantiationException as error:
        # Hydra wraps what a constructor raised; a message of ours is clearer without the wrapping.
        if isinstance(error.__cause__, RaytranError):
            _exit_with(error.__cause__)
        raise
    except OmegaConfBaseException as error:
        _exit_with(ConfigError(f"{str(error).splitlines()[0]} (see --cfg job for all settings)"))


def compose(config_name: str, overrides: Sequence[str]) -> DictConfig:
    """Compose a config as the command line would, inside a running command or in plain Python.

    Args:
        config_name: root file in ``conf/`` without ending.
        overrides: what a user would type, e.g. ``["preset=tiny", "experiment=stage2"]``. ``output_dir``
            must be among them if the result is to be run.

    Raises:
        ConfigError: there is no such setting or choice.
    """
    register_resolvers()
    register_sweep_resolver()
    already = GlobalHydra.instance().is_initialized()
    folder = nullcontext() if already else hydra.initialize_config_dir(str(config_dir()), version_base="1.3")
    with folder:
        try:
            return hydra.compose(config_name, overrides=list(overrides))
        except ConfigCompositionException as error:
            raise _no_such_setting(error, overrides) from error


def quoted(path: Path) -> str:
    """Return a path as Hydra's override grammar wants it."""
    escaped = str(path).replace("\\", "\\\\").replace('"', '\\"')
    return f'"{escaped}"'


def name_positional(words: Sequence[str], key: str) -> list[str]:
    """Return the words of a command line, with ``key=`` before one that is neither a setting nor an option.

    Args:
        words: as typed.
        key: setting that a word without a key means.
    """
    named: list[str] = []
    before = ""
    for word in words:
        is_path = "=" not in word and not word.startswith("-") and before not in _WITH_VALUE
        named.append(f"{key}={quoted(Path(word))}" if is_path else word)
        before = word
    return named


def _exit_with(error: RaytranError) -> None:
    sys.stderr.write(f"raytran: {error}\n")
    sys.stderr.flush()
    if os.environ.get(_FULL_ERROR) == "1":
        raise error
    raise SystemExit(1)


def register_resolvers() -> None:
    """Make ``${run_folder:…}`` known to the configs; evaluated once per command, by the first rank."""

    def resolve(*arguments: str) -> str:
        return first_ranks(f"the folder of {' '.join(arguments)}", lambda: run_folder(*arguments))

    OmegaConf.register_new_resolver("run_folder", resolve, use_cache=True, replace=True)
