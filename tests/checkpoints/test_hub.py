# SPDX-License-Identifier: Apache-2.0
"""Weights of the hub, out of a cache as the hub's own client keeps it: there is no network here."""

from __future__ import annotations

import sys

import pytest

import raytran
from raytran.checkpoints.file import checkpoint_path, export_weights, read_checkpoint
from raytran.checkpoints.hub import file_of_hub
from raytran.checkpoints.load import prediction_settings
from raytran.errors import CheckpointError

COMMIT = "0123456789abcdef0123456789abcdef01234567"


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """An empty cache of a client that is offline."""
    constants = pytest.importorskip("huggingface_hub.constants")
    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path / "hub"))
    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", True)
    monkeypatch.setenv("HF_HUB_CACHE", str(tmp_path / "hub"))  # for commands
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    return tmp_path / "hub"


@pytest.fixture
def lab(cache, trained):
    """The cached repository ``my-lab/rooms``: two files of weights and a pickle, on main and as a commit."""
    repository = cache / "models--my-lab--rooms"
    snapshot = repository / "snapshots" / COMMIT
    for name in ("model.safetensors", "small/half.safetensors"):
        export_weights(read_checkpoint(trained.path), trained.path, snapshot / name, dtype="float32")
    (snapshot / "model.ckpt").write_bytes(trained.path.read_bytes())
    (repository / "refs").mkdir()
    (repository / "refs" / "main").write_text(COMMIT)
    return snapshot


def test_a_name_is_a_file_of_the_repository(lab, trained):
    assert checkpoint_path("hf:my-lab/rooms") == lab / "model.safetensors"
    assert checkpoint_path(f"hf:my-lab/rooms@{COMMIT}") == lab / "model.safetensors"
    assert (
        checkpoint_path("hf:my-lab/rooms/small/half.safetensors@main") == lab / "small" / "half.safetensors"
    )
    assert raytran.load("hf:my-lab/rooms").state_dict().keys() == trained.model.state_dict().keys()
    assert prediction_settings("hf:my-lab/rooms") == prediction_settings(trained.path)


@pytest.mark.parametrize(
    "name",
    [
        "hf:rooms",
        "hf:my-lab/rooms/model.ckpt",
        "hf:my-lab/rooms/model.safetensors.pkl",
        "hf:a/b@",
        "hf:",
        "hf:/a/b",
    ],
)
def test_what_is_no_name_of_weights_is_refused(lab, name):
    with pytest.raises(CheckpointError, match="names no weights of the hub: write hf:owner/name"):
        file_of_hub(name)


def test_what_is_not_in_the_cache_needs_the_network(lab):
    for name in ("hf:my-lab/chairs", "hf:my-lab/rooms/other.safetensors", "hf:my-lab/rooms@v2"):
        with pytest.raises(CheckpointError, match="the hub cannot be reached, and its cache has no"):
            file_of_hub(name)


def test_answers_of_the_hub_are_one_sentence(cache, monkeypatch):
    import huggingface_hub
    from huggingface_hub import errors

    for error, said in (
        (
            errors.HFValidationError("Repo id must\nbe so"),
            r"cannot take .* \(Repo id must\): try again later",
        ),
        (PermissionError(13, "denied"), "cannot take .*denied"),
        (
            errors.RepositoryNotFoundError.__new__(errors.RepositoryNotFoundError),
            "the hub has no model.safetensors",
        ),
        (errors.GatedRepoError.__new__(errors.GatedRepoError), "or not for you: .*hf auth login"),
        (errors.RevisionNotFoundError.__new__(errors.RevisionNotFoundError), "check name, file and revision"),
    ):

        def refuse(*_, error=error, **__):
            raise error

        monkeypatch.setattr(huggingface_hub, "hf_hub_download", refuse)
        with pytest.raises(CheckpointError, match=said):
            file_of_hub("hf:my-lab/rooms")


def test_without_the_extra_a_sentence_names_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    with pytest.raises(CheckpointError, match=r"pip install 'raytran\[hub\]'"):
        file_of_hub("hf:my-lab/rooms")


def test_a_command_takes_the_name(lab, command, tmp_path):
    done = command("export_model", "checkpoint=hf:my-lab/rooms", folder=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "stage3" in done.stdout
