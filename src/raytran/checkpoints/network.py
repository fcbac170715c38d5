# SPDX-License-Identifier: Apache-2.0
"""Networks from the description inside a checkpoint, which may come from anybody.

A checkpoint names the parts of its network by the names of ``PARTS``, not by where their classes stand: the
folders of this package are no file format.
"""

from __future__ import annotations

import functools
import importlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from torch import nn
from torch.nn.modules.module import (
    register_module_module_registration_hook,
    register_module_parameter_registration_hook,
)

from raytran.errors import CheckpointError, ConfigError
from raytran.limits import shown
from raytran.setting_limits import check_settings

PARTS: dict[str, str] = {
    "RayTran": "raytran.model",
    "Backbone": "raytran.backbone.backbone",
    "Stream": "raytran.backbone.block",
    "ResNet18": "raytran.backbone.resnet",
    "OccupancyHead": "raytran.heads.auxiliary",
    "ForegroundHead": "raytran.heads.auxiliary",
    "ObjectHead": "raytran.heads.objects",
    "CenterRefinement": "raytran.heads.objects",
    "VoxelAttention": "raytran.heads.decoder",
    "ShapeHead": "raytran.heads.shape",
    "ViewHead": "raytran.heads.view",
    "BoxVoxelShapeHead": "raytran.extensions.box_voxels",
    "BoxRefinement": "raytran.extensions.box_refinement",
    "DenoisingObjectHead": "raytran.extensions.denoising",
    "EfficientNetLite0": "raytran.extensions.efficientnet",
    "ProposalQueries": "raytran.extensions.proposal_queries",
    "VoxelEncoderDecoder": "raytran.extensions.unet3d",
    "UnprojectionBackbone": "raytran.extensions.unprojection",
    "WindowedAttention": "raytran.extensions.windowed_attention",
}
"""Every class that a network of ours is built of, and the module it is in. A new part gets a line here."""

_PACKAGE = "raytran"

_NOT_THE_NETWORK = ("attention",)
"""Settings of ours that are not the network's: how it was computed there."""

_MAX_NODES, _MAX_DEPTH, _MAX_TEXT = 10_000, 40, 1000
"""Values, levels and characters of one text in a description of a network; the presets have some hundred."""

_MAX_NUMBER = 1e6
"""Largest number in one: of channels, blocks, voxels along a side."""

_MODULES_A_TENSOR = 20
"""Most modules for each weight: there are containers, and functions without weights."""

_NOT_BUILT = (
    *(ConfigError, TypeError, ValueError, RuntimeError, AttributeError, KeyError, IndexError, MemoryError),
    *(OverflowError, RecursionError, AssertionError),
)
"""What our classes, and PyTorch's, say of settings that do not go together."""

_PLAIN = (str, int, float, bool, type(None))


def trusted_packages(trust: Any) -> tuple[str, ...]:
    """Return the packages of the user's own whose classes a checkpoint may name, checked.

    Args:
        trust: a list of their names as the user gives it, never one out of a file; None for no package.

    Raises:
        ConfigError: it is no list, or holds something else than the name of a top-level package.
    """
    names = () if trust is None else trust
    is_list = isinstance(names, Iterable) and not isinstance(names, str | Mapping)
    if not is_list or any(not isinstance(name, str) or not name.isidentifier() for name in names):
        raise ConfigError(f"trust={trust} is no list of top-level packages: write it as trust=[mylab]")
    return tuple(names)


def own_packages(config: Any) -> tuple[str, ...]:
    """Return the top-level packages other than raytran whose classes ``config`` names, sorted."""
    targets = [str(target) for target in _targets(config)]
    packages = {target.partition(".")[0] for target in targets if target not in PARTS}
    return tuple(sorted(packages - {_PACKAGE}))


def _targets(node: Any) -> Iterator[Any]:
    if isinstance(node, Mapping):
        if "_target_" in node:
            yield node["_target_"]
        node = node.values()
    elif not isinstance(node, list | tuple):
        return
    for value in node:
        yield from _targets(value)


def with_registered_names(config: Any) -> Any:
    """Return the config of a network with the names of ``PARTS`` in place of import paths.

    Raises:
        ConfigError: a class of raytran has no name there.
    """

    def named(target: str) -> str:
        module, _, name = target.rpartition(".")
        if PARTS.get(name) == module or target in PARTS:
            return name or target
        if module.partition(".")[0] == _PACKAGE:
            raise ConfigError(
                f"{target} is not registered, so that no checkpoint of it could be read: give it a line in "
                "PARTS of raytran/checkpoints/network.py"
            )
        return target

    return _with_targets(config, named)


def with_import_paths(config: Any) -> Any:
    """Return the config of a network with import paths in place of the names of ``PARTS``."""
    return _with_targets(config, lambda name: f"{PARTS[name]}.{name}" if name in PARTS else name)


def _with_targets(node: Any, change: Callable[[str], str]) -> Any:
    if isinstance(node, Mapping):
        return {
            name: change(value) if name == "_target_" else _with_targets(value, change)
            for name, value in node.items()
        }
    return [_with_targets(value, change) for value in node] if isinstance(node, list | tuple) else node


def build_network(
    config: Mapping[str, Any], source: object, *, trust: Iterable[str] = (), max_tensors: int | None = None
) -> nn.Module:
    """Return the network that ``config`` describes, without any weights of its own.

    A node with ``_target_`` stands for a class of ``PARTS``, or of a package in ``trust``, the other keys for
    its arguments; with ``_partial_`` for a function that makes one. There is nothing else: no functions of a
    module, no classes that a module has only imported from elsewhere, no references to resolve.

    Args:
        config: the config from a checkpoint.
        source: what to name in messages: the file.
        trust: see ``trusted_packages``.
        max_tensors: number of the weights that are there: a network with more is not built to its end. A few
            bytes can describe one of a billion blocks.

    Raises:
        CheckpointError: the config asks for anything else; that is then neither imported nor run. Or the
            classes do not take these arguments, or a package in ``trust`` is not installed; or there are
            fewer weights than the network has.
        ConfigError: see ``trusted_packages``.
    """
    trusted = trusted_packages(trust)
    _check_extent(config, source)
    try:
        check_settings(config, where="model")
        with _at_most(max_tensors, source):
            built = _build(config, source, trusted)
    except _NOT_BUILT as error:
        whose = " or ".join(("raytran", *(name for name in own_packages(config) if name in trusted)))
        raise CheckpointError(
            f"the network described in {source} cannot be built ({_first_line(error)}): "
            f"the file is of another version of {whose}, or damaged"
        ) from error
    if not isinstance(built, nn.Module):
        raise CheckpointError(f"{source} describes no network: do not use this file")
    return built


def _first_line(error: BaseException) -> str:
    """Return the beginning of a reason, which may hold text of the file."""
    line = str(error).partition("\n")[0][:120]
    return line if line.isprintable() else repr(line)


def _check_extent(config: Any, source: object) -> None:
    """Raise if a description is larger than any network's: nothing is built of it then."""
    left = _MAX_NODES
    level = [config]
    for _ in range(_MAX_DEPTH):
        left -= len(level)
        if left < 0:
            raise _odd(source)
        if any(isinstance(node, int | float) and not abs(node) <= _MAX_NUMBER for node in level):
            raise _odd(source)
        if any(isinstance(node, str) and len(node) > _MAX_TEXT for node in level):
            raise _odd(source)
        containers = [node for node in level if isinstance(node, Mapping | list | tuple)]
        if sum(map(len, containers)) > left:
            raise _odd(source)
        level = [
            part for node in containers for part in (node.values() if isinstance(node, Mapping) else node)
        ]
        if not level:
            return
    raise _odd(source)


@contextmanager
def _at_most(max_tensors: int | None, source: object) -> Iterator[None]:
    """Stop the making of modules in the block once they have more weights than there are."""
    if max_tensors is None:
        yield
        return
    left = {"weights": max_tensors, "modules": _MODULES_A_TENSOR * (max_tensors + 1)}

    def count(kind: str, value: object) -> None:
        left[kind] -= value is not None
        if left[kind] < 0:
            raise CheckpointError(
                f"the network described in {source} has more parts than the file has weights for: the file "
                "is of another program, or damaged"
            )

    hooks = [
        register_module_parameter_registration_hook(lambda _, __, value: count("weights", value)),
        register_module_module_registration_hook(lambda _, __, value: count("modules", value)),
    ]
    try:
        yield
    finally:
        for hook in hooks:
            hook.remove()


def _build(node: Any, source: object, trusted: tuple[str, ...]) -> Any:
    if isinstance(node, list | tuple):
        return [_build(value, source, trusted) for value in node]
    if not isinstance(node, Mapping):
        if not isinstance(node, _PLAIN):
            raise _odd(source)
        return node
    settings = {name: value for name, value in node.items() if name not in ("_target_", "_partial_")}
    values = {name: _build(value, source, trusted) for name, value in settings.items()}
    if any(not isinstance(name, str) or name.startswith("_") for name in values):
        raise _odd(source)
    if "_target_" not in node:
        return values
    network = _class(node["_target_"], source, trusted)
    if "weights" in values:
        values["weights"] = None  # they are in the checkpoint: nothing is to be read or fetched
    if network.__module__.partition(".")[0] == _PACKAGE:
        for name in _NOT_THE_NETWORK:
            values.pop(name, None)
    return functools.partial(network, **values) if node.get("_partial_") is True else network(**values)


def _class(target: Any, source: object, trusted: tuple[str, ...]) -> type[nn.Module]:
    """Return the class of that name, if it is a part of raytran's networks or of a trusted package's."""
    # The name is looked at before anything is imported: an import runs code as well.
    if isinstance(target, str) and target in PARTS:
        return getattr(importlib.import_module(PARTS[target]), target)
    module, _, name = str(target).rpartition(".")
    package = module.partition(".")[0]
    if package in trusted:
        # A class may be named where its package shows it, but it must be of a trusted package itself.
        found = _attribute(module, name)
        if _is_network(found) and found.__module__.partition(".")[0] in trusted:
            return found
        raise CheckpointError(
            f"{source} asks for {shown(target)}, and there is no torch.nn.Module of that name in {package}: "
            f"set PYTHONPATH so that Python finds the {package} it was trained with"
        )
    advice = f", or if you know it and {package} is a package of yours, give trust=[{package}]"
    raise CheckpointError(
        f"{source} asks to run {shown(target)}, which is no network of raytran: do not use this file"
        + (advice if package.isidentifier() and package != _PACKAGE else "")
    )


def _odd(source: object) -> CheckpointError:
    return CheckpointError(f"the network described in {source} has odd settings: do not use this file")


def _attribute(module: str, name: str) -> Any:
    """Return what a module has under ``name``; None if there is no such module, or no such name in it."""
    try:
        return getattr(importlib.import_module(module), name, None)
    except ModuleNotFoundError as error:
        if error.name is None or not f"{module}.".startswith(f"{error.name}."):
            raise  # it is there, and lacks something itself
        return None


def _is_network(found: Any) -> bool:
    return isinstance(found, type) and issubclass(found, nn.Module)


def without_sources(node: Any) -> Any:
    """Return a network's config without where first weights come from: a checkpoint's take their place."""
    if isinstance(node, Mapping):
        is_object = "_target_" in node
        return {
            name: None if is_object and name == "weights" else without_sources(value)
            for name, value in node.items()
        }
    return [without_sources(value) for value in node] if isinstance(node, list | tuple) else node
