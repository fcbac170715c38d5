# SPDX-License-Identifier: Apache-2.0
"""Links of the pages lead somewhere: to a file that is there, and to a heading in it."""

from __future__ import annotations

import re
from urllib.parse import unquote

from .conftest import text_of

LINK = re.compile(r"\[[^\]]*\]\(([^)\s]+)\)")
HEADING = re.compile(r"^#+ (.+)$", re.MULTILINE)
FENCE = re.compile(r"^```.*?^```$", re.MULTILINE | re.DOTALL)


def links(text):
    """Return what a page links to, but for addresses of the web."""
    without_code = re.sub(r"`[^`\n]*`", "", FENCE.sub("", text))
    return [link for link in LINK.findall(without_code) if not re.match(r"[a-z]+:", link)]


def anchors(text):
    """Return the names that GitHub gives to the headings of a page."""
    titles = [re.sub(r"[^\w\- ]", "", title.lower()) for title in HEADING.findall(FENCE.sub("", text))]
    return {title.strip().replace(" ", "-") for title in titles}


def test_relative_links_resolve(pages, project_root):
    count = 0
    for page, text in pages.items():
        for link in links(text):
            name, _, anchor = unquote(link).partition("#")
            path = (page.parent / name).resolve() if name else page
            assert path.is_relative_to(project_root), f"{page}: {link} leaves the project"
            assert path.exists(), f"{page}: there is no {link}"
            if anchor:
                assert anchor in anchors(text_of(path)), f"{page}: {link} has no such heading"
            count += 1
    assert count > 40


def test_the_check_finds_what_is_wrong():
    page = "# Top\n[a](x.md) `[b](y.md)` [c](https://z.org)\n```\n[d](w.md)\n```\n## Its `code`, too!\n"
    assert links(page) == ["x.md"]
    assert anchors(page) == {"top", "its-code-too"}


def test_every_page_is_found_from_the_first(pages, project_root):
    seen, to_read = set(), [project_root / "docs" / "README.md"]
    while to_read:
        page = to_read.pop()
        if page in seen or page not in pages:
            continue
        seen.add(page)
        to_read += [(page.parent / unquote(link).partition("#")[0]).resolve() for link in links(pages[page])]
    lost = [page for page in pages if page not in seen and page.is_relative_to(project_root / "docs")]
    assert not lost, f"docs/README.md leads to no link to {', '.join(path.name for path in lost)}"
