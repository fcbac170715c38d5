# SPDX-License-Identifier: Apache-2.0
"""Settings with their comments, from the files of ``conf/``: for ``--help`` and for the tables in docs."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import yaml

from raytran.run.config_dir import config_dir

_HIDDEN = ("defaults", "hydra", "_target_", "_partial_")


@dataclass(frozen=True)
class Option:
    """A line of a table.

    Attributes:
        name: dotted, as one types it.
        value: as written in the file; None for a heading.
        comment: of its line and of those below that continue it.
        line: where it stands in the file, from 0.
    """

    name: str
    value: str | None
    comment: str
    line: int


@dataclass(frozen=True)
class Choice:
    """A group of which one file is chosen, or several.

    Attributes:
        group: as one types it.
        files: names of its files, without ending.
        defaults: those that are chosen if nothing is typed.
        several: whether any number of them may be chosen.
        comment: of its line.
    """

    group: str
    files: tuple[str, ...]
    defaults: tuple[str, ...]
    several: bool
    comment: str


def options(name: str, conf: Path | None = None) -> list[Option]:
    """Return the settings of a file of ``conf/`` in its order, those of a group with its name in front.

    Args:
        name: of the file without ending, e.g. ``predict`` or ``data/rooms``.
        conf: folder of the configs; None for raytran's own.
    """
    conf = conf or config_dir()
    path = conf / f"{name}.yaml"
    text = path.read_text(encoding="utf-8")
    lines = text.splitlines()
    package = _package(text, ".".join(path.relative_to(conf).parts[:-1]))
    root = yaml.compose(text)
    found = [] if root is None else list(_walk(root, f"{package}." if package else "", text, lines))
    headings = [Option("", None, comment, line) for line, comment in _headings(lines)]
    return sorted([*found, *headings], key=lambda option: option.line)


def choices(name: str, conf: Path | None = None) -> list[Choice]:
    """Return the groups that a file of ``conf/`` chooses from, in its order; none for a file without any.

    Args:
        name: of the file without ending.
        conf: folder of the configs; None for raytran's own.
    """
    conf = conf or config_dir()
    text = (conf / f"{name}.yaml").read_text(encoding="utf-8")
    lines, root = text.splitlines(), yaml.compose(text)
    found = []
    for key, value in root.value if isinstance(root, yaml.MappingNode) else ():
        for entry in value.value if key.value == "defaults" else ():
            if not isinstance(entry, yaml.MappingNode):
                continue
            ((group, chosen),) = entry.value
            words = group.value.split()
            if words[0] == "optional":
                continue
            typed = "/".join([*Path(name).parts[:-1], words[-1].lstrip("/")])
            several = isinstance(chosen, yaml.SequenceNode)
            defaults = [item.value for item in chosen.value] if several else [chosen.value]
            files = tuple(path.stem for path in sorted((conf / typed).glob("*.yaml")) if path.stem != "base")
            comment = _comment(lines, group.start_mark.line)
            found.append(Choice(typed, files, tuple(defaults), several, comment))
    return found


def header(path: Path) -> str:
    """Return the first sentence of the comment that a file begins with, without its full stop."""
    words: list[str] = []
    for line in path.read_text(encoding="utf-8").splitlines():
        if not line.startswith("#"):
            break
        if not line.startswith("# @package"):
            words.append(line.lstrip("# "))
    return re.split(r"(?<!e\.g)\.(?:\s|$)", " ".join(words), maxsplit=1)[0]


def _package(text: str, folder: str) -> str:
    """Return under which name the settings of a file stand: that of its folder, unless it says another."""
    said = re.search(r"^# @package (\S+)", text, re.MULTILINE)
    return folder if said is None else said[1].replace("_global_", "")


def _walk(node: yaml.MappingNode, prefix: str, text: str, lines: list[str]) -> Iterator[Option]:
    for key, value in node.value:
        if key.value in _HIDDEN:
            continue
        line, name = key.start_mark.line, f"{prefix}{key.value}"
        comment = _comment(lines, line)
        if isinstance(value, yaml.MappingNode) and value.value:
            if comment and not value.flow_style:
                yield Option(name, None, comment, line)
            yield from _walk(value, f"{name}.", text, lines)
        else:
            written = text[value.start_mark.index : value.end_mark.index].strip()
            yield Option(name, " ".join(written.split()), comment, line)


def _comment(lines: list[str], number: int) -> str:
    """Return the comment at the end of a line, with its continuation on the lines below."""
    _, mark, first = lines[number].partition(" #")
    if not mark:
        return ""
    words = [first]
    for line in lines[number + 1 :]:
        if not re.match(r" {12,}#", line):
            break
        words.append(line.split("#", 1)[1])
    return " ".join(" ".join(words).split())


def _headings(lines: list[str]) -> Iterator[tuple[int, str]]:
    """Give the comments that stand alone at the left, after an empty line: they head what follows."""
    for number, line in enumerate(lines):
        if number and line.startswith("# ") and not lines[number - 1].strip():
            yield number, line[2:]
