# SPDX-License-Identifier: Apache-2.0
"""Weights by name from the Hugging Face hub: ``hf:owner/name``, by the extra ``hub``.

Nothing but ``.safetensors`` files is taken, which hold tensors and text; what is in one is checked as in any
other file of weights. They stay in the hub's own cache: fetched once, a file is there without a network.
"""

from __future__ import annotations

import re
from pathlib import Path

from raytran.errors import CheckpointError

HUB = "hf:"
"""How the name of a checkpoint on the hub begins."""

FILE_ON_HUB = "model.safetensors"
"""What a file of weights is called there, unless its name is given."""

_NAME = re.compile(
    r"hf:(?P<owner>[\w.-]+)/(?P<name>[\w.-]+)(?:/(?P<file>[\w./+-]+\.safetensors))?(?:@(?P<revision>[\w./+-]+))?"
)


def is_on_hub(checkpoint: str) -> bool:
    """Say whether a checkpoint is named as one of the hub."""
    return checkpoint.startswith(HUB)


def file_of_hub(checkpoint: str) -> Path:
    """Return a file of weights of the hub, fetched unless the cache has it.

    Args:
        checkpoint: ``hf:owner/name``, whose ``model.safetensors`` is meant, or
            ``hf:owner/name/FILE.safetensors``; with ``@revision`` behind it, a branch, tag or commit.

    Raises:
        CheckpointError: it is no such name, ``huggingface_hub`` is not installed, there is no such file, or
            it cannot be reached and is not in the cache.
    """
    named = _NAME.fullmatch(checkpoint)
    if named is None:
        raise CheckpointError(
            f"{checkpoint} names no weights of the hub: write hf:owner/name, with /FILE.safetensors for a "
            f"file not called {FILE_ON_HUB}, and @revision for a branch, tag or commit"
        )
    try:
        import huggingface_hub
        from huggingface_hub import errors
    except ImportError as error:
        raise CheckpointError(
            f"{checkpoint} needs the package huggingface_hub: pip install 'raytran[hub]', or give the path "
            "of a .safetensors file"
        ) from error
    repository, file = f"{named['owner']}/{named['name']}", named["file"] or FILE_ON_HUB
    try:
        return Path(huggingface_hub.hf_hub_download(repository, file, revision=named["revision"]))
    except errors.LocalEntryNotFoundError as error:
        raise CheckpointError(
            f"the hub cannot be reached, and its cache has no {file} of {checkpoint}: connect once, or give "
            "the path of a .safetensors file"
        ) from error
    except (
        errors.RepositoryNotFoundError,
        errors.RevisionNotFoundError,
        errors.RemoteEntryNotFoundError,
    ) as error:
        raise CheckpointError(
            f"the hub has no {file} at {checkpoint}, or not for you: check name, file and revision, or log "
            "in by `hf auth login`"
        ) from error
    except (OSError, ValueError) as error:
        reason = str(error).partition("\n")[0]
        raise CheckpointError(f"cannot take {checkpoint} from the hub ({reason}): try again later") from error
