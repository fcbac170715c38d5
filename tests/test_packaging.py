# SPDX-License-Identifier: Apache-2.0
"""What installs and what CI tries is what pyproject.toml promises; `make resolve` asks PyPI itself."""

from __future__ import annotations

import re
import tomllib

import pytest
import yaml
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet

import raytran


@pytest.fixture(scope="module")
def project(project_root):
    return tomllib.loads((project_root / "pyproject.toml").read_text())["project"]


@pytest.fixture(scope="module")
def pythons(project):
    allowed = SpecifierSet(project["requires-python"])
    return [f"3.{minor}" for minor in range(8, 30) if f"3.{minor}.0" in allowed]


@pytest.fixture(scope="module")
def jobs(project_root):
    return yaml.safe_load((project_root / ".github" / "workflows" / "ci.yml").read_text())["jobs"]


@pytest.fixture(scope="module")
def pins(project_root):
    lines = (project_root / "requirements" / "ci.txt").read_text().splitlines()
    pairs = (line.split("==") for line in lines if not line.startswith("#"))
    return {re.sub(r"[-_.]+", "-", name).lower(): version for name, version in pairs}


def test_the_exact_set_has_all_that_development_needs_in_its_ranges(project, pins):
    for line in [*project["dependencies"], *project["optional-dependencies"]["dev"]]:
        needed = Requirement(line)
        assert pins[needed.name] in needed.specifier, line


@pytest.fixture(scope="module")
def locked(project_root):
    """Packages of ``uv.lock``."""
    return tomllib.loads((project_root / "uv.lock").read_text())["package"]


def test_the_lock_has_the_exact_set_and_what_the_extras_ask_for(project, pins, locked):
    versions = {}
    for package in locked:
        versions.setdefault(package["name"], set()).add(package.get("version"))
    for name, version in pins.items():
        if name != "efficientnet-lite-pytorch":  # of one test, which compares with it
            assert version in versions[name], f"{name}=={version}: run make lock"
    for lines in (project["dependencies"], *project["optional-dependencies"].values()):
        for needed in map(Requirement, lines):
            assert all(version in needed.specifier for version in versions[needed.name.lower()]), needed
    (own,) = (package for package in locked if package["name"] == project["name"])
    extras = {name.replace("_", "-") for name in project["optional-dependencies"]}
    assert set(own["metadata"]["provides-extras"]) == extras, "run make lock"


def test_the_lock_names_files_of_pypi_alone_each_with_its_hash(locked):
    for package in locked:
        if package["source"] == {"editable": "."}:
            continue
        assert package["source"] == {"registry": "https://pypi.org/simple"}, package["name"]
        files = package.get("wheels", []) + ([package["sdist"]] if "sdist" in package else [])
        assert files, package["name"]
        for file in files:
            assert file["url"].startswith("https://files.pythonhosted.org/packages/"), file["url"]
            assert re.fullmatch(r"sha256:[0-9a-f]{64}", file["hash"]), file["url"]


def test_ci_tries_every_python(jobs, pythons, project_root):
    for job in ("test", "wheel"):
        assert jobs[job]["strategy"]["matrix"]["python"] == pythons
    assert f"pythons=({' '.join(pythons)})" in (project_root / "requirements" / "resolve.sh").read_text()


def test_ci_compiles_the_kernels_with_the_installed_triton_and_the_oldest(jobs, pins, project):
    versions = jobs["triton"]["strategy"]["matrix"]["triton"]
    (allowed,) = (
        needed.specifier
        for needed in map(Requirement, project["optional-dependencies"]["dev"])
        if needed.name == "triton"
    )
    assert pins["triton"] in versions
    assert all(version in allowed for version in versions)
    assert versions[0] == str(allowed).removeprefix(">=") + ".0"


def test_the_version_has_a_dated_section_of_changes_and_is_the_one_to_cite(project_root):
    sections = re.findall(
        r"^## \[(.+?)\](?: - (\d{4}-\d\d-\d\d))?$", (project_root / "CHANGELOG.md").read_text(), re.M
    )
    assert sections[0] == ("Unreleased", "")
    cited = yaml.safe_load((project_root / "CITATION.cff").read_text())
    assert sections[1] == (raytran.__version__, str(cited["date-released"]))
    assert cited["version"] == raytran.__version__


def test_every_python_and_address_is_told(project, pythons):
    told = {text.rpartition(" ")[2] for text in project["classifiers"] if "Python :: 3." in text}
    assert told == set(pythons)
    assert all(address.startswith("https://") for address in project["urls"].values())


def test_the_container_has_a_python_and_extras_that_there_are(project, pythons, project_root):
    text = (project_root / "Dockerfile").read_text()
    assert re.search(r"^FROM python:(3\.\d+)-", text, re.M)[1] in pythons
    extras = re.findall(r"--extra (\w+)", text)
    assert extras
    assert set(extras) <= project["optional-dependencies"].keys()
    allowed = {
        line[1:] for line in (project_root / ".dockerignore").read_text().splitlines() if line[0] == "!"
    }
    built_from = {
        "pyproject.toml",
        "uv.lock",
        "README.md",
        "LICENSE",
        "CONVENTIONS.md",
        "src",
        "conf",
        "docs",
    }
    assert allowed == built_from
