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
from pathlib import Path

from raytran.run.conf_comments import choices, header, options

DOCS = Path(__file__).resolve().parent
CONF = DOCS.parent / "conf"

_BLOCK = re.compile(
    r"^<!-- (options|choices|presets)(?:: (\S+))? -->\n.*?^<!-- end -->$", re.MULTILINE | re.DOTALL
)


def filled(page: str) -> str:
    """Return the text of a page with its tables made anew."""
    return _BLOCK.sub(lambda found: _block(found[1], found[2]), page)


def pages() -> list[Path]:
    """Return all pages of this folder."""
    return sorted(DOCS.rglob("*.md"))


def _block(kind: str, name: str | None) -> str:
    opening = f"<!-- {kind}: {name} -->" if name else f"<!-- {kind} -->"
    table = {"options": _options_table, "choices": _choices_table, "presets": _presets_table}[kind](
        name or ""
    )
    return "\n".join([opening, *table, "<!-- end -->"])


def _options_table(name: str) -> list[str]:
    rows = ["| setting | default | |", "|---|---|---|"]
    for option in options(name, CONF):
        if option.value is None:
            title = f"`{option.name}.…` " if option.name else ""
            rows.append(f"| **{title}{_cell(option.comment)}** | | |")
        else:
            rows.append(f"| `{option.name}` | {_code(option.value)} | {_cell(option.comment)} |")
    return rows


def _choices_table(name: str) -> list[str]:
    """Return a row for each choice of each group, as the files say in their first line what they are."""
    rows = ["| setting | | |", "|---|---|---|"]
    for choice in choices(name, CONF):
        for file in choice.files:
            typed = f"[{file}]" if choice.several else file  # any number of them may be chosen
            mark = "default" if file in choice.defaults else ""
            about = header(CONF / choice.group / f"{file}.yaml")
            rows.append(f"| `{choice.group}={typed}` | {mark} | {_cell(about)} |")
    return rows


def _presets_table(_: str) -> list[str]:
    found = {path.stem: options(f"preset/{path.stem}", CONF) for path in (CONF / "preset").glob("*.yaml")}
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
