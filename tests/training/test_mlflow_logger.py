# SPDX-License-Identifier: Apache-2.0
"""Runs in MLflow: by its own store where it is installed, and by a stand-in of its client everywhere."""

from __future__ import annotations

import sys
from types import ModuleType, SimpleNamespace
from typing import ClassVar

import pytest
from lightning.pytorch.loggers import mlflow as of_lightning

from raytran.errors import ConfigError
from raytran.training.loggers import MLFLOW_ID, mlflow_logger


class MlflowError(Exception):
    """Stands for MLflow's own."""


class Client:
    """What Lightning's logger asks of MLflow's client, kept in memory for each store."""

    stores: ClassVar[dict] = {}

    def __init__(self, uri):
        self.runs = self.stores.setdefault(uri, {})
        self.is_broken = False

    def get_experiment_by_name(self, name):
        return None

    def create_experiment(self, name, artifact_location):
        return name

    def create_run(self, experiment_id, tags):
        run_id = f"run{len(self.runs)}"
        self.runs[run_id] = {"tags": tags, "metrics": [], "params": {}, "artifacts": [], "status": "RUNNING"}
        return SimpleNamespace(info=SimpleNamespace(run_id=run_id))

    def get_run(self, run_id):
        return SimpleNamespace(info=SimpleNamespace(experiment_id="raytran"), of=self.runs[run_id])

    def log_batch(self, run_id, metrics=(), params=()):
        if self.is_broken:
            raise MlflowError("no server\nand a stack")
        run = self.runs[run_id]
        run["metrics"] += [(one.key, one.step, one.value) for one in metrics]
        for one in params:
            if run["params"].setdefault(one.key, one.value) != one.value:
                raise MlflowError("Changing param values is not allowed")

    def log_artifact(self, run_id, path, folder):
        self.runs[run_id]["artifacts"].append((path, folder))

    def set_terminated(self, run_id, status):
        self.runs[run_id]["status"] = status


@pytest.fixture
def stand_in(monkeypatch):
    """A package mlflow that keeps everything in memory."""
    names = ("", ".tracking", ".tracking.context", ".entities", ".utils", ".utils.mlflow_tags", ".exceptions")
    modules = {f"mlflow{name}": ModuleType(f"mlflow{name}") for name in names}
    vars(modules["mlflow"])["set_tracking_uri"] = lambda uri: None
    context = modules["mlflow.tracking.context"]
    vars(context)["resolve_tags"] = lambda tags: dict(tags)
    vars(modules["mlflow.tracking"]).update(MlflowClient=Client, context=context)
    vars(modules["mlflow.entities"]).update(Metric=SimpleNamespace, Param=SimpleNamespace)
    vars(modules["mlflow.utils.mlflow_tags"])["MLFLOW_RUN_NAME"] = "mlflow.runName"
    vars(modules["mlflow.exceptions"])["MlflowException"] = MlflowError
    for name, module in modules.items():
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.setattr(context, "__path__", [], raising=False)
    monkeypatch.setattr(of_lightning, "_MLFLOW_AVAILABLE", True)
    monkeypatch.setattr(Client, "stores", {})
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    return Client.stores


def logger_of(folder, run="run"):
    return mlflow_logger(
        experiment="raytran", name="tiny-stage1", save_dir=str(folder / run), store=str(folder)
    )


def test_a_run_and_its_resume_are_one(tmp_path, stand_in):
    (tmp_path / "sweep.json").write_text("{}")
    first = logger_of(tmp_path)
    first.log_hyperparams({"seed": 0, "data": {"root": "rooms"}})
    first.log_metrics({"val/total": 2.0}, 3)
    first.log_pictures({"scene0000_00/masks": tmp_path / "masks.png"}, 4)
    first.finalize("success")
    again = logger_of(tmp_path)
    again.log_hyperparams({"seed": 1})
    again.log_metrics({"val/total": 1.0}, 5)
    ((store, runs),) = stand_in.items()
    assert store == f"sqlite:///{tmp_path / 'mlflow.db'}"
    assert (tmp_path / "run" / MLFLOW_ID).read_text() == "run0\n"
    (run,) = runs.values()
    assert run["metrics"] == [("val/total", 3, 2.0), ("val/total", 5, 1.0)]
    assert run["params"] == {"seed": "0", "data/root": "rooms"}
    assert run["artifacts"] == [(str(tmp_path / "masks.png"), "pictures/step-000004/scene0000_00")]
    assert run["tags"]["mlflow.runName"] == "tiny-stage1 run"
    assert run["tags"]["group"].endswith(tmp_path.name)
    assert run["status"] == "FINISHED"


def test_a_server_has_precedence_and_its_faults_end_no_run(tmp_path, stand_in, monkeypatch, caplog):
    monkeypatch.setenv("MLFLOW_TRACKING_URI", "http://localhost:5000")
    logger = logger_of(tmp_path)
    logger.log_hyperparams({})
    assert list(stand_in) == ["http://localhost:5000"]
    logger.experiment.is_broken = True
    for step in range(3):
        logger.log_metrics({"train/total": 1.0}, step)
    assert caplog.text.count("MLflow is not told everything (no server); training goes on") == 1
    assert not (tmp_path / "mlflow.db").exists()


def test_without_the_package_it_is_one_sentence(tmp_path, monkeypatch):
    monkeypatch.setattr(of_lightning, "_MLFLOW_AVAILABLE", False)
    with pytest.raises(ConfigError, match=r"pip install 'raytran\[mlflow\]', or choose another logger="):
        logger_of(tmp_path)


def test_its_own_store(tmp_path, monkeypatch):
    pytest.importorskip("mlflow")
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    (tmp_path / "masks.png").write_bytes(b"picture")
    for value in (2.0, 1.0):
        logger = logger_of(tmp_path)
        logger.log_hyperparams({"value": value})
        logger.log_metrics({"val/total": value}, 3)
        logger.log_pictures({"scene/masks": tmp_path / "masks.png"}, 4)
        logger.finalize("success")
    run = logger.experiment.get_run(logger.run_id)
    assert (run.data.params, run.data.metrics) == ({"value": "2.0"}, {"val/total": 1.0})
    assert run.info.status == "FINISHED"
    assert [path.name for path in (tmp_path / "mlflow").rglob("masks.png")] == ["masks.png"]
