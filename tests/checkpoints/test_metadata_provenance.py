# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import subprocess
import sys
from importlib import metadata

import lightning
import numpy
import torch
import trimesh

import raytran
from raytran.checkpoints.metadata import git_commit, versions


def git(folder, *arguments):
    who = ["-c", "user.name=a", "-c", "user.email=a@b.c"]
    done = subprocess.run(
        ["git", "-C", str(folder), *who, *arguments], check=True, capture_output=True, text=True
    )
    return done.stdout.strip()


def test_commit_of_a_clone(tmp_path):
    package = tmp_path / "src" / "raytran"
    package.mkdir(parents=True)
    (package / "model.py").write_text("one\n")
    git(tmp_path, "init", "-q")
    git(tmp_path, "add", ".")
    git(tmp_path, "commit", "-q", "-m", "one")
    commit = git(tmp_path, "rev-parse", "HEAD")
    assert git_commit(package) == commit
    (package / "model.py").write_text("two\n")
    assert git_commit(package) == f"{commit}+changes"


def test_a_package_installed_inside_another_repository_has_no_commit(tmp_path):
    package = tmp_path / ".venv" / "raytran"
    package.mkdir(parents=True)
    git(tmp_path, "init", "-q")
    assert git_commit(package) is None


def test_versions_name_the_build_of_torch(monkeypatch):
    """PyPI's wheel for CUDA calls itself 2.13.0 in its metadata."""
    monkeypatch.setattr("raytran.checkpoints.metadata.version", lambda name: "1.0")
    assert versions()["torch"] == torch.__version__
    assert type(versions()["torch"]) is str  # checkpoints hold plain Python


def test_versions_are_those_that_run(monkeypatch):
    found = versions()
    assert found["python"] == ".".join(map(str, sys.version_info[:3]))
    assert found["raytran"] == raytran.__version__
    assert found["torch"] == torch.__version__, "with the CUDA it is for"
    for module in (lightning, numpy, trimesh):
        assert found[module.__name__] == module.__version__

    def none(name):
        raise metadata.PackageNotFoundError(name)

    monkeypatch.setattr("raytran.checkpoints.metadata.version", none)
    assert set(versions()) == {"python", "raytran", "torch"}, "what is not installed is left out"
