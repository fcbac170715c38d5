# SPDX-License-Identifier: Apache-2.0
"""Checkpoints of format 1, as versions before this one wrote them."""

from __future__ import annotations

import pytest
import torch

import raytran
from raytran.checkpoints.earlier import upgraded, upgraded_network
from raytran.checkpoints.file import read_checkpoint, shipped_weights
from raytran.checkpoints.network import build_network

RESNET = {
    "_target_": "raytran.backbone.resnet.ResNet18",
    "width": 8,
    "stride": 16,
    "norm_momentum": 0.2,
    "input_channels": 3,
    "weights": None,
}
BACKBONE = {
    "_target_": "raytran.backbone.backbone.Backbone",
    "channels": 16,
    "num_heads": 2,
    "num_blocks": 1,
    "expansion": 2,
    "bidirectional": True,
    "start_levels": 0,
    "norm_momentum": 0.2,
    "checkpoint_blocks": False,
    "freeze_norms": False,
    "resnet": RESNET,
}
OBJECTS = {
    "_target_": "raytran.heads.objects.ObjectHead",
    "channels": 16,
    "num_heads": 2,
    "num_layers": 2,
    "num_queries": 5,
    "queries": "learned",
    "hidden": 16,
    "windowed": False,
    "num_copies": 0,
    "refines": "center",
    "grid_extent": [6.0, 6.0, 3.0],
}


def network_of(**parts):
    """Build what a network of format 1 with these parts is today."""
    node = {
        "_target_": "raytran.model.RayTran",
        "backbone": BACKBONE | parts.get("backbone", {}),
        "heads": {
            "occupancy": {"_target_": "raytran.heads.occupancy.OccupancyHead", "channels": 16},
            "objects": OBJECTS | parts.get("objects", {}),
        },
        "grid_resolution": [6, 6, 4],
        "grid_extent": [6.0, 6.0, 3.0],
        "rays_per_cell": 2,
        "attention": "auto",
    }
    return build_network(upgraded_network(node), "old.ckpt")


def kinds(network):
    return {type(module).__name__ for module in network.modules()}


@pytest.mark.parametrize(
    ("parts", "kind"),
    [
        ({}, "LearnedQueries"),
        ({}, "VoxelAttention"),
        ({}, "CenterRefinement"),
        ({"objects": {"queries": "proposal"}}, "ProposalQueries"),
        ({"objects": {"windowed": True}}, "WindowedAttention"),
        ({"objects": {"refines": "box"}}, "BoxRefinement"),
        ({"objects": {"num_copies": 4}}, "DenoisingObjectHead"),
        ({"backbone": {"start_levels": 2}}, "VoxelEncoderDecoder"),
    ],
)
def test_what_a_string_or_number_chose_is_a_part_now(parts, kind):
    assert kind in kinds(network_of(**parts))


def test_only_what_was_chosen_is_there():
    beyond = {"ProposalQueries", "WindowedAttention", "BoxRefinement", "VoxelEncoderDecoder", "NoisyCopies"}
    assert not beyond & kinds(network_of())


def test_settings_of_the_norms_reach_them():
    network = network_of(backbone={"start_levels": 2})
    assert network.backbone.encoder.bn1.momentum == 0.2
    assert network.backbone.voxel_network.down[0][0].bn1.momentum == 0.2


def test_the_baseline_without_attention():
    node = {
        "_target_": "raytran.backbone.unprojection.UnprojectionBackbone",
        "resnet": RESNET,
        "channels": 8,
        "num_blocks": 1,
        "num_levels": 2,
        "norm_momentum": 0.1,
    }
    assert {"UnprojectionBackbone", "ResNet18"} <= kinds(build_network(upgraded_network(node), "old.ckpt"))


def test_weights_get_their_names_of_today():
    names = {
        "model.backbone.resnet.conv1.weight": "model.backbone.image_features.encoder.conv1.weight",
        "model.backbone.projection.bias": "model.backbone.image_features.projection.bias",
        "model.backbone.volume.up.0.grow.weight": "model.backbone.voxel_network.up.0.convolution.weight",
        "model.backbone.volume.down.0.0.bn1.bias": "model.backbone.voxel_network.down.0.0.bn1.bias",
        "model.heads.foreground.grow.0.weight": "model.heads.foreground.upsampler.0.weight",
        "model.heads.shape.grow.1.bias": "model.heads.shape.upsampler.1.bias",
        "model.heads.view.grow.0.weight": "model.heads.view.upsampler.0.weight",
        "model.heads.objects.copies.embedding": "model.heads.objects.denoising_queries.embedding",
        "model.backbone.blocks.0.voxel_stream.key.weight": "model.backbone.blocks.0.voxel_stream.key.weight",
    }
    content = {"stage": "joint", "model": {}, "state_dict": {name: torch.zeros(1) for name in names}}
    assert list(upgraded(content)["state_dict"]) == list(names.values())
    assert upgraded(content)["stage"] == "stage2"


def test_the_shipped_weights_are_of_format_1_and_load():
    """They hold an encoder, a 3D encoder-decoder, proposals and windows: names and arguments of each kind."""
    content = read_checkpoint(shipped_weights())
    assert content["model"]["_target_"] == "RayTran"
    assert not any(".resnet." in name or ".grow." in name for name in content["state_dict"])
    assert {"EfficientNetLite0", "VoxelEncoderDecoder", "ProposalQueries", "WindowedAttention"} <= kinds(
        raytran.load("default")
    )
