# SPDX-License-Identifier: Apache-2.0
"""Time and memory of the loader at the paper's size: ``python benchmarks/loader.py [--scenes 1500]``.

First the parts of one sample: 20 frames of 640×480, ten objects, all targets, everything prepared; one thread
and the time of the process itself.
With ``--scenes`` then an epoch of that many scenes: those of ROOT again and again under other names, so their
frames are real and their masks cached. Linux only.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import torch
from timing import median_seconds, print_machine
from torch.utils.data import DataLoader

from raytran.data.augment import Augmentation
from raytran.data.cache import MaskCache
from raytran.data.collate import collate_scenes
from raytran.data.dataset import SceneDataset, scan2cad_dataset
from raytran.data.scan import scan_views
from raytran.data.scannet.scan import read_scan
from raytran.data.targets import foreground_masks, scene_occupancy, shape_grids
from raytran.data.views import choose_even
from raytran.geometry.camera import Cameras
from raytran.geometry.grid import VoxelGrid
from raytran.rooms.generate import generate_rooms

IMAGE_SIZE = (480, 640)
NUM_VIEWS = 20
STRONG = Augmentation(
    yaw_deg=180, shift=(0.5, 0.5, 0.2), mirror=1, brightness=0.2, contrast=0.2, saturation=0.2, hue_deg=10
)


def main() -> None:
    """Measure the parts, and with ``--scenes`` an epoch."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--root", type=Path, help="a prepared data set; without it two rooms are made")
    parser.add_argument("--rounds", type=int, default=11)
    parser.add_argument("--scenes", type=int, default=0)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--csv", type=Path, help="file for the figures")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    print_machine()
    with tempfile.TemporaryDirectory() as folder:
        root = arguments.root or make_rooms(Path(folder) / "rooms")
        rows = parts_of_a_sample(root, Path(folder) / "cache", arguments.rounds)
        if arguments.scenes:
            many = repeat_scenes(root, Path(folder) / "many", arguments.scenes)
            rows |= epoch(many, Path(folder) / "cache", arguments.workers)
    for name, value in rows.items():
        print(f"{name:44s} {value:10,.1f}")
    if arguments.csv:
        with arguments.csv.open("w", newline="") as file:
            csv.writer(file).writerows([("figure", "value"), *rows.items()])


def make_rooms(root: Path) -> Path:
    """Make two rooms of ten objects and 60 frames."""
    generate_rooms(
        root, num_train=2, num_val=0, frames=60, image_size=IMAGE_SIZE, min_objects=10, max_objects=10
    )
    return root


def parts_of_a_sample(root: Path, cache_dir: Path, rounds: int) -> dict[str, float]:
    """Return the median of each part of the first scene, milliseconds."""
    dataset = open_dataset(root, cache_dir, view_choice="even")
    augmented = open_dataset(root, cache_dir, view_choice="even", augmentation=STRONG)
    fill_cache(root, cache_dir)
    sample = dataset[0]
    (objects,) = sample.objects or ()
    scan = read_scan(root / "scannet" / "scans" / sample.scene_id[0])
    chosen = choose_even(len(scan), NUM_VIEWS).tolist()
    cameras = Cameras.of(sample.views.scene())
    grid = VoxelGrid(resolution=(48, 48, 16), extent=(9.0, 9.0, 3.5), center=sample.grid_center[0])
    where = {"shapenet_root": root / "shapenet", "cache": MaskCache(folder=cache_dir)}
    candidates: dict[str, Callable[[], object]] = {
        "whole sample, ms": lambda: dataset[0],
        f"  decode {NUM_VIEWS} of {len(scan)} frames, ms": lambda: scan_views(
            scan, chosen, image_size=IMAGE_SIZE
        ),
        f"  read {NUM_VIEWS} masks, ms": lambda: foreground_masks(objects, cameras, **where),
        f"  read {len(objects)} shapes, ms": lambda: shape_grids(objects.model_id, **where),
        "  occupancy, ms": lambda: scene_occupancy(objects, grid),
        "whole sample with all augmentation, ms": lambda: augmented[0],
        "cameras of a scan not in memory, ms": lambda: read_scan(scan.folder),
    }
    # The process's own time, so that what else the machine does matters less.
    seconds = median_seconds(candidates, rounds, clock=time.process_time)
    return {name: 1e3 * taken for name, taken in seconds.items()}


def fill_cache(root: Path, cache_dir: Path) -> None:
    """Make shapes and masks of all frames, as preparation does."""
    for scene_id in open_dataset(root, cache_dir).scene_ids:
        count = len(read_scan(root / "scannet" / "scans" / scene_id))
        dataset = open_dataset(root, cache_dir, view_choice="even", num_views=count)
        dataset[dataset.scene_ids.index(scene_id)]


def repeat_scenes(root: Path, output: Path, count: int) -> Path:
    """Write ``count`` scenes that are those of ``root`` in turn, by links."""
    entries = json.loads((root / "scan2cad" / "full_annotations.json").read_text(encoding="utf-8"))
    scans = output / "scannet" / "scans"
    repeated = []
    for number in range(count):
        entry = entries[number % len(entries)]
        source = (root / "scannet" / "scans" / entry["id_scan"]).resolve()
        scan_id = f"scene{number:04d}_00"
        (scans / scan_id).mkdir(parents=True)
        for part in ("color", "pose", "intrinsic"):
            (scans / scan_id / part).symlink_to(source / part)
        repeated.append(entry | {"id_scan": scan_id})
    (output / "scan2cad").mkdir()
    (output / "scan2cad" / "full_annotations.json").write_text(json.dumps(repeated), encoding="utf-8")
    (output / "shapenet").symlink_to((root / "shapenet").resolve())
    return output


def epoch(root: Path, cache_dir: Path, workers: int) -> dict[str, float]:
    """Return seconds until the first batch and of the whole epoch, and the memory of the workers."""
    start = time.perf_counter()
    dataset = open_dataset(root, cache_dir, augmentation=Augmentation(yaw_deg=180))
    opened = time.perf_counter() - start
    loader = DataLoader(dataset, num_workers=workers, shuffle=True, collate_fn=collate_scenes)
    batches = iter(loader)
    next(batches)
    first = time.perf_counter() - start
    memory = []
    for number, _ in enumerate(batches):
        if number % 50 == 0:
            memory.append(max(own_mebibytes(process.pid) for process in batches._workers))
            done, own = number + 1, sum(cpu_seconds(process.pid) for process in batches._workers)
    seconds = time.perf_counter() - start - first
    return {
        f"opening {len(dataset)} scenes, s": opened,
        "  until the first batch, s": first,
        f"epoch, {workers} workers, ms a scene": 1e3 * seconds / (len(dataset) - 1),
        "  processor time of the workers, ms a scene": 1e3 * own / done,
        "largest worker after a tenth, MiB": memory[len(memory) // 10],
        "largest worker after half, MiB": memory[len(memory) // 2],
        "largest worker at the end, MiB": memory[-1],
    }


def own_mebibytes(process_id: int) -> float:
    """Return the memory of a process without what it maps from files or shares for transfer."""
    lines = Path(f"/proc/{process_id}/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("RssAnon")) / 1024


def cpu_seconds(process_id: int) -> float:
    """Return the processor time that a process has used, user and system."""
    fields = Path(f"/proc/{process_id}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def open_dataset(root: Path, cache_dir: Path, **options: object) -> SceneDataset:
    """Open the training scenes at the paper's size."""
    settings = {"image_size": IMAGE_SIZE, "num_views": NUM_VIEWS, **options}
    return scan2cad_dataset(root, "train", cache_dir=cache_dir, **settings)


if __name__ == "__main__":
    main()
