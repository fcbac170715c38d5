# SPDX-License-Identifier: Apache-2.0
"""Makes a site of the pages, which are written to be read in a clone: a hook of MkDocs, see ``mkdocs.yml``.

In a clone pages link to each other by relative paths, also to what lies outside of ``docs/``: conventions,
notebooks, sources. Here these become pages too (a source file the page of its module), and links lead to
them; links to files that no page is made of become plain names.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from pathlib import Path, PurePosixPath
from posixpath import normpath, relpath
from typing import TYPE_CHECKING, Any
from urllib.parse import unquote

if TYPE_CHECKING:
    from mkdocs.config.defaults import MkDocsConfig
    from mkdocs.structure.files import Files
    from mkdocs.structure.pages import Page

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = "src/raytran"

OUTSIDE = {
    "README.md": "index.md",
    "docs/README.md": "pages.md",
    "CONVENTIONS.md": "axes-and-units.md",
    "CHANGELOG.md": "changelog.md",
    "CONTRIBUTING.md": "contributing.md",
    "CODE_OF_CONDUCT.md": "code-of-conduct.md",
    "benchmarks/README.md": "benchmarks.md",
    "src/raytran/weights/README.md": "weights.md",
}
"""Pages that lie elsewhere in a clone, or are called otherwise here → their names here."""

NOT_SHOWN = re.compile(r"(^|\.)_|^hydra_plugins|\.templates\b")

_LINK = re.compile(r"(!?)\[((?:[^\[\]]|\[[^\]]*\])*)\]\(([^)\s]+)\)")
_CODE = re.compile(r"^(`{3,}).*?^\1|`[^`\n]+`", re.MULTILINE | re.DOTALL)


def modules() -> dict[str, str]:
    """Return the page of each module of the package by the module's path in the clone."""
    pages = {}
    for path in sorted((ROOT / PACKAGE).rglob("*.py")):
        inside = path.relative_to(ROOT / PACKAGE)
        parts = inside.parent.parts if inside.name == "__init__.py" else inside.with_suffix("").parts
        name = ".".join(("raytran", *parts))
        if not NOT_SHOWN.search(name):
            folder = "/".join(("api", *parts))
            is_package = inside.name == "__init__.py"
            pages[f"{PACKAGE}/{inside.as_posix()}"] = f"{folder}/index.md" if is_package else f"{folder}.md"
    return pages


def notebooks() -> dict[str, str]:
    """Return the page of each notebook by its path in the clone."""
    return {
        f"notebooks/{path.name}": f"notebooks/{path.stem}.md"
        for path in sorted((ROOT / "notebooks").glob("*.ipynb"))
    }


def place(target: str, made: Mapping[str, str]) -> str | None:
    """Return what stands on the site for a path of the clone, None if nothing does."""
    if target in made:
        return made[target]
    if f"{target}/__init__.py" in made:
        return made[f"{target}/__init__.py"]
    return target.removeprefix("docs/") if target.startswith("docs/") else None


def linked(text: str, source: str, page: str, made: Mapping[str, str]) -> str:
    """Return a page's text with its links leading to pages of the site.

    Args:
        text: Markdown.
        source: the page's path in the clone.
        page: its path on the site.
        made: what the site has of what lies outside of ``docs/``.
    """

    def link(found: re.Match[str]) -> str:
        name, _, anchor = found[3].partition("#")
        if re.match(r"[a-z]+:", found[3]) or not name:
            return found[0]
        there = place(normpath(PurePosixPath(source).parent / unquote(name)), made)
        if there is None:
            return "" if found[1] else found[2]
        to = relpath(there, PurePosixPath(page).parent)
        return f"{found[1]}[{found[2]}]({to}{'#' * bool(anchor)}{anchor})"

    # Code stays as it is, also in the text of a link.
    kept: list[str] = []

    def keep(found: re.Match[str]) -> str:
        kept.append(found[0])
        return f"\0{len(kept) - 1}\0"

    text = _LINK.sub(link, _CODE.sub(keep, text))
    return re.sub("\0(\\d+)\0", lambda found: kept[int(found[1])], text)


def with_room_for_lists(text: str) -> str:
    """Return Markdown with an empty line before each list, without which Python's Markdown sees none."""
    lines: list[str] = []
    in_code = False
    for line in text.split("\n"):
        in_code ^= line.startswith("```")
        is_item, before = re.match(r"([-*]|\d+\.) ", line), lines[-1] if lines else ""
        if is_item and not in_code and before and not re.match(r"([-*]|\d+\.) |\s", before):
            lines.append("")
        lines.append(line)
    return "\n".join(lines)


def _api(path: str) -> str:
    parts = PurePosixPath(path).relative_to(PACKAGE).with_suffix("").parts
    name = ".".join(("raytran", *(part for part in parts if part != "__init__")))
    return f"# {name}\n\n::: {name}\n"


def _sources() -> dict[str, str]:
    """Return all that the site has from outside of ``docs/``: path in the clone → path on the site."""
    return {**OUTSIDE, **notebooks(), **modules()}


def _api_tree(paths: Iterator[str]) -> list[Any]:
    """Return the navigation of the modules' pages: a section for each folder."""
    tree: dict[str, Any] = {}
    for path in paths:
        branch = tree
        *folders, name = PurePosixPath(path).with_suffix("").parts[1:]
        for folder in folders:
            branch = branch.setdefault(folder, {})
        branch[name] = path

    def branches(node: dict[str, Any]) -> list[Any]:
        first = [node["index"]] if "index" in node else []
        rest = [(name, below) for name, below in node.items() if name != "index"]
        return first + [{name: branches(below) if isinstance(below, dict) else below} for name, below in rest]

    return branches(tree)


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Give the navigation the pages of all modules."""
    config.nav = [*(config.nav or []), {"API": _api_tree(iter(modules().values()))}]
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages from outside of ``docs/``."""
    from mkdocs.structure.files import File  # here, so that a test needs no MkDocs

    for source, page in _sources().items():
        if (before := files.get_file_from_path(source.removeprefix("docs/"))) is not None:
            files.remove(before)
        if source.endswith(".ipynb"):
            content = _notebook(ROOT / source, page, files, config)
        else:
            content = _api(source) if source.endswith(".py") else (ROOT / source).read_text(encoding="utf-8")
        files.append(File.generated(config, page, content=content))
    return files


def _notebook(path: Path, page: str, files: Files, config: MkDocsConfig) -> str:
    """Return a notebook with what it printed as Markdown; its pictures become files of the site."""
    from mkdocs.structure.files import File
    from nbconvert import MarkdownExporter

    content, resources = MarkdownExporter().from_filename(str(path))
    folder = str(PurePosixPath(page).with_suffix(""))
    for name, data in resources["outputs"].items():
        files.append(File.generated(config, f"{folder}/{name}", content=data))
        content = content.replace(f"]({name})", f"]({path.stem}/{name})")
    return content


def on_page_markdown(markdown: str, page: Page, **_: Any) -> str:
    """Lead the links of a page to pages of the site."""
    made, here = _sources(), page.file.src_uri
    source = {there: path for path, there in made.items()}.get(here, f"docs/{here}")
    if source.endswith(".ipynb"):  # its pictures lie beside its page
        made = {**made, **{f"notebooks/{PurePosixPath(here).stem}": ""}}
    return linked(with_room_for_lists(markdown), source, here, made)
