# SPDX-License-Identifier: Apache-2.0
"""One picture of what ``raytran predict`` wrote: ``python docs/picture.py PREDICTION PICTURE.jpg``.

Frames with boxes and meshes on the left, the plan on the right; small enough for a README.
"""

from __future__ import annotations

import sys
from pathlib import Path

from PIL import Image

HEIGHT = 640
GAP = 6


def picture(folder: Path) -> Image.Image:
    """Return the picture of a result folder; the number of its overlays decides their columns."""
    frames = [Image.open(path).convert("RGB") for path in sorted((folder / "overlays").glob("*.jpg"))]
    plan = Image.open(folder / "topdown.png").convert("RGB")
    rows = 2 if len(frames) > 1 else 1
    columns = -(-len(frames) // rows)
    height = (HEIGHT - (rows - 1) * GAP) // rows
    width = round(height * frames[0].width / frames[0].height) if frames else 0
    plan = plan.resize((round(HEIGHT * plan.width / plan.height), HEIGHT), Image.Resampling.LANCZOS)
    sheet = Image.new("RGB", (columns * (width + GAP) + plan.width, HEIGHT), "white")
    for number, frame in enumerate(frames):
        row, column = divmod(number, columns)
        place = (column * (width + GAP), row * (height + GAP))
        sheet.paste(frame.resize((width, height), Image.Resampling.LANCZOS), place)
    sheet.paste(plan, (sheet.width - plan.width, 0))
    return sheet


if __name__ == "__main__":
    source, target = map(Path, sys.argv[1:])
    picture(source).save(target, quality=85, optimize=True)
