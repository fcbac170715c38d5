# SPDX-License-Identifier: Apache-2.0
"""The whole path on a few generated rooms: make, train, measure, predict, show."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from omegaconf import DictConfig
from rich.console import Console
from rich.table import Table

from raytran.checkpoints.file import shipped_weights
from raytran.checkpoints.load import load_model, prediction_settings
from raytran.checkpoints.network import own_packages
from raytran.data.files import SettingsRecord, write_json
from raytran.data.locks import exclusive_lock
from raytran.data.text import read_json_object
from raytran.errors import ConfigError, DataError
from raytran.limits import SECONDS, as_number
from raytran.model import RayTran
from raytran.run.demo.page import COLUMNS, ShownScene, headline, write_page
from raytran.run.entry import compose
from raytran.run.evaluate.evaluate import TASKS_WITH_SHAPE, about_data, evaluate_model
from raytran.run.evaluate.results import write_evaluation
from raytran.run.path_settings import quoted
from raytran.run.predict.predict import predict_scene
from raytran.run.predict.room import RoomViews
from raytran.run.predict.write_scene import write_scene
from raytran.run.train.build import build_data, plain
from raytran.run.train.curriculum import run_curriculum
from raytran.run.train.fit import FitResult
from raytran.training.datamodule import SceneDataModule

_log = logging.getLogger(__name__)

_RECORD = "demo.json"
_LOCK = ".demo.lock"
_RECORDED = ("preset", "seed", "model", "loss", "optimizer", "views", "rooms", "schedule")
"""Settings that a demo must share with the one it continues."""

_SETTINGS = (
    "experiment=stage2",
    "data.val_views=${views.predict_views}",
    "stage.targets=[occupancy,foreground,objects,shapes]",
)
"""All targets that are measured, and the views that a prediction takes."""

_OWN = ("output", "preset", "validate_every", "learned", "score_threshold", "duplicate_iou")
"""Settings that a demo reads itself; the others are those of a training."""

_DECIDED = ("experiment", "stage", "init_from", "resume", "output_dir", "outputs", "data.root", "rooms.make")
"""Settings of a training that a demo decides."""


@dataclass(frozen=True)
class Evaluated:
    """A network, and the rooms it is evaluated on.

    Attributes:
        model: the network.
        checkpoint: its file.
        data: rooms, with the images and the grid that the network wants.
        split: which of them.
        num_views: frames of each.
    """

    model: RayTran
    checkpoint: Path
    data: SceneDataModule
    split: str
    num_views: int


@dataclass(frozen=True)
class DemoResult:
    """What a demo leaves.

    Attributes:
        page: the HTML file.
        metrics: content of ``metrics.json`` of each of ``COLUMNS`` (``shipped`` only if raytran has weights).
        seconds: time of each step.
    """

    page: Path
    metrics: Mapping[str, Mapping[str, Any]]
    seconds: Mapping[str, float]


def demo(cfg: DictConfig, typed: Sequence[str]) -> DemoResult:
    """Run ``raytran demo``; see ``conf/demo.yaml``.

    Rooms and stages that an earlier run in the same folder finished are kept, an interrupted stage goes on;
    what follows from them takes seconds and is made anew.

    Args:
        cfg: settings of the command.
        typed: those that were typed, as they were: those of a training hold for every stage.

    Raises:
        ConfigError: the folder holds a demo with other settings, or one is typed that a demo decides.
    """
    output = Path(cfg.output).resolve()
    settings = _of_training(typed)

    def taken(who: str) -> ConfigError:
        return ConfigError(f"another process makes the demo in {output} ({who}): wait, or give output=")

    with exclusive_lock(output / _LOCK, if_taken=taken):
        return _demo(cfg, settings, output)


def _of_training(typed: Sequence[str]) -> list[str]:
    """Return those of the settings typed that are a training's, but for its preset.

    Raises:
        ConfigError: one is typed that a demo decides.
    """
    found = []
    for word in typed:
        key = word.partition("=")[0].lstrip("+~")
        if key in _DECIDED:
            raise ConfigError(f"the demo decides {key}= itself: leave it out, or use raytran curriculum")
        if key.partition(".")[0] not in _OWN:
            found.append(word)
    return found


def _demo(cfg: DictConfig, settings: Sequence[str], output: Path) -> DemoResult:
    """Make the demo in a folder that nobody else writes."""
    rooms = [f"data.root={quoted(output / 'rooms')}", "rooms.make=true"]
    overrides = [f"preset={cfg.preset}", *rooms, *settings]
    data = _data(cfg, overrides, output)
    times = StepTimes(output / "times.json")
    with times.measure("rooms", continues=True):
        data.prepare_data()
    fits = _train(cfg, overrides, output / "training", times)
    asked = _asked(overrides, data, fits[-1].checkpoint)
    with times.measure("evaluation"):
        metrics = {name: _evaluate(cfg, part, output / "evaluation" / name) for name, part in asked.items()}
    with times.measure("prediction"):
        scenes = [_predict_first(cfg, name, part, output) for name, part in asked.items()]
    with times.measure("page"):
        page = write_page(output, scenes=scenes, metrics=metrics, fits=fits, seconds=times.seconds)
    _tell(page, metrics, times.seconds)
    return DemoResult(page, metrics, times.seconds)


def _data(demo_cfg: DictConfig, overrides: Sequence[str], output: Path) -> SceneDataModule:
    """Return the rooms, with all targets that are measured and the views that a prediction takes.

    Raises:
        ConfigError: ``output`` holds a demo with other settings.
    """
    cfg = compose("train", [*overrides, *_SETTINGS, f"output_dir={quoted(output)}"])
    wanted = {
        name: value if isinstance(value := cfg[name], str | int) else plain(value) for name in _RECORDED
    }
    wanted["rooms"] = {name: value for name, value in plain(cfg.rooms).items() if name != "make"}
    wanted |= {"validate_every": demo_cfg.validate_every, "learned": plain(demo_cfg.learned)}
    if SettingsRecord(output / _RECORD).begin(wanted):
        raise ConfigError(
            f"{output} holds a demo with other settings: delete it or give output=ANOTHER_FOLDER"
        )
    return build_data(cfg)


def _train(cfg: DictConfig, overrides: Sequence[str], folder: Path, times: StepTimes) -> list[FitResult]:
    """Train each stage until the training rooms are learned."""
    validation = ["data.val_split=train", "data.val_views=${views.predict_views}", "watch.pictures=0"]
    of_stage = {
        stage: [
            f"schedule.{stage}.validate_every={cfg.validate_every}",
            f"early_stopping.threshold={'null' if learned is None else learned}",
        ]
        for stage, learned in plain(cfg.learned).items()
    }
    fits = run_curriculum([*validation, *overrides], output_dir=folder, of_stage=of_stage)
    for fit in fits:
        # A stage that had finished before took no time now; its entry is there already.
        if fit.seconds:
            times.add(f"training, {fit.folder.name}", fit.seconds)
    return fits


def _asked(overrides: Sequence[str], data: SceneDataModule, checkpoint: Path) -> dict[str, Evaluated]:
    """Return networks and the rooms to evaluate them on, by ``COLUMNS``; shipped weights too, if any."""
    # The network was composed from what is typed here, not out of a file: its own classes are trusted.
    cfg = compose("train", [*overrides, *_SETTINGS, "output_dir=unused"])
    model = load_model(checkpoint, trust=own_packages(plain(cfg.model)))
    views = int(cfg.views.predict_views)
    asked = {split: Evaluated(model, checkpoint, data, split, views) for split in ("train", "val")}
    shipped = shipped_weights()
    if shipped is not None:
        model, wanted = load_model(shipped), prediction_settings(shipped)
        # The same rooms, as this network wants to see them.
        fit = {
            "views.image_size": wanted.image_size,
            "model.grid_resolution": model.grid_resolution,
            "model.grid_extent": model.grid_extent,
        }
        settings = [f"{name}={list(value)}" for name, value in fit.items()]
        cfg = compose("train", [*overrides, *_SETTINGS, *settings])
        asked["shipped"] = Evaluated(model, shipped, build_data(cfg), "val", views)
    return asked


def _evaluate(cfg: DictConfig, asked: Evaluated, output: Path) -> dict[str, Any]:
    about = {"checkpoint": str(asked.checkpoint), **about_data(asked.data, asked.split, asked.num_views)}
    evaluation = evaluate_model(
        asked.model,
        asked.data.split(asked.split),
        tasks=TASKS_WITH_SHAPE,
        score_threshold=cfg.score_threshold,
        duplicate_iou=cfg.duplicate_iou,
        about=about,
    )
    write_evaluation(output, evaluation)
    return evaluation.metrics


def _predict_first(cfg: DictConfig, name: str, asked: Evaluated, output: Path) -> ShownScene:
    """Predict the first of the rooms; write what ``raytran.predict`` writes, the truth in the plan."""
    batch = asked.data.split(asked.split)[0]
    scene = predict_scene(
        asked.model,
        RoomViews.in_one_volume(batch.views, batch.frame_id[0], asked.model),
        scene_id=batch.scene_id[0],
        score_threshold=cfg.score_threshold,
        duplicate_iou=cfg.duplicate_iou,
    )
    folder = output / "predictions" / (("shipped-" if name == "shipped" else "") + batch.scene_id[0])
    truth = None if batch.objects is None else batch.objects[0]
    extent = asked.model.grid_extent
    write_scene(folder, scene, batch.views, batch.frame_id[0], truth=truth)
    return ShownScene(name, folder, batch, scene.prediction, extent)


def _tell(page: Path, metrics: Mapping[str, Mapping[str, Any]], seconds: Mapping[str, float]) -> None:
    table = Table(
        "", *(COLUMNS[name] for name in metrics), title=f"demo, {sum(seconds.values()) / 60:.1f} min"
    )
    columns = [headline(entry) for entry in metrics.values()]
    for name in columns[0]:
        table.add_row(name, *(column[name] for column in columns))
    console = Console()
    console.print(table)
    console.print(f"Everything is in {page.parent}")
    console.print(f"Open {page}", soft_wrap=True)


class StepTimes:
    """Seconds per step of the demo, in the order of their first appearance, kept in a file over kills.

    Args:
        path: JSON file; what it holds is read first.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self.seconds: dict[str, float]
        try:
            self.seconds = {
                name: as_number(value, SECONDS, name) for name, value in read_json_object(path).items()
            }
        except DataError:
            # Times are only shown, nothing depends on them.
            self.seconds = {}

    @contextmanager
    def measure(self, name: str, *, continues: bool = False) -> Iterator[None]:
        """Time a block and say so in the log.

        Args:
            name: of the step.
            continues: the step goes on where a killed run left it, so times add up; else the last one counts.
        """
        _log.info("%s …", name)
        began = time.monotonic()
        try:
            yield
        finally:
            self.add(name, time.monotonic() - began, continues=continues)
        _log.info("%s: %.1f s", name, self.seconds[name])

    def add(self, name: str, seconds: float, *, continues: bool = False) -> None:
        """Enter the time of a step that was measured elsewhere."""
        self.seconds[name] = seconds + (self.seconds.get(name, 0.0) if continues else 0.0)
        write_json(self._path, self.seconds)
