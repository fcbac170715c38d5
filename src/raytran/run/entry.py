# SPDX-License-Identifier: Apache-2.0
"""What all commands share: Hydra around a function, errors of the user's making as one sentence."""

from __future__ import annotations

import errno
import functools
import io
import os
import re
import shlex
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import nullcontext
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import hydra
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import (
    ConfigCompositionException,
    InstantiationException,
    MissingConfigException,
    OverrideParseException,
)
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from raytran.checkpoints.runs import STAGE_NAMES, first_ranks, run_folder
from raytran.data.files import disk_full
from raytran.data.workers import ENDS_WITH, end_with_parent
from raytran.errors import ConfigError, DataError, RaytranError
from raytran.run.config_dir import config_dir
from raytran.run.path_settings import check_run_folder, literal_paths, quoted
from raytran.run.sweep.folder import register_sweep_resolver
from raytran.setting_limits import check_settings

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

_KEY = re.compile(r"[+~]{0,2}[A-Za-z_][\w./@:-]*")

_SEVERAL_VALUES = re.compile(r"Ambiguous value for argument '(.*)'$", re.DOTALL)
"""How Hydra begins to say that a comma makes a sweep of a single run."""

_REFUSALS = {
    *(errno.ENAMETOOLONG, errno.ENOTDIR, errno.ELOOP, errno.EACCES, errno.EPERM),
    *(errno.EIO, errno.ESTALE, errno.EINVAL, errno.EILSEQ),
}
"""Numbers of errors by which a system says that a path will not do."""

_UNKNOWN = re.compile(r"Could not override '(.*)'$")
"""How Hydra begins to say that there is no such setting."""

_MOST_SUGGESTIONS = 3

_KEEP_A_LOG = ("train", "curriculum")
"""Commands for which Hydra writes files of its own into the folder of the run."""
_INTERRUPTED = 130
"""Exit code by which a shell knows that Ctrl-C ended a command."""

_WITH_VALUE = {
    *("--cfg", "-c", "--config-dir", "-cd", "--config-path", "-cp", "--config-name", "-cn", "--info", "-i"),
}
"""Hydra's options that a word of their own may follow."""

_WITH_OPTIONAL_VALUE = ("--info", "-i")
_STARTER_ENDED = (
    "the process that started this one has ended: it said why, or it was killed; give the same command "
    "again, with resume=auto to go on with a run"
)
_NUMBERS = re.compile(r"(up|intrinsics)=\s*([-+.\deE]+(?:\s*,\s*[-+.\deE]+)+)\s*")
"""Settings whose value may be several numbers, as typed."""

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
        return functools.partial(_compose_or_exit, config_name, main(task), typed)

    return decorate


def _let_threads_sleep() -> None:
    """Let torch's OpenMP threads wait for each other 0.1 ms and not several; before torch is imported.

    As soon as anything else wants the cores, threads that spin take them from those that they wait for: with
    as many other processes as cores, a prediction used two and a half times the processor time.
    """
    if "OMP_WAIT_POLICY" not in os.environ:
        os.environ.setdefault(_SPIN_COUNT, "10000")


def _compose_or_exit(name: str, command: Callable[[], Any], typed: str | None) -> Any:
    """Run a command; a setting that does not exist becomes a sentence instead of Hydra's paragraph."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # a file's name need not be text
    _end_with_starter()
    _set_full_error("1")  # Hydra then raises instead of printing; the task restores what the user has set
    sys.argv[1:] = with_number_lists(sys.argv[1:])
    try:
        if name in _KEEP_A_LOG:
            check_run_folder(sys.argv[1:])
        # Lightning starts further ranks with the words that it finds there.
        sys.argv[1:] = literal_paths(name, _options_first(sys.argv[1:]))
        return command()
    except ConfigCompositionException as error:
        _set_full_error(typed)
        _exit_with(_no_such_setting(name, error, sys.argv[1:]))
    except OverrideParseException as error:
        _set_full_error(typed)
        _exit_with(_unreadable_setting(error))
    except RaytranError as error:  # of a sweep; those of a single run do not come so far
        _set_full_error(typed)
        _exit_with(error)
    except RuntimeError as error:
        _set_full_error(typed)
        if not str(error).startswith("Unknown plugin class"):
            raise
        extras = "'raytran[sweep]' brings Optuna's sweeper, 'raytran[cluster]' the launcher for SLURM"
        _exit_with(ConfigError(f"{_first_line(error)}: it is not installed; pip install {extras}"))
    except OSError as error:
        _set_full_error(typed)
        _exit_if_refused(error)
        raise
    except OmegaConfBaseException as error:
        _set_full_error(typed)
        _exit_if_refused(error)
        # A resolver of ours that objects is wrapped by OmegaConf; its message is the clearer one.
        _exit_with(ConfigError(_first_line(error).split("resolving interpolation: ")[-1]))


def _end_with_starter() -> None:
    """End with the process that has started this command as a part of itself, if one has."""
    starter = os.environ.pop(ENDS_WITH, None)
    if starter is not None and starter.isdecimal():
        end_with_parent(_STARTER_ENDED, parent=int(starter))
    elif "TORCHELASTIC_RUN_ID" in os.environ:
        end_with_parent(_STARTER_ENDED)


def _options_first(words: Sequence[str]) -> list[str]:
    """Return the words of a command line with Hydra's options in front: it takes none between settings."""
    options: list[str] = []
    settings: list[str] = []
    before = ""
    for word in words:
        is_value = before in _WITH_VALUE and (before not in _WITH_OPTIONAL_VALUE or "=" not in word)
        (options if word.startswith("-") or is_value else settings).append(word)
        before = word
    return [*options, *settings]


def _no_such_setting(name: str, error: ConfigCompositionException, typed: Sequence[str]) -> ConfigError:
    """Return what to say of settings that Hydra does not know; of those it knew once, what they are now."""
    for word in typed:
        for pattern, now in _RENAMED:
            if re.match(pattern, word):
                return ConfigError(f"{word} is called {re.sub(pattern, now, word)} now: give that instead")
    if several := _SEVERAL_VALUES.match(_first_line(error)):
        return ConfigError(
            f"{several[1]} gives several values: if it is one, put it in quotes inside of the shell's, as in "
            f"{_in_quotes(several[1])}, or add -m to run a sweep"
        )
    if unknown := _UNKNOWN.match(_first_line(error)):
        meant = _similar_settings(name, unknown[1])
        remedy = f"is {' or '.join(meant)} meant?" if meant else "--cfg job lists all"
        return ConfigError(f"there is no setting {unknown[1]}: {remedy}")
    if isinstance(error, MissingConfigException) and error.options:
        return ConfigError(f"{_first_line(error)}: choose one of {', '.join(error.options)}")
    return ConfigError(f"{_first_line(error)}: there is no such setting or choice (--help lists them)")


def _similar_settings(name: str, typed: str) -> list[str]:
    """Return the settings of a command that somebody may mean who types one that it does not have."""
    try:
        content: Any = OmegaConf.to_container(compose(name, []))
    except ConfigError:
        return []
    known = list(_dotted(content))
    last = typed.rpartition(".")[2]
    same = [setting for setting in known if setting.rpartition(".")[2] == last]
    return same if 0 < len(same) <= _MOST_SUGGESTIONS else get_close_matches(typed, known, n=1, cutoff=0.8)


def _dotted(content: Mapping[str, Any], prefix: str = "") -> Iterator[str]:
    for key, value in content.items():
        yield f"{prefix}{key}"
        if isinstance(value, Mapping):
            yield from _dotted(value, f"{prefix}{key}.")


def _unreadable_setting(error: OverrideParseException) -> ConfigError:
    """Return what to say of a word that is no setting in Hydra's grammar."""
    key, is_setting, _ = str(error.override).partition("=")
    if not is_setting:
        return ConfigError(
            f"{key} is no setting and no option: settings are written key=value (--help lists them)"
        )
    if _KEY.fullmatch(key) is None:
        return ConfigError(
            f"{key} in {error.override} is no name of a setting: settings are written key=value"
        )
    return ConfigError(
        f"the value of {error.override} is not one that Hydra reads: put it in quotes inside of the shell's, "
        f"as in {_in_quotes(str(error.override))}"
    )


def _in_quotes(setting: str) -> str:
    """Return a setting as one types it for its value to be text, whatever characters it has."""
    key, _, value = setting.partition("=")
    return shlex.quote(f"{key}={quoted(value)}")


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
        if OmegaConf.is_config(cfg):
            check_settings(OmegaConf.to_container(cfg, resolve=False))  # type: ignore[arg-type]
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
    except KeyboardInterrupt as stop:
        sys.stderr.write("raytran: interrupted\n")
        raise SystemExit(_INTERRUPTED) from stop
    except Exception as error:
        _exit_if_refused(error)
        full = disk_full(error)
        if full is None:
            raise
        place = f"write {full.filename}" if full.filename else "go on writing"
        _exit_with(
            DataError(f"cannot {place} ({full.strerror}): make room there, then give the command again")
        )


def compose(config_name: str, overrides: Sequence[str]) -> DictConfig:
    """Compose a config as the command line would, inside a running command or in plain Python.

    Args:
        config_name: root file in ``conf/`` without ending.
        overrides: what a user would type, e.g. ``["preset=tiny", "experiment=stage2"]``, paths as they are.
            ``output_dir`` must be among them if the result is to be run.

    Raises:
        ConfigError: there is no such setting or choice.
    """
    register_resolvers()
    register_sweep_resolver()
    already = GlobalHydra.instance().is_initialized()
    folder = nullcontext() if already else hydra.initialize_config_dir(str(config_dir()), version_base="1.3")
    with folder:
        try:
            return hydra.compose(config_name, overrides=literal_paths(config_name, overrides))
        except ConfigCompositionException as error:
            raise _no_such_setting(config_name, error, overrides) from error
        except OverrideParseException as error:
            raise _unreadable_setting(error) from error


def typed_settings(hydra_config: Any) -> list[str]:
    """Return the settings of a command as they were typed, but for quotes, none of them read as a reference.

    Args:
        hydra_config: the part ``hydra`` of its config.
    """
    typed: Any = OmegaConf.to_container(hydra_config.overrides.task)
    return [str(item) for item in typed]


def with_number_lists(words: Sequence[str]) -> list[str]:
    """Return the words of a command line with ``up=1,2,3``, which is one value, as ``up=[1,2,3]``.

    To Hydra commas are those of a sweep.
    """
    typed = ((word, _NUMBERS.fullmatch(word)) for word in words)
    return [word if match is None else f"{match[1]}=[{match[2]}]" for word, match in typed]


def name_positional(words: Sequence[str], key: str) -> list[str]:
    """Return the words of a command line, with ``key=`` before one that is neither a setting nor an option.

    Args:
        words: as typed.
        key: setting that a word without a key means.
    """
    named: list[str] = []
    before = ""
    for word in words:
        is_other = word.startswith("-") or before in _WITH_VALUE or _is_setting(word)
        named.append(word if is_other else f"{key}={quoted(word)}")
        before = word
    return named


def _is_setting(word: str) -> bool:
    """Return whether a word is ``key=value``, and not the name of a folder that has an equals sign."""
    key, equals, _ = word.partition("=")
    return bool(equals and _KEY.fullmatch(key)) and not os.path.exists(word)


def _exit_if_refused(error: BaseException) -> None:
    """Leave with one sentence if the system refused a path for what it is, or for where it lies.

    That a file is not there, or is already, is for those to say who look for it. OmegaConf wraps what its
    resolvers raise.
    """
    cause: BaseException | None = error
    while cause is not None and not isinstance(cause, OSError):
        cause = cause.__cause__ or cause.__context__
    if cause is not None and cause.errno in _REFUSALS and cause.filename is not None:
        path = os.fsdecode(cause.filename) if isinstance(cause.filename, str | bytes) else cause.filename
        refused = ConfigError(f"cannot use {path} ({cause.strerror}): choose another path, or mend this one")
        refused.__cause__ = cause
        _exit_with(refused)


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
