# SPDX-License-Identifier: Apache-2.0
"""What to say of settings that do not exist, cannot be read, are missing, or hold a word for a number."""

from __future__ import annotations

import re
import shlex
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from difflib import get_close_matches
from typing import Any

import yaml
from hydra.errors import ConfigCompositionException, MissingConfigException, OverrideParseException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from raytran.checkpoints.runs import STAGE_NAMES
from raytran.errors import ConfigError
from raytran.run.conf_comments import options
from raytran.run.config_dir import config_dir
from raytran.run.path_settings import PATH_SETTINGS, quoted
from raytran.setting_limits import is_a_number

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

KEY = re.compile(r"[+~]{0,2}[A-Za-z_][\w./@:-]*")
"""How the name of a setting is typed, with Hydra's signs before it."""

_SEVERAL_VALUES = re.compile(r"Ambiguous value for argument '(.*)'$", re.DOTALL)
"""How Hydra begins to say that a comma makes a sweep of a single run."""

_UNKNOWN = re.compile(r"Could not override '(.*)'$")
"""How Hydra begins to say that there is no such setting."""

_NO_CHOICE = re.compile(r"Could not override '([^']*)'\. No match in the defaults list$")
"""How Hydra begins to say that a command does not choose from a folder of configs that is there."""

_MOST_SUGGESTIONS = 3

_ELSEWHERE = {
    **dict.fromkeys(("lr", "learning_rate"), ("optimizer.learning_rate",)),
    **dict.fromkeys(("epochs", "max_epochs", "steps", "iterations"), ("trainer.max_steps",)),
    **dict.fromkeys(("gpus", "num_gpus", "devices"), ("trainer.devices",)),
    **dict.fromkeys(("workers", "num_workers"), ("views.num_workers",)),
    **dict.fromkeys(("batch", "batch_size"), ("views.batch_size",)),
    **dict.fromkeys(("ckpt", "weights"), ("checkpoint", "init_from")),
    **dict.fromkeys(("input", "video", "source"), ("scene",)),
    **dict.fromkeys(("out", "out_dir", "save_dir"), ("output", "output_dir")),
}
"""What other programs call such settings → what they may be called here."""

_NOT_OURS = ("hydra.", "trainer.", "logger.")
"""Settings of other packages, which take words and numbers as they say."""


def no_such_setting(
    error: ConfigCompositionException, typed: Sequence[str], *, known: Callable[[], DictConfig]
) -> ConfigError:
    """Return what to say of settings that Hydra does not know; of those it knew once, what they are now.

    Args:
        error: what Hydra says.
        typed: words of the command line.
        known: gives the command's settings as they are without any.
    """
    for word in typed:
        for pattern, now in _RENAMED:
            if re.match(pattern, word):
                return ConfigError(f"{word} is called {re.sub(pattern, now, word)} now: give that instead")
    if several := _SEVERAL_VALUES.match(first_line(error)):
        return ConfigError(
            f"{several[1]} gives several values: if it is one, put it in quotes inside of the shell's, as in "
            f"{_in_quotes(several[1])}, or add -m to run a sweep"
        )
    if unknown := _UNKNOWN.match(first_line(error)):
        meant = _similar_settings(unknown[1], known)
        return ConfigError(f"there is no setting {unknown[1]}: {_question(meant) or '--help lists all'}")
    if no_choice := _NO_CHOICE.match(first_line(error)):
        return ConfigError(f"this command takes no {no_choice[1]}=: --help lists what it takes")
    if isinstance(error, MissingConfigException) and error.options:
        group, _, name = str(error.missing_cfg_file).rpartition("/")
        meant = get_close_matches(name, error.options, n=1, cutoff=0.5)
        question = f"{_question(f'{group}={choice}' for choice in meant)} " if meant else ""
        return ConfigError(f"there is no {group}={name}: {question}choose one of {', '.join(error.options)}")
    return ConfigError(f"{first_line(error)}: there is no such setting or choice (--help lists them)")


def _question(meant: Iterable[str]) -> str:
    names = " or ".join(meant)
    return f"is {names} meant?" if names else ""


def _similar_settings(typed: str, known: Callable[[], DictConfig]) -> list[str]:
    """Return the settings of a command that somebody may mean who types one that it does not have."""
    try:
        content: Any = OmegaConf.to_container(known())
    except ConfigError:
        return []
    names = list(_dotted(content))
    if other := [name for name in _ELSEWHERE.get(typed, ()) if name in names]:
        return other
    last = typed.rpartition(".")[2]
    same = [setting for setting in names if setting.rpartition(".")[2] == last]
    return same if 0 < len(same) <= _MOST_SUGGESTIONS else get_close_matches(typed, names, n=1, cutoff=0.75)


def _dotted(content: Mapping[str, Any], prefix: str = "") -> Iterator[str]:
    for key, value in content.items():
        yield f"{prefix}{key}"
        if isinstance(value, Mapping):
            yield from _dotted(value, f"{prefix}{key}.")


def unreadable_setting(error: OverrideParseException) -> ConfigError:
    """Return what to say of a word that is no setting in Hydra's grammar."""
    key, is_setting, _ = str(error.override).partition("=")
    if not is_setting:
        return ConfigError(
            f"{key} is no setting and no option: settings are written key=value (--help lists them)"
        )
    if KEY.fullmatch(key) is None:
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


def first_line(error: Exception) -> str:
    """Return the first line of what an error says, without its full stop."""
    return str(error).splitlines()[0].rstrip(".")


def missing_setting(error: OmegaConfBaseException, command: str) -> ConfigError:
    """Return what to say of a setting that must be typed and was not, with the command's first example.

    Args:
        error: what OmegaConf says.
        command: name of its config.
    """
    help_text = (config_dir() / f"{command}.yaml").read_text(encoding="utf-8")
    example = re.search(
        rf"^ +((?:python -m )?raytran[ .]{command}\b.*?)(?:\s{{2,}}.*)?$", help_text, re.MULTILINE
    )
    such = f", for example: {example[1]}" if example else ""
    return ConfigError(f"{command} needs {error.full_key}={such} (--help explains it)")


def check_kinds(
    command: str,
    cfg: DictConfig,
    typed: Sequence[str],
    *,
    groups: Collection[str],
    default: Callable[[Sequence[str]], DictConfig],
) -> None:
    """Raise where a word was typed for what is a number or a switch by default.

    Args:
        command: name of its config.
        cfg: its settings.
        typed: settings as typed.
        groups: names of the groups that are chosen from.
        default: gives the settings as they are if only these are typed.

    Raises:
        ConfigError: a value is of another kind; the sentence names its setting.
    """
    keys = {word.partition("=")[0].lstrip("+"): word for word in typed}
    chosen = [word for key, word in keys.items() if key in groups]
    doubtful = {
        key: value
        for key in keys
        if key not in groups and not key.startswith(_NOT_OURS) and key not in PATH_SETTINGS.get(command, ())
        for value in [_raw(cfg, key)]
        if isinstance(value, str) and "${" not in value and not _reads_as_number(value)
    }
    if not doubtful:
        return
    own = {option.name: yaml.safe_load(option.value) for option in options(command) if option.value}
    # Composing takes a third of a second.
    rest = default(chosen) if not set(doubtful) <= set(own) else OmegaConf.create()
    for key, value in doubtful.items():
        usual = own[key] if key in own else _raw(rest, key)
        if isinstance(usual, bool):
            raise ConfigError(f"{key}={value} is neither true nor false: give one of these")
        if isinstance(usual, int | float):
            raise ConfigError(f"{key}={value} is no number: give one, as in {key}={usual}")
        if usual is None and is_a_number(key.rpartition(".")[2]):
            raise ConfigError(f"{key}={value} is no number: give one, or leave it out")


def _raw(cfg: DictConfig, key: str) -> Any:
    """Return a setting as it is written; references in it stay."""
    parent, _, last = key.rpartition(".")
    try:
        node: Any = OmegaConf.select(cfg, parent) if parent else cfg
        return OmegaConf.to_container(node, resolve=False)[last]  # type: ignore[index, call-overload]
    except (OmegaConfBaseException, ValueError, KeyError, TypeError):
        return None


def _reads_as_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
