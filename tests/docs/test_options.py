# SPDX-License-Identifier: Apache-2.0
"""Tables of settings in the pages are those of ``conf/``."""

from __future__ import annotations

import importlib.util
import sys

import pytest

from raytran.run.conf_comments import header, options
from raytran.run.config_dir import config_dir


@pytest.fixture(scope="module")
def tables(project_root):
    """The script that makes the tables."""
    spec = importlib.util.spec_from_file_location("docs_options", project_root / "docs" / "options.py")
    module = sys.modules[spec.name] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_pages_say_what_conf_says(tables):
    for page in tables.pages():
        text = page.read_text(encoding="utf-8")
        assert tables.filled(text) == text, f"{page} is behind conf/: run python docs/options.py"


@pytest.mark.parametrize("root", sorted(path.stem for path in config_dir().glob("*.yaml")))
def test_every_setting_of_a_command_is_explained(tables, root):
    shown = "".join(page.read_text(encoding="utf-8") for page in tables.pages())
    assert f"<!-- options: {root} -->" in shown, f"no page of docs has the settings of {root}"
    silent = [option.name for option in options(root) if not option.comment]
    assert not silent, f"conf/{root}.yaml says nothing about {', '.join(silent)}"


def test_a_table_follows_its_file(tables, tmp_path, monkeypatch):
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "x.yaml").write_text(
        "# Head. More.\nside: 3  # metres,\n                # a <size> | null\n\n# later\nlist: [1,\n 2]\n"
        "part:  # of it\n  deep: {a: 1}\n_target_: hidden\n"
    )
    monkeypatch.setattr(tables, "CONF", tmp_path)
    page = "before\n<!-- options: data/x -->\nstale\n<!-- end -->\nafter\n"
    assert tables.filled(page).splitlines() == [
        "before",
        "<!-- options: data/x -->",
        "| setting | default | |",
        "|---|---|---|",
        r"| `data.side` | `3` | metres, a &lt;size> \| null |",
        "| **later** | | |",
        "| `data.list` | `[1, 2]` |  |",
        "| **`data.part.…` of it** | | |",
        "| `data.part.deep.a` | `1` |  |",
        "<!-- end -->",
        "after",
    ]
    assert tables.filled(tables.filled(page)) == tables.filled(page)
    assert header(tmp_path / "data" / "x.yaml") == "Head"
