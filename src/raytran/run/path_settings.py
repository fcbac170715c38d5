# SPDX-License-Identifier: Apache-2.0
"""Settings that are paths: their words reach Hydra as typed, whatever its grammar means by their characters.

To Hydra ``scene=room (2)`` is a function call, ``a,b`` a sweep, ``a=b`` a mistake, ``1`` a number, and to
OmegaConf ``${a}`` another setting. The quotes that a shell wants are gone by then.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from functools import cache
from pathlib import Path
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Quote, QuotedString
from hydra.errors import HydraException
from omegaconf import OmegaConf

from raytran.errors import ConfigError
from raytran.run.config_dir import config_dir

_OF_DATA = ("data.root", "data.more_roots", "data.dataset.cache_dir", "data.make.cads")
_OF_TRAINING = (
    *("init_from", "resume", "outputs", "output_dir", "model.backbone.encoder.weights", *_OF_DATA),
    *(
        "logger.tensorboard.save_dir",
        "logger.wandb.save_dir",
        "logger.mlflow.save_dir",
        "logger.mlflow.store",
    ),
    *("trainer.default_root_dir", "trainer.profiler.dirpath"),
)
PATH_SETTINGS = {
    "train": _OF_TRAINING,
    "curriculum": _OF_TRAINING,
    "evaluate": (
        *("checkpoint", "split", "predictions", "annotations", "compare", "scans", "output", "draw_with"),
        *_OF_DATA,
    ),
    "predict": ("checkpoint", "scene", "output", "cads", "views", "truth"),
    "prepare": (
        *("check", "output", "cads", "scannet", "shapenet", "scan2cad", "source"),
        *("captures", "boxes", "arkitscenes"),
    ),
    "export_model": ("checkpoint", "output", "calibration"),
    "poses": ("video", "output"),
    "plan": ("scene", "model.backbone.encoder.weights"),
    "view": ("folder",),
    "demo": ("output", *_OF_TRAINING),
}
"""Command → those of its settings that are paths."""

_TYPED_ALONE = {
    "predict": "scene",
    "view": "folder",
    "poses": "video",
    "plan": "scene",
    "demo": "output",
    "prepare": "check",
    "export_model": "checkpoint",
    "evaluate": "predictions",
}
"""Command → the setting that a path without a key means."""

_WEIGHTS = (".ckpt", ".safetensors")

_LISTS = ("draw_with", "data.more_roots")
"""Those that take several, in brackets."""

_NULL_IN_GROUPS = ("data.make.cads", "model.backbone.encoder.weights")
"""Those outside of a command's own file that may be null, which means none."""

_SETTING = re.compile(r"(?P<mark>\+{0,2})(?P<key>[A-Za-z_][\w.]*)=(?P<value>.*)", re.DOTALL)
_IN_QUOTES = re.compile(r'"(?:[^"\\]|\\.)*"|\'(?:[^\'\\]|\\.)*\'', re.DOTALL)
_ITEM = re.compile(rf"(?:{_IN_QUOTES.pattern}|[^,])+", re.DOTALL)
_SWEPT = re.compile(r"(choice|range|interval|glob|shuffle|sort|tag|str)\(.*\)", re.DOTALL)
_STRUCTURE = re.compile(r"""[()\[\]{}=,"']""")
_REFERENCE = re.compile(r"(\\*)\$\{")

_RUN_DIR = "hydra.run.dir="
_OF_A_RANK = "hydra.job.name=train_ddp_process_"
"""By this word one knows the command line that Lightning gives to a further rank."""


def quoted(path: Path | str) -> str:
    """Return a path as Hydra's grammar of overrides wants it, so that it arrives as it is."""
    text = "./???" if str(path) == "???" else str(path)  # alone OmegaConf's sign for a value that is missing
    return QuotedString(text=without_references(text), quote=Quote.double).with_quotes()


def without_references(text: str) -> str:
    """Return a text that is ``text`` when OmegaConf has read it once, references and all."""
    # OmegaConf reads \${ as text, and two backslashes before it as one.
    return _REFERENCE.sub(lambda found: rf"{found[1] * 2}\${{", text)


def key_of_path(command: str, path: str) -> str | None:
    """Return the setting of a command that a path without a key means, None if it takes none.

    Args:
        command: name of its config.
        path: as typed.
    """
    if command == "evaluate" and (path == "default" or path.endswith(_WEIGHTS)):
        return "checkpoint"
    return _TYPED_ALONE.get(command)


def literal_paths(command: str, words: Sequence[str]) -> list[str]:
    """Return the words of a command line with quotes, for Hydra, around the paths that need them.

    A path that is in quotes already keeps them, and what Hydra reads in them. In a sweep a comma outside of
    quotes parts paths. Where a setting may be null, ``null`` stays Hydra's word, and nothing means it.

    Args:
        command: name of its config, e.g. ``train``.
        words: settings and options of Hydra.

    Raises:
        ConfigError: nothing is typed where there must be a path.
    """
    paths, sweeps = PATH_SETTINGS.get(command, ()), _is_sweep(words)
    of_a_rank = any(word.startswith(_OF_A_RANK) for word in words)
    result = []
    for word in words:
        found = _SETTING.fullmatch(word)
        if of_a_rank and word.startswith(_RUN_DIR):
            # Lightning puts quotes around a folder and leaves those in its name as they are.
            result.append(f"{_RUN_DIR}{quoted(word[len(_RUN_DIR) + 1 : -1])}")
        elif found is None or found["key"] not in paths:
            result.append(word)
        else:
            value = _value(found["key"], found["value"], command, sweeps=sweeps)
            result.append(f"{found['mark']}{found['key']}={value}")
    return result


def check_run_folder(words: Sequence[str]) -> None:
    """Raise if Hydra itself, which keeps its log in the folder of a run, would read a reference in its name.

    Args:
        words: of a command that trains, as typed.

    Raises:
        ConfigError: the folder's name, or that of the folder where the command runs, contains ``${``.
    """
    folders = {"the working folder": str(Path.cwd())}
    for word in words:
        found = _SETTING.fullmatch(word)
        if (
            found
            and found["key"] in ("output_dir", "outputs", "resume")
            and not _IN_QUOTES.fullmatch(found["value"])
        ):
            folders[found["key"]] = found["value"]
    for name, folder in folders.items():
        if "${" in folder:
            raise ConfigError(
                f"a run cannot be kept below {folder} ({name}): choose a folder without ${{ in its name"
            )


def _is_sweep(words: Sequence[str]) -> bool:
    """Return whether several jobs are asked for."""
    for word in reversed(words):
        if word.startswith("hydra.mode="):
            return word.upper().endswith("MULTIRUN")
    is_option = (word == "-m" or (len(word) > 3 and "--multirun".startswith(word)) for word in words)
    return any(is_option) or any(word.startswith("sweep=") and word != "sweep=null" for word in words)


def _value(key: str, typed: str, command: str, *, sweeps: bool) -> str:
    may_be_null = key in _NULL_IN_GROUPS or key in _null_by_default(command)
    if typed.lower() in ("null", "") and may_be_null:
        return "null"
    if not typed:
        raise ConfigError(f"{key}= is empty: give a path behind it, or leave it out")
    if key in _LISTS and not sweeps:
        is_list = typed.startswith("[") and typed.endswith("]")
        return f"[{','.join(_items(typed[1:-1])) if is_list else _item(typed)}]"
    if not sweeps:
        return _item(typed)
    return typed if _SWEPT.fullmatch(typed) else ",".join(_items(typed))


def _items(typed: str) -> Iterator[str]:
    """Yield the paths of a list, each as Hydra wants it."""
    for item in _ITEM.findall(typed):
        yield _item(item.strip())


def _item(path: str) -> str:
    return path if _IN_QUOTES.fullmatch(path) or _is_plain(path) else quoted(path)


def _is_plain(path: str) -> bool:
    """Return whether Hydra reads a path without quotes as what it is."""
    if _STRUCTURE.search(path) or path == "???":
        return False
    try:
        override = OverridesParser.create().parse_override(f"path={path}")
    except HydraException:
        return False
    return not override.is_sweep_override() and override.value() == path


@cache
def _null_by_default(command: str) -> frozenset[str]:
    """Return the settings of a command's own file that are null."""
    content: Any = OmegaConf.to_container(OmegaConf.load(config_dir() / f"{command}.yaml"))
    return frozenset(str(key) for key, value in content.items() if value is None)
