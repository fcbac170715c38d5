# SPDX-License-Identifier: Apache-2.0
"""Notebooks run from top to bottom, and show what their files say they show."""

from __future__ import annotations

import importlib.util
import re
import sys
from pathlib import Path

import nbformat
import pytest

import raytran

ROOT = Path(__file__).resolve().parents[2]
NAMES = sorted(path.name for path in (ROOT / "notebooks").glob("*.ipynb"))
FIRST = "01_first_scene.ipynb"
WEIGHTS = sorted((Path(raytran.__file__).parent / "weights").glob("*.safetensors"))
MAX_BYTES = 200_000


@pytest.fixture(scope="module")
def script():
    """``notebooks/execute.py``."""
    spec = importlib.util.spec_from_file_location("notebooks_execute", ROOT / "notebooks" / "execute.py")
    module = sys.modules[spec.name] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def kernel(script):
    with script.running_kernel() as manager:
        yield manager


@pytest.fixture(scope="module")
def untrained(tmp_path_factory):
    """A network that has learned nothing, for a package without weights."""
    from raytran.checkpoints.file import write_checkpoint
    from raytran.checkpoints.metadata import checkpoint_metadata
    from raytran.run.entry import compose
    from raytran.run.train.build import build_model, plain

    path = tmp_path_factory.mktemp("untrained") / "last.ckpt"
    config = compose("train", ["preset=tiny", "model.grid_resolution=[8,8,4]", f"output_dir={path.parent}"])
    card = checkpoint_metadata(stage="stage3", preset="tiny", config=plain(config), parent=None)
    state = build_model(config, pretrained=False).state_dict()
    write_checkpoint(path, {**card, "state_dict": {f"model.{name}": value for name, value in state.items()}})
    return path


def printed(notebook):
    """Return what each cell prints, without the numbers, and which pictures it shows."""
    shown = []
    for cell in notebook.cells:
        for output in cell.get("outputs", ()):
            data = output.get("data", {})
            text = output.get("text") or (data.get("text/plain", "") if set(data) == {"text/plain"} else "")
            numberless = re.sub(r"[-+]?\d[\d.e+-]*", "0", text)
            pictures = sorted(kind for kind in data if kind.startswith("image/"))
            shown.append((cell.id, re.sub(r"\s+", " ", re.sub(r"[\[\] ]+", " ", numberless)), pictures))
    return shown


@pytest.mark.parametrize("name", NAMES)
def test_runs_and_shows_what_its_file_has(name, script, kernel, request, tmp_path):
    path = ROOT / "notebooks" / name
    stored = nbformat.read(path, as_version=4)
    if name == FIRST and not WEIGHTS:
        source = path.read_text(encoding="utf-8")
        assert source.count('CHECKPOINT = \\"default\\"') == 1
        path = tmp_path / name
        path.write_text(
            source.replace("default", str(request.getfixturevalue("untrained"))), encoding="utf-8"
        )
    fresh = script.executed(path, kernel)
    assert not [
        output for cell in fresh.cells for output in cell.get("outputs", ()) if "stderr" in output.values()
    ]
    if name != FIRST or WEIGHTS:
        assert printed(fresh) == printed(stored), f"{name} shows something else now: run notebooks/execute.py"


@pytest.mark.parametrize("name", NAMES)
def test_files_are_small_and_say_nothing_of_a_machine(name, script):
    path = ROOT / "notebooks" / name
    text = path.read_text(encoding="utf-8")
    assert len(text) < MAX_BYTES
    assert not re.search(r"/(home|tmp|root|Users|work)/", text)
    notebook = nbformat.read(path, as_version=4)
    assert nbformat.writes(script.cleaned(notebook)).strip() == text.strip(), (
        f"run notebooks/execute.py {name}"
    )


def test_a_failing_cell_is_reported(script, kernel, tmp_path):
    cells = [nbformat.v4.new_code_cell("x = 1"), nbformat.v4.new_code_cell("assert x == 2")]
    nbformat.write(nbformat.v4.new_notebook(cells=cells), tmp_path / "wrong.ipynb")
    with pytest.raises(Exception, match="AssertionError"):
        script.executed(tmp_path / "wrong.ipynb", kernel)


def test_a_notebook_sees_nothing_of_the_one_before(script, kernel, tmp_path):
    for name, source in (("a", "left_over = 1"), ("b", "print('left_over' in globals())")):
        cells = [nbformat.v4.new_code_cell(source)]
        nbformat.write(nbformat.v4.new_notebook(cells=cells), tmp_path / f"{name}.ipynb")
        done = script.executed(tmp_path / f"{name}.ipynb", kernel)
    assert done.cells[0].outputs[0].text == "False\n"
