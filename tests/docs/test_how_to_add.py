# SPDX-License-Identifier: Apache-2.0
"""docs/how-to-add.md, followed to the letter: in a package of one's own, and in a copy of the tree."""

from __future__ import annotations

import csv
import functools
import json
import os
import re
import shutil
import subprocess
import sys

import numpy as np
import pytest
import torch

from raytran.rooms.generate import generate_rooms

from ..test_layers import violations

FILE = re.compile(r"^```(?:python|yaml)\n# lab/(\S+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
TYPED = re.compile(r"^raytran (\w+) --config-dir lab/conf (.*?)(?:\s+#.*)?$", re.MULTILINE)
SETTINGS = (
    "preset=tiny",
    "trainer=cpu",
    "views.image_size=[64,64]",
    "views.num_views=3",
    "views.predict_views=4",
    "model.grid_resolution=[8,8,4]",
    "model.heads.objects.num_queries=8",
    "trainer.max_steps=1",
    "trainer.val_check_interval=1",
    "schedule.log_every=1",
    "watch.pictures=0",
    "progress_bar=none",
)


@pytest.fixture(scope="module")
def sections(project_root):
    """Text of the page under each of its headings; that of the backbone is a page of its own."""
    page = (project_root / "docs" / "how-to-add.md").read_text(encoding="utf-8")
    found = dict(part.split("\n", 1) for part in re.split(r"^## ", page, flags=re.MULTILINE)[1:])
    own = (project_root / "docs" / "own-network.md").read_text(encoding="utf-8")
    return found | {"A backbone": own.split("## Trust")[0]}


@pytest.fixture(scope="module")
def table(project_root):
    """The page's table: for each recipe the files of a package, those of the tree, and lines of PARTS."""
    page = (project_root / "docs" / "how-to-add.md").read_text(encoding="utf-8")
    rows = [line.strip("|").split("|") for line in page.splitlines() if re.match(r"\| [a-z]", line)]
    return {name.strip(): [re.findall(r"`([^`]+)`", cell) for cell in cells] for name, *cells in rows}


@pytest.fixture(scope="module")
def rooms(tmp_path_factory):
    """Three rooms, with a bed in that of validation."""
    folder = tmp_path_factory.mktemp("rooms")
    generate_rooms(
        folder,
        num_train=2,
        num_val=1,
        seed=4,
        frames=6,
        image_size=(64, 64),
        min_objects=3,
        max_objects=4,
        room_size=((3.0, 3.5), (3.0, 3.5)),
        processes=1,
        progress=False,
    )
    return folder


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    """Three scenes as .npz files: cameras that look along +y at a box."""
    folder = tmp_path_factory.mktemp("npz")
    pose = np.eye(4, dtype=np.float32)
    pose[:3, :3] = [[1, 0, 0], [0, 0, 1], [0, -1, 0]]
    for name in ("train/a", "train/b", "val/c"):
        (folder / name).parent.mkdir(exist_ok=True)
        np.savez(
            folder / f"{name}.npz",
            images=np.full((5, 48, 64, 3), 99, np.uint8),
            intrinsics=np.tile(np.float32([[50, 0, 32], [0, 50, 24], [0, 0, 1]]), (5, 1, 1)),
            world_from_camera=np.tile(pose, (5, 1, 1)),
            label=np.int64([3]),
            center=np.float32([[0, 1.5, 0]]),
            size=np.float32([[2, 2, 2]]),
            yaw=np.float32([0.3]),
        )
    return folder


@pytest.fixture(scope="module")
def lab(tmp_path_factory, sections):
    """A folder with ``lab``: every file that the page shows."""
    folder = tmp_path_factory.mktemp("work")
    for text in sections.values():
        for name, content in FILE.findall(text):
            (folder / "lab" / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / "lab" / name).write_text(content)
    (folder / "lab" / "src" / "mylab" / "__init__.py").touch()
    return folder


@pytest.fixture(scope="module")
def run(lab, command, sections):
    """Run a command that the page shows in a section, with further settings."""
    path = os.pathsep.join([str(lab / "lab" / "src"), os.environ.get("PYTHONPATH", "")])
    start = functools.partial(command, folder=lab, PYTHONPATH=path)

    def type_in(section, number, *more, checkpoint=None):
        name, words = TYPED.findall(sections[section])[number]
        typed = words.replace("CKPT", str(checkpoint)).split()
        done = start(name, "--config-dir", "lab/conf", *typed, *more)
        assert done.returncode == 0, done.stdout + done.stderr
        return done

    return type_in


def logged(folder):
    """Return the last value of each column of a run's table."""
    with (folder / "metrics.csv").open() as file:
        rows = list(csv.DictReader(file))
    return {name: float(value) for row in rows for name, value in row.items() if value}


def test_the_table_names_at_most_three_files(table, sections):
    assert list(table) == ["head", "data set", "metric", "backbone", "class list"]
    for name, (package, tree, config, parts) in table.items():
        shown = [file for file, _ in FILE.findall(sections[f"A {name}"])]
        assert shown == [*package, *config]
        assert len([*tree, *config, *(["PARTS"] if parts else [])]) <= 3


def test_a_head(run, lab, rooms):
    data = [f"data.root={rooms}", *SETTINGS]
    run("A head", 0, *data)
    run("A head", 1, *data, "output_dir=counted")
    numbers = logged(lab / "counted")
    assert numbers["train/count"] > 0
    assert numbers["val/count"] > 0
    card = torch.load(lab / "counted" / "checkpoints" / "last.ckpt", weights_only=True)
    assert card["parent"]["stage"] == "stage1"
    assert "model.heads.count.linear.weight" in card["state_dict"]


def test_a_data_set(run, lab, scenes):
    run("A data set", 0, f"data.root={scenes}", *SETTINGS, "output_dir=of-npz")
    assert logged(lab / "of-npz")["val/occupancy/iou"] >= 0
    checkpoint = lab / "of-npz" / "checkpoints" / "last.ckpt"
    run("A data set", 1, f"data.root={scenes}", "output=npz-results", checkpoint=checkpoint)
    metrics = json.loads((lab / "npz-results" / "metrics.json").read_text())
    assert metrics["dataset"] == "npz"
    assert metrics["strict"]["per_class"]["chair"]["n_total"] == 1


def test_a_metric(run, lab, rooms):
    run("A metric", 0, f"data.root={rooms}", *SETTINGS, "init_from=none", "output_dir=scored")
    assert logged(lab / "scored")["val/count_error"] >= 0
    checkpoint = lab / "scored" / "checkpoints" / "last.ckpt"
    run("A metric", 1, f"data.root={rooms}", "output=scores", checkpoint=checkpoint)
    assert json.loads((lab / "scores" / "metrics.json").read_text())["count_error"] >= 0


def test_a_backbone(run, lab, rooms):
    run("A backbone", 0, f"data.root={rooms}", *SETTINGS, "output_dir=mine")
    card = torch.load(lab / "mine" / "checkpoints" / "last.ckpt", weights_only=True)
    assert card["model"]["backbone"]["_target_"] == "mylab.MyBackbone"


@pytest.fixture
def copy(tmp_path, project_root):
    """A copy of the tree: sources and configs."""
    for name in ("src/raytran", "conf"):
        shutil.copytree(project_root / name, tmp_path / name)
    return tmp_path


def run_in(copy, *runs):
    """Train in a copy, one process for all runs; each is a list of settings."""
    script = (
        "import json, sys\n"
        "from raytran.checkpoints.load import load_model\n"
        "from raytran.run.entry import compose\n"
        "from raytran.run.train.fit import train\n"
        "for words in json.loads(sys.argv[1]):\n"
        "    load_model(train(compose('train', words)).checkpoint)\n"
    )
    environment = os.environ | {"PYTHONPATH": str(copy / "src"), "OMP_NUM_THREADS": "1"}
    words = json.dumps([[*SETTINGS, *more] for more in runs])
    done = subprocess.run(
        [sys.executable, "-c", script, words], cwd=copy, env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
def test_in_the_tree(copy, table, sections, rooms, scenes):
    """The same files where the table puts them, and a checkpoint of each network that needs no trust."""
    parts = []
    for name, (package, tree, config, registered) in table.items():
        if not tree:
            continue
        files = dict(FILE.findall(sections[f"A {name}"]))
        module = ".".join((copy / tree[0]).relative_to(copy / "src").with_suffix("").parts)
        theirs = package[0].removeprefix("src/").removesuffix("/__init__.py").removesuffix(".py")
        (copy / tree[0]).write_text(files[package[0]])
        target = copy / config[0]
        target.parent.mkdir(exist_ok=True)
        target.write_text(files[config[0]].replace(theirs.replace("/", "."), module))
        parts += [f'    "{part}": "{module}",\n' for part in registered]
    network = copy / "src" / "raytran" / "checkpoints" / "network.py"
    start = "PARTS: dict[str, str] = {\n"
    network.write_text(network.read_text().replace(start, start + "".join(parts)))
    assert violations(copy) == []
    data = f"data.root={rooms}"
    run_in(
        copy,
        ["experiment=stage1", "model/backbone=mine", data, "output_dir=mine"],
        ["experiment=count_stage2", "init_from=none", "+metrics=count_error", data, "output_dir=counted"],
        ["experiment=stage1", "data=npz", f"data.root={scenes}", "output_dir=of-npz"],
    )
    numbers = logged(copy / "counted")
    assert {"val/count", "val/count_error"} <= set(numbers)
    card = torch.load(copy / "mine" / "checkpoints" / "last.ckpt", weights_only=True)
    assert card["model"]["backbone"]["_target_"] == "MyBackbone"


def test_a_class_list(run, lab, rooms):
    data = ["init_from=none", f"data.root={rooms}", *SETTINGS]
    run("A class list", 0, *data, "output_dir=bedroom")
    assert "val/objects/accuracy/bed" in logged(lab / "bedroom")
    state = torch.load(lab / "bedroom" / "checkpoints" / "last.ckpt", weights_only=True)["state_dict"]
    sizes = {value.shape[0] for name, value in state.items() if name.endswith("category.weight")}
    assert sizes == {4, 5}, "with the padding class, and without"
