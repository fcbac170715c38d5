# SPDX-License-Identifier: Apache-2.0
"""The browser that draws the documentation's pictures, on a page of the test's own; needs Chromium."""

from __future__ import annotations

import os
import runpy
import shutil
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("viser", reason="needs viser (pip install 'raytran[viewer]')")

PAGE = """<meta name=color-scheme content="light dark"><meta name=viewport content="width=device-width">
<body style="margin: 0"><div style="width: 100%; height: 3000px; background: #f00"></div>"""


@pytest.mark.nightly
@pytest.mark.skipif(not (os.environ.get("CHROMIUM") or shutil.which("chromium")), reason="needs Chromium")
def test_pages_are_drawn_as_on_a_screen_and_on_a_phone(tmp_path):
    script = runpy.run_path(str(Path(__file__).parents[2] / "docs" / "viewer_pictures.py"))
    page = tmp_path / "page.html"
    page.write_text(PAGE)
    for what, width in (("page", 1280), ("phone", 390)):
        picture = np.asarray(script["page_picture"](page, what))
        assert picture.shape == (1500, width, 3)
        assert (picture == (255, 0, 0)).all()
