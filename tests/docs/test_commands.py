# SPDX-License-Identifier: Apache-2.0
"""Commands that a page, a notebook or ``--help`` shows can be typed: their settings exist and compose."""

from __future__ import annotations

import functools
import re
import shlex
from importlib.util import find_spec
from itertools import product, takewhile

import pytest
from hydra import compose, initialize_config_dir
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import OverrideParseException
from omegaconf import OmegaConf

from raytran.__main__ import VERBS
from raytran.run.config_dir import config_dir
from raytran.run.entry import entry_point, with_keys

COMMAND = re.compile(rf"(?:-m raytran\.|\braytran +(?=(?:{'|'.join(VERBS)})\b))(\w+)((?:\\\n|[^\n`])*)")
POSITIONAL = ("view",)


def commands(text):
    """Return name and settings of each command shown, each choice ``a|b`` as a command of its own."""
    for name, rest in COMMAND.findall(text):
        rest = re.sub(r"\\\n\s*", "", rest).replace("\\|", "|")
        rest = re.split(r"\s#|\s{3,}|[;)](?=\s|$)", rest)[0].rstrip(" ,.:")
        rest = re.sub(r"(^|\s)\[([\w./]+=.*?)\](?=\s|$)", r"\1\2", rest)  # [key=value]: may be left out
        words = [word.rstrip(",") for word in split(rest) if not re.match(r"-|…|.*=…$", word)]
        path = words[:1] if name in POSITIONAL else []
        words = path + list(takewhile(lambda word: "=" in word, words[len(path) :]))  # what follows is prose
        words = [word.replace("…", "x") for word in words]
        yield from ((name, tuple(choice)) for choice in product(*map(alternatives, words)))


def split(text):
    try:
        return shlex.split(text)
    except ValueError:  # an apostrophe in prose
        return text.split()


def alternatives(word):
    key, equals, value = word.partition("=")
    return [f"{key}={each}" for each in value.split("|")] if equals else [word]


@pytest.fixture(scope="module")
def shown(pages):
    """Each command by what was typed, with the places that show it."""
    helps = {path: path.read_text(encoding="utf-8") for path in config_dir().rglob("*.yaml")}
    found: dict[tuple[str, tuple[str, ...]], list[str]] = {}
    for path, text in {**pages, **helps}.items():
        for command in commands(text):
            found.setdefault(command, []).append(path.name)
    return found


@functools.cache
def settings(name, *chosen):
    """Compose a command's settings; Hydra is at work already."""
    return compose(name, list(chosen))


def complaint(name, words):
    """Return what is wrong with a command, None if nothing is."""
    if name == "VERB":
        return None  # stands for any
    if find_spec(f"raytran.{name}") is None:
        return "there is no such command"
    if not (config_dir() / f"{name}.yaml").is_file():
        return None  # one without Hydra reads its words itself
    words = with_keys(name, words) if name in POSITIONAL else list(words)
    try:
        overrides = OverridesParser.create().parse_overrides(words)
    except OverrideParseException as error:
        return str(error)
    groups = [each for each in overrides if (config_dir() / each.key_or_group).is_dir()]
    for each in groups:
        names = each.value() if isinstance(each.value(), list) else [each.value()]
        missing = [
            file for file in names if not (config_dir() / each.key_or_group / f"{file}.yaml").is_file()
        ]
        if missing:
            return f"there is no {each.key_or_group}={missing[0]}"
    for each in overrides:
        if each not in groups and not each.key_or_group.startswith("hydra") and not each.is_add():
            # Composing takes long; a group is chosen only where the default has no such setting.
            chosen = [group.input_line for group in groups]
            if not any(has(settings(name, *some), each.key_or_group) for some in ((), chosen)):
                return f"there is no {each.key_or_group}"
    return None


def has(cfg, key):
    *parents, last = key.split(".")
    node = OmegaConf.select(cfg, ".".join(parents)) if parents else cfg
    return node is not None and last in list(node.keys())


def test_commands_that_are_shown_can_be_typed(shown):
    entry_point("train")  # makes OmegaConf know our resolvers
    wrong = []
    with initialize_config_dir(str(config_dir()), version_base="1.3"):
        for (name, words), places in shown.items():
            found = complaint(name, words)
            if found:
                wrong.append(f"{places[0]}: {name} {' '.join(words)}: {found.splitlines()[0]}")
    assert not wrong, "\n".join(wrong)
    assert len(shown) > 60


def test_every_command_has_its_page(project_root):
    pages = {path.stem for path in (project_root / "docs" / "commands").glob("*.md")}
    roots = {path.stem for path in config_dir().glob("*.yaml")}
    assert not roots - pages, f"docs/commands lacks a page for {sorted(roots - pages)}"
    index = (project_root / "docs" / "commands" / "README.md").read_text(encoding="utf-8")
    assert not [name for name in roots if f"]({name}.md)" not in index]


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("`raytran train seed=1`, and", [("train", ("seed=1",))]),
        ("raytran train seed=1    all else; raytran carries", [("train", ("seed=1",))]),
        ("raytran predict walk.mp4 of raytran's", [("predict", ())]),
        ("raytran view PREDICTION   # in the browser", [("view", ("PREDICTION",))]),
        (
            "-m raytran.evaluate a=x|y \\\n  [b=c]",
            [("evaluate", ("a=x", "b=c")), ("evaluate", ("a=y", "b=c"))],
        ),
        ("-m raytran.plan 'c=[1, 2]' --cfg job", [("plan", ("c=[1, 2]",))]),
    ],
)
def test_commands_are_found(text, found):
    assert list(commands(text)) == found


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("train", ["experimen=stage1"]),
        ("train", ["preset=huge"]),
        ("trane", []),
        ("plan", ["gpu"]),
        ("train", ["seed=[1"]),
    ],
)
def test_what_does_not_exist_is_found(name, words):
    entry_point("train")
    with initialize_config_dir(str(config_dir()), version_base="1.3"):
        assert complaint(name, words)


def test_rows_of_the_paper_name_their_data(pages, project_root):
    """A command that names none runs on generated rooms, whatever the checkpoint was trained on."""
    page = pages[project_root / "docs" / "experiments.md"]
    table = page.split("## The paper's tables")[1].split("## Sweeps")[0]
    rows = [line for line in table.splitlines() if line.startswith("|") and COMMAND.search(line)]
    found = [
        command for row in rows for command in re.findall(r"`((?:python -m raytran\.|raytran )[^`]*)`", row)
    ]
    assert len(found) >= 5
    silent = [command for command in found if "data=scan2cad data.root=DIR" not in command]
    assert not silent, silent
