# SPDX-License-Identifier: Apache-2.0
"""Pictures of what the benchmarks wrote: ``python benchmarks/plots.py DIR``."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from record import read_rows

Row = dict[str, str]


def main() -> None:
    """Draw what there are figures for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    draw_all(parser.parse_args().folder)


def draw_all(folder: Path) -> None:
    """Draw time and memory against frames and voxels, and the parts of each step that was measured."""
    for name, axis in (("attention-views", "views"), ("attention-voxels", "voxels")):
        rows = read_rows(folder / f"{name}.csv")
        for job in dict.fromkeys(row["job"] for row in rows):
            chosen = [row for row in rows if row["job"] == job]
            draw_curves(chosen, axis, folder / f"{name}-{job.replace(' + ', '-')}.png", title=job)
    for name in ("traversal", "unprojection"):
        rows = read_rows(folder / f"{name}.csv")
        if rows:
            draw_curves(rows, "views", folder / f"{name}.png", title=name)
    for path in sorted(folder.glob("step-*.csv")):
        draw_parts(read_rows(path), path.with_suffix(".png"))


def draw_curves(rows: Sequence[Row], axis: str, path: Path, *, title: str) -> None:
    """Draw time and peak memory against ``axis``, a curve per candidate, on logarithmic scales."""
    figure, panels = plt.subplots(1, 2, figsize=(10, 4), layout="constrained")
    memory = "extra_mib" if "extra_mib" in rows[0] else "peak_mib"
    beyond = "MiB beyond inputs and outputs" if memory == "extra_mib" else "MiB beyond the inputs"
    groups = dict.fromkeys(tuple(row.get(key, "") for key in ("what", "direction", "dtype")) for row in rows)
    for group in groups:
        same = [
            row for row in rows if tuple(row.get(key, "") for key in ("what", "direction", "dtype")) == group
        ]
        label = ", ".join(part.replace("_", " ") for part in group if part)
        for panel, column, factor in ((panels[0], "seconds", 1e3), (panels[1], memory, 1.0)):
            points = sorted(
                (float(row[axis]), factor * float(row[column])) for row in same if row.get(column)
            )
            points = [point for point in points if point[1] > 0]
            if points:
                panel.plot(*zip(*points, strict=True), marker="o", label=label)
    for panel, name in zip(panels, ("milliseconds", beyond), strict=True):
        panel.set(xscale="log", yscale="log", xlabel=axis, ylabel=name)
        panel.grid(which="both", alpha=0.3)
    panels[0].legend(fontsize="x-small")
    figure.suptitle(f"{title}, {rows[0]['gpu'] or rows[0]['processor']}, {rows[0]['date']}")
    _save(figure, path)


def draw_parts(rows: Sequence[Row], path: Path) -> None:
    """Draw what each part of a step takes, and the least that it could."""
    parts = [row for row in rows if row.get("floor_s") and row.get("seconds")][::-1]
    if not parts:
        return
    figure, panel = plt.subplots(figsize=(8, 0.35 * len(parts) + 1.2), layout="constrained")
    names = [row["part"] for row in parts]
    panel.barh(names, [1e3 * float(row["seconds"]) for row in parts], label="taken", color="tab:blue")
    panel.barh(
        names, [1e3 * float(row["floor_s"]) for row in parts], label="floor", color="tab:orange", height=0.4
    )
    panel.set(xlabel="milliseconds a step, forward and backward", title=f"{path.stem}, {parts[0]['date']}")
    panel.legend()
    _save(figure, path)


def _save(figure: plt.Figure, path: Path) -> None:
    figure.savefig(path, dpi=120)
    plt.close(figure)
    print(f"wrote {path}")


if __name__ == "__main__":
    main()
