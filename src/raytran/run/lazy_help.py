# SPDX-License-Identifier: Apache-2.0
"""Lets Hydra 1.3 make its command line on Python 3.14, whose argparse looks into help that is not text yet.

Python 3.14 formats the help of an option as soon as it is added. That of Hydra's ``--shell-completion`` is an
object which becomes text only when it is shown, and so no command of Hydra 1.3.8 or older starts there.
"""

from __future__ import annotations

import argparse
import functools
from collections.abc import Callable
from importlib import import_module
from typing import Any

_CHECK = "_check_help"
"""The method of ``ArgumentParser`` that looks; there is none before Python 3.14."""

Make = Callable[[], argparse.ArgumentParser]


def let_help_be_lazy() -> None:
    """Make Hydra's parser without the look at its help; done once, and nothing before Python 3.14."""
    main: Any = import_module("hydra.main")  # hydra.main itself is a function
    if hasattr(argparse.ArgumentParser, _CHECK) and not hasattr(main.get_args_parser, "__wrapped__"):
        main.get_args_parser = without_look(main.get_args_parser)


def without_look(make: Make) -> Make:
    """Return ``make``, during which argparse adds options without looking at their help."""

    @functools.wraps(make)
    def make_parser() -> argparse.ArgumentParser:
        look = getattr(argparse.ArgumentParser, _CHECK)
        setattr(argparse.ArgumentParser, _CHECK, lambda *_: None)
        try:
            return make()
        finally:
            setattr(argparse.ArgumentParser, _CHECK, look)

    return make_parser
