# SPDX-License-Identifier: Apache-2.0
"""Folders import only from those to their left (design: layout and dependency direction)."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

LAYERS: list[set[str]] = [
    {"errors"},
    {"limits", "tensor_archive"},
    {"classes", "setting_limits"},
    {"structs"},
    {"geometry"},
    {"ops", "norms"},
    {"backbone", "heads"},
    {"model"},
    {"losses", "metrics", "data", "postprocess"},
    {"extensions"},
    {"pictures"},
    {"checkpoints"},
    {"export", "training"},
    {"rooms", "capture", "viewer"},
    {"run"},
    {
        "train",
        "curriculum",
        "evaluate",
        "predict",
        "prepare",
        "plan",
        "demo",
        "view",
        "poses",
        "export_model",
        "__main__",
    },
]
RANK = {name: rank for rank, names in enumerate(LAYERS) for name in names}
WINGS = {"rooms", "capture", "viewer"}
NEEDS_TRAINING = {"lightning", "hydra", "wandb"}
MAY_LAZILY = {("structs", "raytran.run.predict.write_scene")}
"""`ScenePrediction.save` and `show` reach right when they are called, as `raytran.load` does."""


def sources(root: Path) -> list[Path]:
    return sorted((root / "src" / "raytran").rglob("*.py"))


def layer_of(path: Path, root: Path) -> str:
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
                if other == layer or other not in RANK:
                    continue
                is_wing_of_another = other in WINGS and layer != "run"
                if (layer, name) in MAY_LAZILY:
                    continue
                if RANK[other] >= RANK[layer] or is_wing_of_another:
                    found.append(f"{path} ({layer}) imports {name}")
            elif parts[0] in NEEDS_TRAINING and RANK[layer] < RANK["training"]:
                found.append(f"{path} ({layer}) imports {name}")
            elif parts[0] in {"hydra", "omegaconf"} and RANK[layer] < RANK["run"]:
                found.append(f"{path} ({layer}) reads a config: imports {name}")
    return found


def test_imports_point_left(project_root):
    assert violations(project_root) == []


def test_what_reaches_right_is_imported_when_it_is_called(project_root):
    for layer, name in MAY_LAZILY:
        tree = ast.parse((project_root / "src" / "raytran" / f"{layer}.py").read_text())
        assert name not in {node.module for node in tree.body if isinstance(node, ast.ImportFrom)}


@pytest.mark.parametrize(
    ("folder", "line"),
    [
        ("geometry", "from raytran.ops.pairs import PairList"),
        ("losses", "from raytran.data.dataset import SceneDataset"),
        ("model.py", "import lightning"),
        ("training", "from omegaconf import DictConfig"),
        ("training", "from raytran.rooms.generate import generate_room"),
        ("viewer", "from raytran.capture.video import open_video"),
        ("predict.py", "from raytran.capture.video import open_video"),
    ],
)
def test_a_wrong_import_is_found(tmp_path, folder, line):
    target = tmp_path / "src" / "raytran" / folder
    path = target if target.suffix else target / "new.py"
    path.parent.mkdir(parents=True)
    path.write_text(line + "\n")
    assert len(violations(tmp_path)) == 1
