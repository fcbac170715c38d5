# SPDX-License-Identifier: Apache-2.0
"""The site of the pages: its navigation leaves nothing out, and links of a clone lead to its pages."""

from __future__ import annotations

import importlib.util

import pytest
import yaml


@pytest.fixture(scope="module")
def site(project_root):
    """The hook of MkDocs."""
    spec = importlib.util.spec_from_file_location("docs_site", project_root / "docs" / "site.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def pages_in(entries):
    for entry in entries:
        if isinstance(entry, str):
            yield entry
        else:
            for below in entry.values():
                yield from pages_in([below] if isinstance(below, str) else below)


def test_the_navigation_has_every_page_once(site, project_root):
    config = yaml.load((project_root / "mkdocs.yml").read_text(), Loader=yaml.BaseLoader)
    shown = sorted(pages_in(config["nav"]))
    docs = project_root / "docs"
    own = {path.relative_to(project_root).as_posix() for path in docs.rglob("*.md")} - site.OUTSIDE.keys()
    made = {**site.OUTSIDE, **site.notebooks()}
    assert shown == sorted([*made.values(), *(page.removeprefix("docs/") for page in own)])
    assert all((project_root / source).is_file() for source in made)
    assert len({page.lower() for page in shown}) == len(shown), (
        "two pages are one where case counts for nothing"
    )


def test_modules_have_pages_in_sections_of_their_folders(site):
    modules = site.modules()
    assert modules["src/raytran/model.py"] == "api/model.md"
    assert modules["src/raytran/ops/__init__.py"] == "api/ops/index.md"
    assert not any("hydra_plugins" in path for path in modules)
    assert site._api("src/raytran/ops/traverse.py") == "# raytran.ops.traverse\n\n::: raytran.ops.traverse\n"
    assert site._api("src/raytran/__init__.py") == "# raytran\n\n::: raytran\n"
    pages = iter(["api/index.md", "api/model.md", "api/ops/index.md", "api/ops/pairs.md"])
    assert site._api_tree(pages) == [
        "api/index.md",
        {"model": "api/model.md"},
        {"ops": ["api/ops/index.md", {"pairs": "api/ops/pairs.md"}]},
    ]


@pytest.mark.parametrize(
    ("written", "shown"),
    [
        ("[a](data.md#disk)", "[a](data.md#disk)"),
        ("[a](../CONVENTIONS.md#frames)", "[a](axes-and-units.md#frames)"),
        ("[`model`](../src/raytran/model.py)", "[`model`](api/model.md)"),
        ("[a](../src/raytran/ops)", "[a](api/ops/index.md)"),
        ("[a](../conf/train.yaml) is a file", "a is a file"),
        ("![a](demo.jpg)", "![a](demo.jpg)"),
        ("`[a](../conf/train.yaml)`", "`[a](../conf/train.yaml)`"),
        ("```\n[a](../conf/train.yaml)\n```", "```\n[a](../conf/train.yaml)\n```"),
        ("[a](https://x.org) [b](#top)", "[a](https://x.org) [b](#top)"),
        ("[a](../notebooks/01_first_scene.ipynb)", "[a](notebooks/01_first_scene.md)"),
    ],
)
def test_links_lead_to_pages_of_the_site(site, written, shown):
    assert site.linked(written, "docs/faq.md", "faq.md", site._sources()) == shown


def test_links_are_seen_from_where_the_page_is(site):
    made = site._sources()
    assert site.linked("![a](docs/demo.jpg)", "README.md", "index.md", made) == "![a](demo.jpg)"
    assert (
        site.linked("[a](../faq.md)", "docs/commands/view.md", "commands/view.md", made) == "[a](../faq.md)"
    )
    path = "src/raytran/weights/README.md"
    assert site.linked("[a](../../../docs/results.md)", path, "weights.md", made) == "[a](results.md)"


def test_lists_get_the_empty_line_that_they_need(site):
    page = "Two:\n- a\n  b\n- c\n\n```\nx\n- y\n```\n"
    assert site.with_room_for_lists(page) == "Two:\n\n- a\n  b\n- c\n\n```\nx\n- y\n```\n"
