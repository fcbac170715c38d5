# SPDX-License-Identifier: Apache-2.0
"""Every file in ``conf/`` is chosen as on the command line, and what it describes is built."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

import lightning.pytorch as pl
import pytest
from hydra import compose as hydra_compose
from hydra import initialize_config_dir
from hydra.utils import get_class, instantiate
from omegaconf import OmegaConf

from raytran.classes import Classes
from raytran.run.config_dir import config_dir
from raytran.run.entry import compose
from raytran.run.train.build import build_data, build_model, build_module, plain

CONF = config_dir()
FILES = sorted(path.relative_to(CONF).with_suffix("") for path in CONF.rglob("*.yaml"))
ROOTS = {
    "train": ["preset=tiny", "output_dir=x"],
    "curriculum": ["preset=tiny", "output_dir=x"],
    "evaluate": ["preset=tiny", "checkpoint=x.ckpt"],
    "predict": ["checkpoint=x.ckpt", "scene=x", "output=x"],
    "prepare": ["output=x"],
}
"""What a root needs besides its defaults, if anything."""


PARTS_OF_THE_MODEL = ("model/backbone", "model/encoder", "model/extensions")


def files(*folders):
    return [path for path in FILES if str(path.parent) in folders and path.parts[0] != "local"]


def name(path: Path) -> str:
    return str(path)


def chosen(path: Path, *more: str):
    """Compose the training config with the choice that ``path`` is, in a preset that it fits."""
    presets = [preset.name for preset in files("preset") if path.name.endswith(preset.name)]
    preset = presets[0] if presets else "tiny"
    return compose("train", [f"preset={preset}", f"{path.parent}={path.name}", "output_dir=x", *more])


def whole_config(*overrides: str):
    """Return a root config with Hydra's own part."""
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return hydra_compose("train", overrides=["output_dir=x", *overrides], return_hydra_config=True)


def build_everything(config) -> None:
    """Build what ``train`` builds, but for the Trainer."""
    model = build_model(config, pretrained=False)
    module = build_module(config, model)
    module.stage.freeze(model)
    assert any(parameter.requires_grad for parameter in model.parameters())
    build_data(config)


def test_no_folder_is_forgotten():
    folders = {str(path.parent) for path in FILES} - {"local"}
    assert folders == {
        *(
            ".",
            "classes",
            "data",
            "debug",
            "experiment",
            "logger",
            "loss",
            "model",
            "preset",
            "stage",
            "sweep",
        ),
        *("trainer", "variant", "hydra", "hydra/launcher", "hydra/sweeper", *PARTS_OF_THE_MODEL),
    }


@pytest.mark.parametrize("path", files("."), ids=name)
def test_roots(path):
    OmegaConf.resolve(compose(path.name, ROOTS.get(path.name, [])))


@pytest.mark.parametrize("path", files("model", *PARTS_OF_THE_MODEL, "loss", "stage"), ids=name)
def test_parts(path):
    build_everything(chosen(path))


@pytest.mark.parametrize("preset", files("preset"), ids=name)
def test_every_image_encoder_goes_with_every_preset(preset):
    for encoder in files("model/encoder"):
        config = compose("train", [f"preset={preset.name}", f"model/encoder={encoder.name}", "output_dir=x"])
        instantiate(plain(config)["model"]["backbone"]["encoder"] | {"weights": None})


@pytest.mark.parametrize("path", files("preset"), ids=name)
def test_presets(path):
    config = chosen(path)
    assert config.preset == path.name
    build_everything(config)


@pytest.mark.parametrize("path", files("data"), ids=name)
def test_data(path):
    build_data(chosen(path, "data.root=somewhere"))


@pytest.mark.parametrize("path", files("classes"), ids=name)
def test_classes(path):
    config = chosen(path)
    names = config.classes.names
    build_everything(config)
    model = build_model(config, pretrained=False)
    assert model.classes == Classes.of(plain(config.classes))
    assert model.class_layers()
    sizes = {shape for layer in model.class_layers() for shape in model.get_submodule(layer).weight.shape}
    assert {len(names), len(names) + 1} <= sizes


@pytest.mark.parametrize("path", files("experiment"), ids=name)
def test_experiments(path):
    config = chosen(path)
    assert config.experiment == path.name
    assert config.optimized_metric.startswith("val/")
    assert (
        config.stage.parent_experiment is None or Path("experiment", config.stage.parent_experiment) in FILES
    )
    build_everything(config)


@pytest.mark.parametrize("path", files("variant"), ids=name)
@pytest.mark.parametrize("experiment", files("experiment"), ids=name)
def test_a_variant_of_every_experiment_comes_after_the_same_variant_of_its_parent(path, experiment):
    plainly = compose("train", ["preset=tiny", f"experiment={experiment.name}", "output_dir=x"])
    config = chosen(path, f"experiment={experiment.name}")
    assert config.experiment == f"{path.name}_{plainly.experiment}"
    assert config.stage.parent == plainly.stage.parent
    if config.stage.parent is not None:
        assert config.stage.parent_experiment == f"{path.name}_{plainly.stage.parent_experiment}"
    if experiment.name == "stage1":
        build_everything(config)


def test_the_papers_ablations_are_what_they_say():
    config = compose("train", ["preset=raytran", "experiment=no_masks_stage2", "output_dir=x"])
    model = build_model(config, pretrained=False)
    module = build_module(config, model)
    module.stage.freeze(model)
    assert not any(parameter.requires_grad for parameter in model.heads["foreground"].parameters())
    assert "foreground" not in {*module.stage.tasks, *module.stage.terms, *config.data.targets}
    config = compose("train", ["preset=raytran", "variant=gt_masks", "experiment=stage3", "output_dir=x"])
    assert build_model(config, pretrained=False).backbone.encoder.input_channels == 4
    assert config.data.dataset.input_mask == "amodal"


@pytest.mark.parametrize("path", files("trainer"), ids=name)
def test_trainers(path, tmp_path):
    settings = plain(chosen(path).trainer)
    settings |= {"accelerator": "cpu", "precision": "32-true", "default_root_dir": str(tmp_path)}
    trainer = instantiate(settings, logger=False, _convert_="all")
    assert isinstance(trainer, pl.Trainer)
    wanted = settings["devices"] if isinstance(settings["devices"], int) else 1
    assert trainer.num_devices == wanted


@pytest.mark.parametrize("path", files("logger"), ids=name)
def test_loggers(path, tmp_path):
    config = chosen(path)
    if path.name == "mlflow":
        pytest.importorskip("mlflow", reason="MLflow is an extra of its own")
    for number, node in enumerate(plain(config.logger).values()):
        known = {"path", "save_dir"} & set(node)
        built = instantiate(node | {key: str(tmp_path / str(number)) for key in known})
        assert hasattr(built, "log_metrics")


@pytest.mark.parametrize("path", files("debug"), ids=name)
def test_overlays_for_debugging_keep_to_themselves(path, tmp_path):
    config = chosen(path)
    # A run of one step must not become the parent that init_from=auto finds.
    assert (config.outputs, config.init_from) == ("outputs/debug", "none")
    build_everything(config)
    instantiate(plain(config.trainer) | {"accelerator": "cpu", "precision": "32-true"}, logger=False)


@pytest.mark.parametrize("path", files("sweep"), ids=name)
def test_sweeps_vary_settings_that_exist(path):
    config = whole_config("preset=tiny", f"sweep={path.name}")
    assert config.hydra.mode.name == "MULTIRUN"
    assert config.hydra.launcher._target_ == "hydra_plugins.raytran_launcher.ProcessLauncher"
    params = config.hydra.sweeper.params
    assert params
    for key in params:
        assert OmegaConf.select(config, key) is not None, key


@pytest.mark.parametrize("path", files("hydra/launcher", "hydra/sweeper"), ids=name)
def test_launchers_and_sweepers(path):
    config = whole_config("preset=tiny", f"{path.parent}={path.name}")
    node = config.hydra[path.parent.name]
    package = node._target_.rsplit(".", 2)[0]
    if not package.startswith("hydra_plugins.raytran") and find_spec(package) is None:
        pytest.skip(f"{package} is not installed")
    assert get_class(node._target_)
