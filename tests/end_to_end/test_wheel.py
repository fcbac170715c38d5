# SPDX-License-Identifier: Apache-2.0
"""An installed wheel carries the configs and the page template; its commands run from any folder."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def site(project_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with nothing but the installed wheel."""
    folder = tmp_path_factory.mktemp("wheel")
    pip = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check"]
    build = ["wheel", "--no-deps", "--no-build-isolation", "--wheel-dir", str(folder), str(project_root)]
    subprocess.run([*pip, *build], check=True)
    (wheel,) = folder.glob("raytran-*.whl")
    subprocess.run(
        [*pip, "install", "--no-deps", "--no-index", "--target", str(folder / "site"), str(wheel)], check=True
    )
    return folder / "site"


def run(site: Path, folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    environment = os.environ | {"PYTHONPATH": str(site)}
    return subprocess.run(
        [sys.executable, *words], cwd=folder, env=environment, capture_output=True, text=True, check=False
    )


def test_the_wheel_is_what_runs(site: Path, tmp_path: Path) -> None:
    where = run(site, tmp_path, "-c", "import raytran.run.config_dir as c; print(c.__file__, c.config_dir())")
    assert where.stdout.split() == [
        str(site / "raytran" / "run" / "config_dir.py"),
        str(site / "raytran" / "conf"),
    ]


@pytest.mark.parametrize(
    "command",
    [
        "train",
        "curriculum",
        "evaluate",
        "predict",
        "prepare",
        "demo",
        "poses",
        "export_model",
        "view",
    ],
)
def test_commands_find_their_configs(site: Path, tmp_path: Path, command: str) -> None:
    shown = run(site, tmp_path, "-m", f"raytran.{command}", "--cfg", "job")
    assert shown.returncode == 0, shown.stderr
    assert list(tmp_path.iterdir()) == []


def test_sweeps_find_their_launcher(site: Path, tmp_path: Path) -> None:
    shown = run(site, tmp_path, "-m", "raytran.train", "--info", "plugins")
    assert shown.returncode == 0, shown.stderr
    assert "ProcessLauncher" in shown.stdout
    where = run(site, tmp_path, "-c", "import hydra_plugins.raytran_launcher as p; print(p.__file__)")
    assert where.stdout.strip() == str(site / "hydra_plugins" / "raytran_launcher" / "__init__.py")


def test_rooms_are_made_where_the_user_is(site: Path, tmp_path: Path) -> None:
    words = ["-m", "raytran.prepare", "dataset=rooms", "output=rooms", "preset=tiny", "processes=1"]
    small = ["num_train=1", "num_val=1", "frames=3", "image_size=[48,64]", "max_objects=3"]
    made = run(site, tmp_path, *words, *small)
    assert made.returncode == 0, made.stderr
    assert (tmp_path / "rooms" / "scan2cad" / "full_annotations.json").is_file()


def test_all_that_is_no_python_is_inside(site: Path, project_root: Path) -> None:
    """Templates and weights."""

    def files(package: Path) -> set[Path]:
        found = {path.relative_to(package) for path in package.rglob("*.*") if path.is_file()}
        own = {path for path in found if path.parts[0] not in ("conf", "docs", "CONVENTIONS.md")}
        return {path for path in own if path.suffix not in (".py", ".pyc")}

    assert files(site / "raytran") == files(project_root / "src" / "raytran")
    assert any(path.suffix == ".safetensors" for path in files(site / "raytran"))
    assert any(path.suffix == ".j2" for path in files(site / "raytran"))
    assert (site / "raytran" / "py.typed").is_file()


def test_the_pages_that_messages_name_are_inside(site: Path, project_root: Path, tmp_path: Path) -> None:
    pages = {path.relative_to(project_root) for path in (project_root / "docs").rglob("*.md")}
    assert pages == {path.relative_to(site / "raytran") for path in (site / "raytran" / "docs").rglob("*.md")}
    assert (site / "raytran" / "CONVENTIONS.md").is_file()
    assert not list((site / "raytran" / "docs").rglob("*.py"))
    shown = run(site, tmp_path, "-m", "raytran.predict", "--help")
    assert f"The folder docs/ is {site / 'raytran' / 'docs'}\n" in shown.stdout


def test_the_page_of_an_index_links_to_nothing_that_is_not_there(site: Path) -> None:
    (metadata,) = site.glob("raytran-*.dist-info/METADATA")
    text = metadata.read_text(encoding="utf-8")
    links = re.findall(r"\]\(([^)]+)\)", text)
    assert links
    assert all(link.startswith("https://") for link in links), links
    assert "![" not in text
