# SPDX-License-Identifier: Apache-2.0
"""Networks from the config inside a checkpoint, which may come from anybody."""

from __future__ import annotations

import importlib
import re
from collections.abc import Mapping
from typing import Any

from torch import nn

from raytran.errors import CheckpointError

_MODULE = re.compile(r"raytran\.(model|backbone|heads)(\.[a-z_]+)*")
"""Where the parts of a network are defined."""

_NOT_THE_NETWORK = ("attention", "freeze_norms")
"""Settings beside those of the network: how it was computed there, and how older ones were trained."""

_PLAIN = (str, int, float, bool, type(None))


def build_network(config: Mapping[str, Any], source: object) -> nn.Module:
    """Return the network that ``config`` describes, without any weights of its own.

    A node with ``_target_`` stands for a class of raytran's networks, the other keys for its arguments; there
    is nothing else: no functions, no classes that a module has only imported, no references to resolve.

    Args:
        config: the config from a checkpoint.
        source: what to name in messages: the file.

    Raises:
        CheckpointError: the config asks for anything else; that is then neither imported nor run. Or the
            classes do not take these arguments.
    """
    try:
        built = _build(config, source)
    except (TypeError, ValueError, RuntimeError, AttributeError, KeyError, IndexError, MemoryError) as error:
        raise CheckpointError(
            f"the network described in {source} cannot be built ({str(error).splitlines()[0]}): "
            "the file is of another version of raytran, or damaged"
        ) from error
    if not isinstance(built, nn.Module):
        raise CheckpointError(f"{source} describes no network: do not use this file")
    return built


def _build(node: Any, source: object) -> Any:
    if isinstance(node, Mapping):
        values = {name: _build(value, source) for name, value in node.items() if name != "_target_"}
        if any(not isinstance(name, str) or name.startswith("_") for name in values):
            raise CheckpointError(f"the network described in {source} has odd settings: do not use this file")
        if "_target_" not in node:
            return values
        if "weights" in values:
            values["weights"] = None  # they are in the checkpoint: nothing is to be read or fetched
        for name in _NOT_THE_NETWORK:
            values.pop(name, None)
        return _class(node["_target_"], source)(**values)
    if isinstance(node, list | tuple):
        return [_build(value, source) for value in node]
    if not isinstance(node, _PLAIN):
        raise CheckpointError(f"the network described in {source} has odd settings: do not use this file")
    return node


def _class(target: Any, source: object) -> type[nn.Module]:
    """Return the class of that name, if it is one of raytran's own networks."""
    module, _, name = str(target).rpartition(".")
    # The name is looked at before anything is imported: an import runs code as well.
    if _MODULE.fullmatch(module):
        try:
            found = getattr(importlib.import_module(module), name, None)
        except ModuleNotFoundError:
            found = None
        if isinstance(found, type) and issubclass(found, nn.Module) and found.__module__ == module:
            return found
    raise CheckpointError(
        f"{source} asks to run '{target}', which is no network of raytran: do not use this file"
    )
