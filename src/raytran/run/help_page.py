# SPDX-License-Identifier: Apache-2.0
"""What ``--help`` prints: a command's examples, what it chooses from, and each setting with its comment."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Iterator, Mapping
from string import Template
from typing import Any

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from raytran.errors import page
from raytran.run.conf_comments import Choice, Option, choices, header, options
from raytran.run.config_dir import config_dir

_NO_SETTINGS = ("_target_", "_partial_", "_convert_")
_OWN_RESOLVERS = re.compile(r"\$\{(?!oc\.)[\w.]+:")
"""References to what is only known when a command runs, e.g. the folder of a new run."""

_PAGE = re.compile(r"docs/[\w/-]+\.md")
_WHERE_PAGES_ARE = "The folder docs/ is "

_SETTING_WIDTH = 36
_FEWEST_COLUMNS = 60


def help_page(command: str, cfg: DictConfig, *, width: int) -> str:
    """Return the text of ``--help``.

    Args:
        command: name of its config.
        cfg: its config as composed, with Hydra's own part.
        width: columns of the terminal.
    """
    width = max(width, _FEWEST_COLUMNS)
    chosen: Mapping[str, Any] = cfg.hydra.runtime.choices
    roots = _root_files(command)
    groups = {choice.group: choice for root in roots for choice in choices(root)}
    for group, name in chosen.items():
        if (
            group not in groups
            and not group.startswith(("hydra/", "local"))
            and (config_dir() / group).is_dir()
        ):
            files = sorted(path.stem for path in (config_dir() / group).glob("*.yaml"))
            groups[group] = Choice(group, tuple(files), (str(name),), False, "")
    template: str = OmegaConf.to_container(cfg.hydra.help, resolve=False)["template"]  # type: ignore[index, call-overload]
    text = Template(template).safe_substitute(
        APP_CONFIG_GROUPS="\n".join(_group_lines(groups, chosen, width)),
        CONFIG="\n".join(_setting_lines(roots, chosen, cfg, width)),
    )
    return f"{text.rstrip()}\n\n{_WHERE_PAGES_ARE}{page('.')}\n" if _PAGE.search(text) else text


def _root_files(command: str) -> list[str]:
    """Return a command's file and those that it builds on, e.g. ``curriculum`` and ``train``."""
    content: Any = OmegaConf.to_container(OmegaConf.load(config_dir() / f"{command}.yaml"))
    names = [entry for entry in content.get("defaults", ()) if isinstance(entry, str)]
    return [
        command,
        *(name for name in names if (config_dir() / f"{name}.yaml").is_file() and "/" not in name),
    ]


def _group_lines(groups: Mapping[str, Choice], chosen: Mapping[str, Any], width: int) -> Iterator[str]:
    if groups:
        yield "Choices, with what is chosen now in brackets (group=name):"
    for choice in groups.values():
        now = chosen.get(choice.group)
        names = [f"[{file}]" if file in str(now).strip("[]").split(", ") else file for file in choice.files]
        if str(now) not in ("None", "null") and not any(name.startswith("[") for name in names):
            names.insert(0, f"[{now}]")  # of a folder of the user's own
        yield from _entry(f"{choice.group}=", " ".join(names), width)
    if groups:
        yield ""


def _setting_lines(
    roots: list[str],
    chosen: Mapping[str, Any],
    cfg: DictConfig,
    width: int,
) -> Iterator[str]:
    content: Any = OmegaConf.to_container(cfg, resolve=False)
    content.pop("hydra")
    values = dict(_leaves(content))
    comments: dict[str, str] = {}
    for group, name in chosen.items():
        for file in (f"{group}/base", f"{group}/{name}"):
            if not group.startswith("hydra/") and (config_dir() / f"{file}.yaml").is_file():
                comments |= {option.name: option.comment for option in options(file) if option.comment}
    own: list[Option] = [option for root in roots for option in options(root)]
    comments |= {option.name: option.comment for option in own if option.comment}
    yield "Settings (key=value):"
    shown: set[str] = set()
    for option in own:
        if option.value is None:
            title = f"{option.name}: {option.comment}" if option.name else option.comment
            yield from ("", *textwrap.wrap(title, width))
        for name in [option.name] if option.name in values else []:
            shown.add(name)
            yield from _setting(name, values[name], comments.get(name, ""), cfg, width)
    last = ""
    for name, value in values.items():
        if name in shown:
            continue
        top = name.partition(".")[0]
        if name == top and top in chosen:
            continue  # the choice itself, told above
        heading = _heading(top, chosen.get(top)) if "." in name else "others:"
        if heading != last:
            yield from ("", heading)
        last = heading
        yield from _setting(name, value, comments.get(name, ""), cfg, width)


def _heading(top: str, choice: object) -> str:
    """Return what stands above the settings of a group."""
    path = config_dir() / top / f"{choice}.yaml"
    return f"{top}={choice}: {header(path)}" if path.is_file() else f"{top}:"


def _setting(name: str, value: Any, comment: str, cfg: DictConfig, width: int) -> list[str]:
    if value == "???":
        return _entry(f"{name}=", f"(must be given) {comment}", width)
    return _entry(f"{name}={_typed(_resolved(name, value, cfg))}", comment, width)


def _entry(setting: str, comment: str, width: int) -> list[str]:
    """Return the lines of a setting: the comment beside it, or below where it is long."""
    indent = " " * (_SETTING_WIDTH + 2)
    lines = textwrap.wrap(comment, width - len(indent), break_long_words=False, break_on_hyphens=False)
    if len(setting) >= _SETTING_WIDTH and lines:
        return [f"  {setting}", *(f"{indent}{line}" for line in lines)]
    first = f"  {setting:{_SETTING_WIDTH}}{lines[0] if lines else ''}".rstrip()
    return [first, *(f"{indent}{line}" for line in lines[1:])]


def _leaves(node: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in node.items():
        if key in _NO_SETTINGS:
            continue
        if isinstance(value, Mapping) and value:
            yield from _leaves(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def _resolved(name: str, value: Any, cfg: DictConfig) -> Any:
    """Return a value with its references to other settings filled in, if that makes it a number or a word."""
    if not isinstance(value, str) or "${" not in value or _OWN_RESOLVERS.search(value):
        return value
    try:
        found = OmegaConf.select(cfg, name)
    except OmegaConfBaseException:
        return value
    if OmegaConf.is_dict(found) or found is None:
        return value
    return OmegaConf.to_container(found) if OmegaConf.is_list(found) else found


def _typed(value: Any) -> str:
    """Return a value as one types it."""
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{key}: {_typed(part)}" for key, part in value.items()) + "}"
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_typed, value))}]"
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    return str(value)
