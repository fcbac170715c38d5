# SPDX-License-Identifier: Apache-2.0
"""Checkpoints of earlier versions, read as those of this one: format ``raytran.checkpoint/1``.

It named parts by import paths, chose extensions by strings, and called some weights otherwise. All that
has to be known of it stands here.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

from raytran.checkpoints.network import with_import_paths
from raytran.checkpoints.runs import STAGE_NAMES

_FORMER_PATHS = {
    "raytran.model.RayTran": "RayTran",
    "raytran.backbone.backbone.Backbone": "Backbone",
    "raytran.backbone.block.Stream": "Stream",
    "raytran.backbone.resnet.ResNet18": "ResNet18",
    "raytran.backbone.efficientnet.EfficientNetLite0": "EfficientNetLite0",
    "raytran.backbone.unprojection.UnprojectionBackbone": "UnprojectionBackbone",
    "raytran.heads.occupancy.OccupancyHead": "OccupancyHead",
    "raytran.heads.foreground.ForegroundHead": "ForegroundHead",
    "raytran.heads.objects.ObjectHead": "ObjectHead",
    "raytran.heads.shape.ShapeHead": "ShapeHead",
    "raytran.heads.view.ViewHead": "ViewHead",
}

_FORMER_WEIGHTS = (
    (r"^model\.backbone\.resnet\.", "model.backbone.image_features.encoder."),
    (r"^model\.backbone\.projection\.", "model.backbone.image_features.projection."),
    (r"^model\.backbone\.volume\.", "model.backbone.voxel_network."),
    (r"^(model\.backbone\.voxel_network\.up\.\d+)\.grow\.", r"\1.convolution."),
    (r"^(model\.heads\.(?:foreground|shape|view))\.grow\.", r"\1.upsampler."),
    (r"^model\.heads\.objects\.copies\.", "model.heads.objects.denoising_queries."),
)


def upgraded(content: Mapping[str, Any]) -> dict[str, Any]:
    """Return the content of a checkpoint of format 1 as this version writes it, but for its ``format``."""
    new = _with_stage_names(content)
    new["model"] = upgraded_network(content["model"])
    new["state_dict"] = {_weight_name(name): value for name, value in content["state_dict"].items()}
    config = new.get("config")
    if isinstance(config, Mapping) and isinstance(config.get("model"), Mapping):
        new["config"] = {**config, "model": with_import_paths(upgraded_network(config["model"]))}
    return new


def _with_stage_names(content: Mapping[str, Any]) -> dict[str, Any]:
    """Return ``content`` with its stages under the names they have now."""
    renamed = dict(content)
    renamed["stage"] = _stage_name(content["stage"])
    for name, keys in (("parent", ["stage"]), ("config", ["stage", "schedule"])):
        if isinstance(part := content.get(name), Mapping):
            renamed[name] = {key: _stage_name(value) if key in keys else value for key, value in part.items()}
    return renamed


def _stage_name(said: Any) -> Any:
    """Return what names stages with their present names: a name, a list of names, or settings by name."""
    if isinstance(said, str):
        return STAGE_NAMES.get(said, said)
    if isinstance(said, Mapping):
        return {
            STAGE_NAMES.get(key, key): _stage_name(value)
            if key in ("name", "parent", "other_parents")
            else value
            for key, value in said.items()
        }
    return [_stage_name(name) for name in said] if isinstance(said, list | tuple) else said


def _weight_name(name: str) -> str:
    for pattern, replacement in _FORMER_WEIGHTS:
        name = re.sub(pattern, replacement, name)
    return name


def upgraded_network(node: Any) -> Any:
    """Return the description of a network of format 1 in the names and arguments of this version."""
    if isinstance(node, list | tuple):
        return [upgraded_network(value) for value in node]
    if not isinstance(node, Mapping):
        return node
    new = {name: upgraded_network(value) for name, value in node.items()}
    if "_target_" not in new:
        return new
    if isinstance(new["_target_"], str):
        new["_target_"] = _FORMER_PATHS.get(new["_target_"], new["_target_"])
    if "resnet" in new:
        new["encoder"] = new.pop("resnet")
    new.pop("freeze_norms", None)  # how it was trained, not what it is
    if new["_target_"] == "Backbone":
        return _upgraded_backbone(new)
    if new["_target_"] == "ObjectHead":
        return _upgraded_object_head(new)
    return new


def _upgraded_backbone(node: dict[str, Any]) -> dict[str, Any]:
    num_levels = node.pop("start_levels", 0)
    momentum = node.pop("norm_momentum", 0.1)
    if num_levels:
        node["voxel_network"] = {
            "_target_": "VoxelEncoderDecoder",
            "_partial_": True,
            "num_blocks": 1,
            "num_levels": num_levels,
            "norm_momentum": momentum,
        }
    return node


def _upgraded_object_head(node: dict[str, Any]) -> dict[str, Any]:
    if node.pop("queries", "learned") == "proposal":
        node["queries"] = {"_target_": "ProposalQueries", "_partial_": True}
    if node.pop("windowed", False):
        node["voxel_attention"] = {"_target_": "WindowedAttention", "_partial_": True}
    if node.pop("refines", "center") == "box":
        node["refinement"] = {"_target_": "BoxRefinement"}
    if num_copies := node.pop("num_copies", 0):
        node["_target_"] = "DenoisingObjectHead"
        node["num_copies"] = num_copies
    return node
