# SPDX-License-Identifier: Apache-2.0
"""Fills the tables of settings in the pages of this folder from ``conf/``: ``python docs/options.py``.

A page says where a table belongs, in a line of its own; what stands up to ``<!-- end -->`` is replaced:

    <!-- options: predict -->       the settings in conf/predict.yaml, with their comments
    <!-- choices: train -->         the groups that conf/train.yaml chooses from
    <!-- presets -->                what conf/preset/*.yaml say of each of their settings

A test fails when a page is not what this script would write.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import yaml

DOCS = Path(__file__).resolve().parent
CONF = DOCS.parent / "conf"

_BLOCK = re.compile(
    r"^<!-- (options|choices|presets)(?:: (\S+))? -->\n.*?^<!-- end -->$", re.MULTILINE | re.DOTALL
)
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


def filled(page: str) -> str:
    """Return the text of a page with its tables made anew."""
    return _BLOCK.sub(lambda found: _block(found[1], found[2]), page)


def pages() -> list[Path]:
    """Return all pages of this folder."""
    return sorted(DOCS.rglob("*.md"))


def options(name: str) -> list[Option]:
    """Return the settings of ``conf/<name>.yaml``, those of a group with the group's name in front."""
    path = CONF / f"{name}.yaml"
    text = path.read_text(encoding="utf-8")
    lines = text.splitlines()
    package = _package(text, ".".join(path.relative_to(CONF).parts[:-1]))
    root = yaml.compose(text)
    found = [] if root is None else list(_walk(root, f"{package}." if package else "", text, lines))
    headings = [Option("", None, comment, line) for line, comment in _headings(lines)]
    return sorted([*found, *headings], key=lambda option: option.line)


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


def _block(kind: str, name: str | None) -> str:
    opening = f"<!-- {kind}: {name} -->" if name else f"<!-- {kind} -->"
    table = {"options": _options_table, "choices": _choices_table, "presets": _presets_table}[kind](
        name or ""
    )
    return "\n".join([opening, *table, "<!-- end -->"])


def _options_table(name: str) -> list[str]:
    rows = ["| setting | default | |", "|---|---|---|"]
    for option in options(name):
        if option.value is None:
            title = f"`{option.name}.…` " if option.name else ""
            rows.append(f"| **{title}{_cell(option.comment)}** | | |")
        else:
            rows.append(f"| `{option.name}` | {_code(option.value)} | {_cell(option.comment)} |")
    return rows


def _choices_table(name: str) -> list[str]:
    """Return a row for each choice of each group, as the files say in their first line what they are."""
    rows = ["| setting | | |", "|---|---|---|"]
    defaults = yaml.safe_load((CONF / f"{name}.yaml").read_text(encoding="utf-8"))["defaults"]
    for entry in defaults:
        if not isinstance(entry, dict):
            continue
        ((key, chosen),) = entry.items()
        group = "/".join([*Path(name).parts[:-1], key.split()[-1].lstrip("/")])
        if key.startswith("optional"):
            continue
        for path in sorted((CONF / group).glob("*.yaml")):
            if path.stem != "base":
                several = isinstance(chosen, list)  # any number of them may be chosen
                typed = f"[{path.stem}]" if several else path.stem
                mark = "default" if path.stem in (chosen if several else [chosen]) else ""
                rows.append(f"| `{group}={typed}` | {mark} | {_cell(header(path))} |")
    return rows


def _presets_table(_: str) -> list[str]:
    found = {path.stem: options(f"preset/{path.stem}") for path in (CONF / "preset").glob("*.yaml")}
    columns = {name: {option.name: option for option in listed} for name, listed in found.items()}
    names = sorted(columns, key=lambda name: -int(columns[name]["schedule.stage1.steps"].value or 0))
    rows = ["| setting | " + " | ".join(f"`preset={name}`" for name in names) + " | |"]
    rows.append("|---" * (len(names) + 2) + "|")
    for option in columns[names[0]].values():
        if option.name in ("", "preset"):
            continue
        if option.value is None:
            rows.append(f"| **`{option.name}.…` {_cell(option.comment)}** |" + " |" * (len(names) + 1))
            continue
        values = [_code(columns[name][option.name].value or "") for name in names]
        rows.append(f"| `{option.name}` | {' | '.join(values)} | {_cell(option.comment)} |")
    return rows


def _code(value: str) -> str:
    escaped = value.replace("|", "\\|")
    return f"`{escaped}`" if value else ""


def _cell(text: str) -> str:
    return text.replace("|", "\\|").replace("<", "&lt;")


def main() -> None:
    """Write the pages whose tables have changed."""
    for page in pages():
        before = page.read_text(encoding="utf-8")
        after = filled(before)
        if after != before:
            page.write_text(after, encoding="utf-8")


if __name__ == "__main__":
    main()
