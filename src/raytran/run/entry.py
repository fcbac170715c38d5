# SPDX-License-Identifier: Apache-2.0
"""What all commands share: Hydra around a function, errors of the user's making as one sentence."""

from __future__ import annotations

import errno
import functools
import io
import os
import re
import shutil
import sys
from argparse import Namespace
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import hydra
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import (
    ConfigCompositionException,
    InstantiationException,
    OverrideParseException,
)
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import MissingMandatoryValue, OmegaConfBaseException

from raytran.checkpoints.runs import first_ranks, run_folder
from raytran.data.files import disk_full
from raytran.data.workers import ENDS_WITH, end_with_parent
from raytran.errors import ConfigError, DataError, RaytranError
from raytran.run.closed_pipe import survive_closed_pipe
from raytran.run.config_dir import config_dir
from raytran.run.help_page import help_page
from raytran.run.lazy_help import hydra_parser, let_help_be_lazy
from raytran.run.path_settings import PATH_SETTINGS, check_run_folder, key_of_path, literal_paths, quoted
from raytran.run.refused_run import remove_refused_run
from raytran.run.setting_mistakes import (
    KEY,
    check_kinds,
    first_line,
    missing_setting,
    no_such_setting,
    unreadable_setting,
)
from raytran.run.sweep.folder import register_sweep_resolver
from raytran.setting_limits import check_settings

_FULL_ERROR = "HYDRA_FULL_ERROR"
"""Hydra's own switch: with it set to 1, errors are shown at length."""

_REFUSALS = {
    *(errno.ENAMETOOLONG, errno.ENOTDIR, errno.ELOOP, errno.EACCES, errno.EPERM),
    *(errno.EIO, errno.ESTALE, errno.EINVAL, errno.EILSEQ),
}
"""Numbers of errors by which a system says that a path will not do."""

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
    let_help_be_lazy()
    _let_threads_sleep()
    _let_apples_gpu_ask_the_cpu()

    def decorate(function: Callable[[DictConfig], Any]) -> Callable[[], Any]:
        typed = _TYPED_FULL_ERROR

        @functools.wraps(function)
        def task(cfg: DictConfig) -> Any:
            _set_full_error(typed)
            if "output_dir" in cfg:
                # Lightning starts further ranks with hydra.run.dir of the first: all share one folder.
                cfg.output_dir = HydraConfig.get().runtime.output_dir
            try:
                return run_or_exit(function, cfg, command=config_name)
            except (SystemExit, RaytranError) as end:
                if config_name in _KEEP_A_LOG and getattr(end, "code", 1) == 1:
                    remove_refused_run(Path(cfg.output_dir), outputs=Path(cfg.outputs))
                raise

        try:
            main = hydra.main(version_base="1.3", config_path=str(config_dir()), config_name=config_name)
        except ConfigError as error:
            _exit_with(error)
        return functools.partial(_compose_or_exit, config_name, main(task), typed)

    return decorate


def _let_apples_gpu_ask_the_cpu() -> None:
    """Let operations that torch does not have for Apple's GPUs run on the CPU; before torch is imported."""
    if sys.platform == "darwin":
        os.environ.setdefault("PYTORCH_ENABLE_MPS_FALLBACK", "1")


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
    survive_closed_pipe()
    _end_with_starter()
    _set_full_error("1")  # Hydra then raises instead of printing; the task restores what the user has set
    words = with_number_lists(sys.argv[1:])
    try:
        typed_options = _options(words)
        words = with_keys(name, words)
        if name in _KEEP_A_LOG:
            check_run_folder(words)
        # Lightning starts further ranks with the words that it finds there.
        sys.argv[1:] = literal_paths(name, _options_first(words))
        if typed_options.help:
            return _write_help(name, typed_options)
        return command()
    except ConfigCompositionException as error:
        _set_full_error(typed)
        _exit_with(no_such_setting(error, sys.argv[1:], known=lambda: compose(name, [])))
    except OverrideParseException as error:
        _set_full_error(typed)
        _exit_with(unreadable_setting(error))
    except RaytranError as error:  # of a sweep; those of a single run do not come so far
        _set_full_error(typed)
        _exit_with(error)
    except RuntimeError as error:
        _set_full_error(typed)
        if not str(error).startswith("Unknown plugin class"):
            raise
        extras = "'raytran[sweep]' brings Optuna's sweeper, 'raytran[cluster]' the launcher for SLURM"
        _exit_with(ConfigError(f"{first_line(error)}: it is not installed; pip install {extras}"))
    except OSError as error:
        _set_full_error(typed)
        _exit_if_refused(error)
        raise
    except OmegaConfBaseException as error:
        _set_full_error(typed)
        _exit_if_refused(error)
        # A resolver of ours that objects is wrapped by OmegaConf; its message is the clearer one.
        _exit_with(ConfigError(first_line(error).split("resolving interpolation: ")[-1]))


def _options(words: Sequence[str]) -> Namespace:
    """Return which of Hydra's options are typed.

    Raises:
        ConfigError: something is typed like an option, and is none.
    """
    found, unknown = hydra_parser().parse_known_args(_options_first(words))
    if unknown:
        name = unknown[0].partition("=")[0]
        raise ConfigError(
            f"there is no option {name}: settings are written without dashes, as {name.lstrip('-')}=VALUE "
            "(--help lists them)"
        )
    return found


def _write_help(name: str, options: Namespace) -> None:
    """Print what a command can be told, with the values that it has by what is typed beside ``--help``."""
    settings = literal_paths(name, with_keys(name, options.overrides))
    folder = (
        options.config_dir and f"hydra.searchpath=[{quoted(Path(options.config_dir).absolute().as_uri())}]"
    )
    with hydra.initialize_config_dir(str(config_dir()), version_base="1.3"):
        cfg = hydra.compose(
            name, overrides=[*settings, *([folder] if folder else [])], return_hydra_config=True
        )
    sys.stdout.write(help_page(name, cfg, width=shutil.get_terminal_size().columns))


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


def run_or_exit(function: Callable[[DictConfig], Any], cfg: DictConfig, *, command: str = "") -> Any:
    """Return ``function(cfg)``; a mistake of the user's becomes a sentence on stderr and exit code 1.

    Args:
        function: the command.
        cfg: its settings.
        command: name of its config, inside of Hydra; empty elsewhere, where nothing was typed.
    """
    try:
        if command:
            _check_typed(command, cfg)
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
    except MissingMandatoryValue as error:
        _exit_with(missing_setting(error, command) if command else ConfigError(first_line(error)))
    except OmegaConfBaseException as error:
        where = f"{error.full_key}: " if error.full_key else ""
        _exit_with(ConfigError(f"{where}{first_line(error)} (see --cfg job for all settings)"))
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


def _check_typed(command: str, cfg: DictConfig) -> None:
    """Raise ``ConfigError`` where what was typed for a setting is not of its kind."""
    hydra_config = HydraConfig.get()
    check_kinds(
        command,
        cfg,
        typed_settings(hydra_config),
        groups=set(hydra_config.runtime.choices),
        default=lambda groups: compose(command, groups),
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
            raise no_such_setting(error, overrides, known=lambda: compose(config_name, [])) from error
        except OverrideParseException as error:
            raise unreadable_setting(error) from error


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


def with_keys(command: str, words: Sequence[str]) -> list[str]:
    """Return the words of a command line, with a key before the path that was typed without one.

    Args:
        command: name of its config.
        words: as typed.

    Raises:
        ConfigError: there are two such paths, or the setting that one means is given as well.
    """
    named: list[str] = []
    before = ""
    other = "output" if "output" in PATH_SETTINGS.get(command, ()) else "KEY"
    for word in words:
        is_other = word.startswith("-") or before in _WITH_VALUE or _is_setting(word)
        key = None if is_other else key_of_path(command, word)
        if key is not None and any(given.startswith(f"{key}=") for given in (*named, *words)):
            raise ConfigError(
                f"{word} is a path without a name, and {key}= is there already: name it, as in {other}={word}"
            )
        named.append(word if key is None else f"{key}={quoted(word)}")
        before = word
    return named


def _is_setting(word: str) -> bool:
    """Return whether a word is ``key=value``, and not the name of a folder that has an equals sign."""
    key, equals, _ = word.partition("=")
    return bool(equals and KEY.fullmatch(key)) and not os.path.exists(word)


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
