# SPDX-License-Identifier: Apache-2.0
"""Lets Hydra 1.3 make its command line on Python 3.14, whose argparse looks into help that is not text yet.

Python 3.14 formats the help of an option as soon as it is added. That of Hydra's ``--shell-completion`` is an
object which becomes text only when it is shown, and so no command of Hydra 1.3.8 or older starts there.
"""

from __future__ import annotations

import argparse
from importlib import import_module
from typing import Any

from hydra._internal.utils import get_args_parser

_CHECK = "_check_help"
"""The method of ``ArgumentParser`` that looks; there is none before Python 3.14."""


def let_help_be_lazy() -> None:
    """Let Hydra make its parser by ``hydra_parser``, for commands and for what a shell completes."""
    for name in ("hydra.main", "hydra._internal.utils"):
        module: Any = import_module(name)  # hydra.main by itself is a function
        module.get_args_parser = hydra_parser


def hydra_parser() -> argparse.ArgumentParser:
    """Return the parser of Hydra's options, made without argparse's look at their help."""
    look = getattr(argparse.ArgumentParser, _CHECK, None)
    if look is None:
        return get_args_parser()
    setattr(argparse.ArgumentParser, _CHECK, lambda *_: None)
    try:
        return get_args_parser()
    finally:
        setattr(argparse.ArgumentParser, _CHECK, look)
