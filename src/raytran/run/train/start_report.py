# SPDX-License-Identifier: Apache-2.0
"""What a fit logs at its start: what trains, what is frozen, which loss terms count, where it starts from."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from typing import Any

from raytran.checkpoints.metadata import DataIdentity
from raytran.checkpoints.network import own_packages
from raytran.classes import PAPER_CLASSES
from raytran.model import RayTran
from raytran.training.stage import Stage

_NOT_COMPUTED = {
    *("output_dir", "outputs", "resume", "init_from", "check_parent", "progress_bar", "logger", "launcher"),
    *("stages", "debug", "sweep", "watch", "optimized_metric", "trust", "variant_prefix", "metrics"),
}
"""Top-level settings that say where and how a run goes on, not what it computes."""

_WHETHER_MADE = ("rooms.make", "data.make.allowed", "data.make.usual")
"""Settings that say whether rooms may be made, not which."""

_BEFORE_THEY_WERE_KEYS = {
    "loss.shape_layers": "last",
    "loss.center_beta": 0.1,
    "loss.yaw_beta": 0.1,
    "loss.matcher.class_cost": "probability",
    "loss.matcher.center_beta": 0.1,
    "loss.matcher.yaw_beta": 0.1,
    "data.dataset.object_choice": "all",
    **{
        f"{where}.{name}": value
        for where in ("classes", "model.classes", "data.dataset.classes")
        for name, value in (("names", list(PAPER_CLASSES.names)), ("colors", None), ("catids", None))
    },
    "model.heads.objects.classes": list(PAPER_CLASSES.names),
    "model.heads.objects.queries.classes": list(PAPER_CLASSES.names),
}
"""What runs did whose checkpoints do not have these settings yet."""

_WAS_CALLED = {"data.dataset.input_mask": {True: "amodal", False: None}}
"""Values that had other names in earlier checkpoints."""


def start_report(
    stage: Stage, model: RayTran, metadata: Mapping[str, Any], *, trust: Collection[str] = ()
) -> list[str]:
    """Return the lines to log at the start of a fit.

    Args:
        stage: the stage; it is applied to ``model``, as the fit will do.
        model: the network.
        metadata: what the checkpoints will say of themselves, see ``checkpoint_metadata``.
        trust: packages that the user has already named as trusted.
    """
    stage.freeze(model)
    trained: dict[str, int] = {}
    frozen: dict[str, int] = {}
    for name, parameter in model.named_parameters():
        counts = trained if parameter.requires_grad else frozen
        part = _part(name)
        counts[part] = counts.get(part, 0) + parameter.numel()
    lines = [
        f"trains {_listed(trained)}",
        f"frozen {_listed(frozen)}",
        f"loss terms {', '.join(stage.terms)}; heads that run {', '.join(stage.tasks)}",
    ]
    parent = metadata["parent"]
    if parent is not None:
        scores = parent["scores"]
        told = [
            f"{name} {value:.3g}" for name, value in scores.items() if name == f"val/{stage.parent_score}"
        ]
        at = f"{parent['stage']}, step {parent['step']}"
        lines.append(f"starts from {', '.join([at, *told])}: {parent['path']}")
        known, data = DataIdentity.of_plain(parent.get("data")), DataIdentity.of_plain(metadata["data"])
        if known is not None and data is not None and not known.is_same(data):
            lines.append(f"its parent was trained on other data, {known}; this run on {data}")
    lines += [f"WARNING: {warning}" for warning in metadata["warnings"]]
    own = own_packages(metadata["model"])
    if not set(own) <= set(trust):
        lines.append(
            f"this network has classes of {', '.join(own)}: to use its checkpoints, evaluate, predict "
            f"and export_model need trust=[{','.join(own)}]"
        )
    return lines


def changed_settings(before: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    """Return ``name: before → now`` for each setting that changes what a resumed run computes.

    Args:
        before: all settings of the run as its checkpoint has them.
        now: those it is continued with.
    """
    old, new = (
        dict(_leaves({name: value for name, value in settings.items() if name not in _NOT_COMPUTED}))
        for settings in (before, now)
    )
    old = {name: value for name, value in _BEFORE_THEY_WERE_KEYS.items() if name in new} | old
    for setting, renamed in _WAS_CALLED.items():
        if isinstance(old.get(setting), bool):
            old[setting] = renamed[bool(old[setting])]
    if "data.name" not in old:
        new.pop("data.name", None)
    old, new = (
        {name: value for name, value in settings.items() if name not in _WHETHER_MADE}
        for settings in (old, new)
    )
    names = [name for name in {**old, **new} if old.get(name) != new.get(name)]
    return [f"{name}: {old.get(name, 'unset')} → {new.get(name, 'unset')}" for name in names]


def _leaves(node: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the dotted name and the value of every setting."""
    if isinstance(node, Mapping):
        for name, value in node.items():
            yield from _leaves(value, f"{path}.{name}" if path else str(name))
    else:
        yield path, node


def _part(name: str) -> str:
    """Return ``backbone`` or ``heads.<name>`` for the name of a parameter."""
    words = name.split(".")
    return ".".join(words[:2]) if words[0] == "heads" else words[0]


def _listed(counts: Mapping[str, int]) -> str:
    """Return ``1,234 parameters: a 1,000, b 234``."""
    if not counts:
        return "nothing"
    parts = ", ".join(f"{name} {count:,}" for name, count in counts.items())
    return f"{sum(counts.values()):,} parameters: {parts}"
