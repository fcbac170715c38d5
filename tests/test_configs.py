# SPDX-License-Identifier: Apache-2.0
"""Configs say what the code does: keys are arguments, arguments are keys, the paper is the default."""

from __future__ import annotations

import ast
import importlib
import inspect
import re
from datetime import timedelta

import pytest
import yaml
from hydra.utils import instantiate
from omegaconf import OmegaConf

from raytran.classes import Classes
from raytran.errors import ConfigError
from raytran.postprocess import DUPLICATE_IOU, SCORE_THRESHOLD
from raytran.rooms.generate import generate_rooms
from raytran.run.entry import compose
from raytran.run.train.build import build_model, plain
from raytran.run.train.settings import RunConfig

EXPERIMENTS = ("stage1", "stage2", "stage3")
PRESETS = ("raytran", "small", "laptop", "tiny")
TRAINERS = ("auto", "cpu", "gpu", "ddp", "ddp_cpu")
# Given by the code that instantiates the node, not by the config.
GIVEN_BY_CODE = {
    "raytran.model.RayTran": {"score_scaling"},  # found after training, by export_model calibration=
    "raytran.extensions.proposal_queries.ProposalQueries": {"channels", "num_queries"},
    "raytran.extensions.windowed_attention.WindowedAttention": {"channels", "num_heads"},
    "raytran.extensions.unet3d.VoxelEncoderDecoder": {"channels"},
    "raytran.data.dataset.scan2cad_dataset": {
        *("root", "split", "num_views", "view_choice", "targets", "augmentation"),
    },
    "raytran.rooms.ensure.ensure_rooms": {"output"},
    "raytran.rooms.ensure.ensure_rooms_v1": {"output"},
    "raytran.rooms.ensure.ensure_rooms_v2": {"output"},
}
WITHOUT_ARGUMENTS = {
    "raytran.extensions.proposal_queries.ProposalLoss",
    "raytran.extensions.denoising.DenoisingLoss",
    "raytran.extensions.box_refinement.BoxRefinement",
    "raytran.extensions.box_voxels.BoxVoxelShapeHead",
}
# Part of the layout that scan2cad_dataset stands for.
FIXED_BY_LAYOUT = {"scans_root", "scene_ids", "annotations", "shapenet_root"}
NO_CHOICE_OF_THE_PAPER = {
    "weights",  # a class must not reach for the network unasked; the preset does
    "num_workers",  # the machine's
    "name",  # of the data set that is chosen
    "extensions",  # losses of parts that the paper's network does not have: nothing there
    "augmentation",  # a node that says what could be done, all of it off
}
# Only a choice of a large signature is written out.
PARTIAL = {
    "lightning.pytorch.Trainer",
    "lightning.pytorch.loggers.CSVLogger",
}


def train_config(*overrides):
    return compose("train", [*overrides, "output_dir=unused"])


def nodes_with_target(node):
    if isinstance(node, dict):
        if "_target_" in node:
            yield node
        for value in node.values():
            yield from nodes_with_target(value)


def locate(path):
    module, name = path.rsplit(".", 1)
    return getattr(importlib.import_module(module), name)


def arguments(path):
    """Return argument name → parameter, also of what a function passes its arguments on to."""
    parameters = dict(inspect.signature(locate(path)).parameters)
    if path in WITHOUT_ARGUMENTS:  # the signature is that of torch.nn.Module
        return {}
    if path == "raytran.data.dataset.scan2cad_dataset":
        passed_on = dict(inspect.signature(locate("raytran.data.dataset.SceneDataset")).parameters)
        parameters |= {name: value for name, value in passed_on.items() if name not in FIXED_BY_LAYOUT}
        del parameters["options"]
    if path == "raytran.rooms.ensure.ensure_rooms":
        del parameters["settings"]
        parameters |= inspect.signature(generate_rooms).parameters
    return parameters


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize(
    "chosen",
    [
        ("data=rooms",),
        ("data=rooms-v1",),
        ("data=rooms-v2",),
        ("data=scan2cad", "data.root=somewhere"),
        ("model/backbone=unprojection",),
    ],
)
def test_keys_are_arguments(preset, chosen):
    config = plain(train_config(f"preset={preset}", *chosen))
    nodes = list(nodes_with_target(config))
    assert len(nodes) > 10
    for node in nodes:
        target = node["_target_"]
        keys = {key for key in node if key not in ("_target_", "_partial_")}
        known = set(arguments(target))
        assert keys <= known, f"{target} has no argument {sorted(keys - known)}"
        if target not in PARTIAL:
            missing = known - keys - GIVEN_BY_CODE.get(target, set())
            assert not missing, f"{target}: the config does not name {sorted(missing)}"


@pytest.mark.parametrize("trainer", TRAINERS)
def test_trainer_keys_are_arguments(trainer):
    config = plain(train_config(f"trainer={trainer}").trainer)
    assert set(config) - {"_target_"} <= set(arguments("lightning.pytorch.Trainer"))


@pytest.mark.parametrize("trainer", ["ddp", "ddp_cpu"])
def test_strategies_are_built(trainer):
    strategy = instantiate(plain(train_config(f"trainer={trainer}").trainer.strategy))
    # Other ranks wait while the first makes rooms; torch's default of half an hour would end that.
    assert strategy._timeout == timedelta(minutes=30)


def test_the_papers_preset_is_the_default_of_the_code():
    config = plain(train_config("preset=raytran", "data=scan2cad", "data.root=somewhere"))
    for group in ("model", "optimizer", "loss", "data"):
        for node in nodes_with_target(config[group]):
            for name, parameter in arguments(node["_target_"]).items():
                given = name not in GIVEN_BY_CODE.get(node["_target_"], set())
                if (
                    given
                    and parameter.default is not inspect.Parameter.empty
                    and name not in NO_CHOICE_OF_THE_PAPER
                ):
                    wanted = (
                        list(parameter.default) if isinstance(parameter.default, tuple) else parameter.default
                    )
                    if isinstance(wanted, Classes) or name == "classes":
                        given_names = node[name]["names"] if isinstance(node[name], dict) else node[name]
                        wanted_names = wanted if isinstance(wanted, list) else Classes.of(wanted).names
                        assert list(wanted_names) == list(given_names), f"{node['_target_']}.{name}"
                        continue
                    assert node[name] == wanted, f"{node['_target_']}.{name}"


@pytest.mark.parametrize("command", ["evaluate", "predict", "demo"])
def test_commands_count_the_objects_that_the_code_counts(command):
    typed = {"evaluate": [], "predict": ["scene=a", "output=b"], "demo": []}[command]
    cfg = compose(command, typed)
    assert (cfg.score_threshold, cfg.duplicate_iou) == (SCORE_THRESHOLD, DUPLICATE_IOU)


def test_the_papers_numbers():
    config = train_config("preset=raytran", "trainer=ddp", "precision=16-mixed", "experiment=stage2")
    assert [config.schedule[stage].steps for stage in ("stage1", "stage2", "stage3")] == [
        224000,
        239000,
        5000,
    ]
    assert config.optimizer.learning_rate == 1e-4
    assert config.optimizer.weight_decay == 5e-2
    assert config.trainer.gradient_clip_val == 0.1
    assert config.trainer.precision == "16-mixed"
    assert config.trainer.devices * config.data.batch_size == config.schedule.batch == 8
    assert list(config.views.image_size) == [480, 640]
    assert (config.views.num_views, config.views.predict_views) == (20, 96)
    assert list(config.model.grid_resolution) == [48, 48, 16]
    assert config.model.heads.objects.num_queries == 64


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("experiment", EXPERIMENTS)
def test_every_experiment_resolves_with_every_preset(preset, experiment):
    config = train_config(f"preset={preset}", f"experiment={experiment}")
    OmegaConf.resolve(config)
    assert (config.preset, config.experiment) == (preset, experiment)
    assert config.trainer.max_steps == config.schedule[config.stage.name].steps
    assert all(side % config.model.backbone.encoder.stride == 0 for side in config.views.image_size)


@pytest.mark.parametrize("preset", ["small", "tiny"])
def test_small_networks_are_built(preset):
    model = build_model(train_config(f"preset={preset}"))
    assert set(model.heads) == {"occupancy", "foreground", "objects", "shape"}


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("chosen", ["variant=unprojection", "model/backbone=unprojection"])
def test_the_baseline_has_the_presets_sizes(preset, chosen):
    baseline, network = (plain(train_config(f"preset={preset}", *more))["model"] for more in ([chosen], []))
    kinds = [model["backbone"].pop("_target_") for model in (baseline, network)]
    assert kinds == [
        "raytran.extensions.unprojection.UnprojectionBackbone",
        "raytran.backbone.backbone.Backbone",
    ]
    assert baseline["backbone"].pop("num_levels") == 3
    assert baseline["backbone"].pop("norm_momentum") == (0.01 if preset == "laptop" else 0.1)
    for of_attention in ("num_heads", "expansion", "bidirectional", "voxel_network", "checkpoint_blocks"):
        del network["backbone"][of_attention]
    assert baseline == network


def test_the_baseline_takes_about_as_many_parameters():
    attention, baseline = (
        sum(parameter.numel() for parameter in build_model(train_config("preset=small", *more)).parameters())
        for more in ([], ["model/backbone=unprojection"])
    )
    assert 1.0 < baseline / attention < 1.2


def test_one_word_chooses_a_preset_and_typing_wins():
    config = train_config("preset=tiny", "model=small", "views.num_views=3")
    assert config.model.backbone.encoder.width == 32
    assert config.data.num_views == 3


@pytest.mark.parametrize("root", ["train", "curriculum", "evaluate", "prepare", "plan"])
def test_roots_resolve(root):
    extra = {"evaluate": ["checkpoint=x.ckpt"], "prepare": ["output=x"], "plan": []}.get(
        root, ["output_dir=x"]
    )
    OmegaConf.resolve(compose(root, ["preset=tiny", *extra]))


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("seed=many", "many"),
        ("checkpoint_every=0", "at least 1"),
        ("check_parent=false", "choose one of scores, stage, none"),
        ("progress_bar=fancy", "choose one of rich, tqdm, none"),
    ],
)
def test_switches_are_checked(override, message):
    with pytest.raises(ConfigError, match=message):
        RunConfig.read(train_config("preset=tiny", override))


def test_switches_are_read():
    run = RunConfig.read(train_config("preset=tiny", "experiment=stage3", "seed=5"))
    assert (run.preset, run.experiment, run.seed, run.init_from, run.resume) == (
        "tiny",
        "stage3",
        5,
        "auto",
        "none",
    )


def test_no_plain_setting_has_the_name_of_a_group(project_root):
    """Hydra takes ``name=value`` for a choice where ``conf/name`` is a folder, and refuses it otherwise."""
    conf = project_root / "conf"
    for path in conf.glob("*.yaml"):
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
        plain_keys = [key for key, value in content.items() if not isinstance(value, dict | list)]
        same = [key for key in plain_keys if (conf / key).is_dir()]
        assert not same, f"{path}: {same[0]}= cannot be typed"


def settings_of_all_commands(project_root):
    """Return all settings, dotted, of all commands with all that can be chosen, and the groups of choices."""
    chosen = {
        "predict": [[]],
        "prepare": [[]],
        "export_model": [[]],
        "view": [[]],
        "demo": [[]],
        "poses": [[]],
        "plan": [[]],
    }
    chosen |= {"evaluate": [[]], "curriculum": [[]]}
    chosen["train"] = [
        [
            "preset=tiny",
            "logger=many",
            "debug=profiler",
            "model/extensions=[unet3d,denoising,box_refinement,box_voxels]",
        ],
        ["preset=laptop", "data=scan2cad", "experiment=novel_view"],
    ]
    known = {str(path.relative_to(project_root / "conf")) for path in (project_root / "conf").rglob("*")}

    def dotted(node, prefix=""):
        for key, value in node.items():
            known.add(f"{prefix}{key}")
            if isinstance(value, dict):
                dotted(value, f"{prefix}{key}.")

    for command, several in chosen.items():
        for typed in several:
            dotted(OmegaConf.to_container(compose(command, typed)))
    return known


def texts_in(node: ast.AST) -> list[str]:
    """Return the texts in a piece of code, with ``{}`` for what is put into them."""
    if isinstance(node, ast.JoinedStr):
        return ["".join(part.value if isinstance(part, ast.Constant) else "{}" for part in node.values)]
    if isinstance(node, ast.Constant):
        return [node.value] if isinstance(node.value, str) else []
    return [text for child in ast.iter_child_nodes(node) for text in texts_in(child)]


def test_settings_that_messages_name_are_settings(project_root):
    """An advice that names a setting can be typed; only ``unknown KEY=VALUE`` may say the last part alone."""
    known = settings_of_all_commands(project_root)
    last_parts = {name.rpartition(".")[2] for name in known}
    found = 0
    for path in sorted((project_root / "src" / "raytran").rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if not isinstance(node, ast.Call):
                continue
            name = getattr(node.func, "id", getattr(node.func, "attr", ""))
            if not (name.endswith("Error") or name in ("info", "warning", "error")) or not node.args:
                continue
            text = " ".join(texts_in(node.args[0]))
            for before, key in re.findall(r"(unknown )?(?<![\w./}-])([a-z_][\w./]*)=(?!=)", text):
                found += 1
                is_known = key in known or (before and key in last_parts) or key == "key"
                assert is_known, f"{path}:{node.lineno}: there is no setting {key}"
    assert found > 120
