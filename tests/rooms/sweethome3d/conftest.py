# SPDX-License-Identifier: Apache-2.0
"""A small furniture library, made here: one chair whose every side tells where it is."""

from __future__ import annotations

import io
import zipfile

import numpy as np
import pytest
from PIL import Image

# In metres, +Y up. A seat, a back at -Z (the front is +Z), and a red post at its right front corner (+X, +Z).
BOXES = (
    ("cloth", (-0.2, 0.0, -0.2), (0.2, 0.4, 0.2)),
    ("cloth", (-0.2, 0.4, -0.2), (0.2, 0.8, -0.1)),
    ("post", (0.15, 0.4, 0.15), (0.2, 0.6, 0.2)),
)
MTL = "newmtl cloth\nKd 1 1 1\nmap_Kd cloth.png\nnewmtl post\nKd 1 0 0\n"
HEAD = "id=Test\nname=Scopia catalog\nlicense=Creative Commons \\u00a9 Test\n"


def _entry(number, piece, **fields):
    values = {
        "id": piece,
        "name": "Chair, with post",
        "creator": "Ann Author",
        "model": "/scopia/chair/chair.obj",
        "width": "50.0",
        "depth": "60",
        "height": "90.0",
    } | fields
    return "".join(f"{key}#{number}={value}\n" for key, value in values.items() if value is not None)


def obj_text(scale=1.0):
    """Return the chair as quads, with texture coordinates in the left half of the texture."""
    lines, faces, count = ["mtllib chair.mtl", "vt 0.1 0.1", "vt 0.4 0.1", "vt 0.4 0.9", "vt 0.1 0.9"], [], 0
    for material, low, high in BOXES:
        corners = [[(low, high)[bit][axis] for axis, bit in enumerate(bits)] for bits in np.ndindex(2, 2, 2)]
        lines += ["v {} {} {}".format(*(scale * value for value in corner)) for corner in corners]
        quads = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
        faces.append(f"usemtl {material}")
        faces += ["f " + " ".join(f"{count + i + 1}/{k + 1}" for k, i in enumerate(quad)) for quad in quads]
        count += 8
    return "\n".join(lines + faces) + "\n"


def texture():
    """Return a picture whose left half is blue and whose right half is green."""
    pixels = np.zeros((32, 32, 3), dtype=np.uint8)
    pixels[:, :16, 2], pixels[:, 16:, 1] = 255, 255
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, format="PNG")
    return file.getvalue()


@pytest.fixture(scope="session")
def entry():
    """Return a function that gives the lines of one catalogue entry: number, id, other fields."""
    return _entry


@pytest.fixture(scope="session")
def write_library():
    """Return a function that writes a library with the chair, and whatever else is given."""

    def write(path, *entries, head=HEAD, **files):
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as library:
            library.writestr("PluginFurnitureCatalog.properties", head + "\n".join(entries))
            library.writestr("LICENSE.TXT", "Models are by Ann Author.\r\n")
            library.writestr("scopia/chair/chair.obj", obj_text())
            library.writestr("scopia/chair/chair.mtl", MTL)
            library.writestr("scopia/chair/cloth.png", texture())
            for name, content in files.items():
                library.writestr(name, content)
        return path

    return write


@pytest.fixture(scope="session")
def library(tmp_path_factory, write_library, entry):
    """Return a library with one listed chair and one piece that is not listed."""
    path = tmp_path_factory.mktemp("library") / "Test.sh3f"
    return write_library(path, entry(1, "Scopia#chair"), entry(2, "Scopia#parrot"))
