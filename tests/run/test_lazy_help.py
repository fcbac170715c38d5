# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import argparse
from importlib import import_module

import pytest
from hydra._internal import utils

from raytran.run.lazy_help import get_args_parser as of_hydra
from raytran.run.lazy_help import hydra_parser, let_help_be_lazy


@pytest.fixture
def looking(monkeypatch):
    """argparse as of Python 3.14, whatever Python this is: it looks whether a help has a sign of formats."""
    looked = []

    def check(parser, action):
        looked.append(action.dest)
        if action.help and "%" in action.help:
            raise ValueError("badly formed help string")

    def add_argument(parser, *names, **what):
        action = argparse._ActionsContainer.add_argument(parser, *names, **what)
        parser._check_help(action)
        return action

    monkeypatch.setattr(argparse.ArgumentParser, "_check_help", check, raising=False)
    monkeypatch.setattr(argparse.ArgumentParser, "add_argument", add_argument, raising=False)
    return looked


def test_hydra_makes_its_command_line_where_argparse_looks(looking, monkeypatch):
    main = import_module("hydra.main")
    for module in (main, utils):
        monkeypatch.setattr(module, "get_args_parser", of_hydra)
        with pytest.raises(TypeError, match="LazyCompletionHelp"):
            module.get_args_parser()
    let_help_be_lazy()
    looking.clear()
    assert main.get_args_parser().parse_args(["--cfg", "job", "a=1"]).overrides == ["a=1"]
    assert utils.get_args(["a=1"]).overrides == ["a=1"]  # what a shell completes goes this way
    assert looking == []


def test_other_command_lines_are_looked_at_as_before(looking):
    hydra_parser()
    with pytest.raises(ValueError, match="badly formed"):
        argparse.ArgumentParser().add_argument("--x", help="100 %")
