# SPDX-License-Identifier: Apache-2.0
"""Folders import only from those to their left (design: layout and dependency direction)."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

LAYERS: list[set[str]] = [
    {"parcel"},
    {"types", "errors"},
    {"geometry"},
    {"ops"},
    {"backbone", "heads"},
    {"model"},
    {"losses", "metrics", "data", "postprocess"},
    {"export", "view"},
    {"training"},
    {"run"},
    {"train", "curriculum", "evaluate", "predict", "prepare", "plan", "demo", "replay", "report", "__main__"}
    | {"export_model"},
]
RANK = {name: rank for rank, names in enumerate(LAYERS) for name in names}
NEEDS_TRAINING = {"lightning", "hydra", "wandb"}
MAY_LAZILY = {
    "__init__": "run"
}  # `raytran.load` is the one public name that reaches right, when it is called


def sources(root: Path) -> list[Path]:
    return sorted((root / "src" / "raytran").rglob("*.py"))


def layer_of(path: Path, root: Path) -> str:
    if path.name == "__main__.py":  # what `python -m raytran.<folder>` runs is an entry point
        return "__main__"
    return path.relative_to(root / "src" / "raytran").parts[0].removesuffix(".py")


def imported_modules(path: Path) -> list[str]:
    names = []
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            names += (
                [f"raytran.{alias.name}" for alias in node.names]
                if node.module == "raytran"
                else [node.module or ""]
            )
    return names


def violations(root: Path) -> list[str]:
    found = []
    for path in sources(root):
        layer = layer_of(path, root)
        if layer == "__init__":
            continue
        if layer not in RANK:
            found.append(f"{path}: the folder or file {layer} has no place in LAYERS")
            continue
        for name in imported_modules(path):
            parts = name.split(".")
            if parts[0] == "raytran" and len(parts) > 1:
                other = parts[1]
                if other != layer and other in RANK and RANK[other] >= RANK[layer]:
                    found.append(f"{path} ({layer}) imports {name}")
            elif parts[0] in NEEDS_TRAINING and RANK[layer] < RANK["training"]:
                found.append(f"{path} ({layer}) imports {name}")
            elif parts[0] in {"hydra", "omegaconf"} and RANK[layer] < RANK["run"]:
                found.append(f"{path} ({layer}) reads a config: imports {name}")
    return found


def test_imports_point_left(project_root):
    assert violations(project_root) == []


@pytest.mark.parametrize(
    ("folder", "line"),
    [
        ("geometry", "from raytran.ops.pairs import PairList"),
        ("losses", "from raytran.data.dataset import SceneDataset"),
        ("model.py", "import lightning"),
        ("training", "from omegaconf import DictConfig"),
    ],
)
def test_a_wrong_import_is_found(tmp_path, folder, line):
    target = tmp_path / "src" / "raytran" / folder
    path = target if target.suffix else target / "new.py"
    path.parent.mkdir(parents=True)
    path.write_text(line + "\n")
    assert len(violations(tmp_path)) == 1
