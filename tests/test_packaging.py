# SPDX-License-Identifier: Apache-2.0
"""What installs and what CI tries is what pyproject.toml promises; `make resolve` asks PyPI itself."""

from __future__ import annotations

import re
import tomllib

import pytest
import yaml
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet


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
