# SPDX-License-Identifier: Apache-2.0
"""Every command line in a code block of README.md and docs/ composes, all its words, by raytran's own parser.

``test_commands.py`` reads what stands inside of sentences, where a command ends is a guess; here nothing is
guessed and nothing left out but what ``STANDS_FOR_MORE`` and ``NOT_COMPOSED`` name.
"""

from __future__ import annotations

import functools
import re
import shlex
from copy import deepcopy
from itertools import product

import pytest
from hydra import compose, initialize_config_dir
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import ConfigCompositionException, HydraException
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from raytran.__main__ import VERBS
from raytran.errors import ConfigError, RaytranError
from raytran.run.conf_comments import options
from raytran.run.config_dir import config_dir
from raytran.run.entry import entry_point, with_keys, with_number_lists
from raytran.run.lazy_help import hydra_parser
from raytran.run.path_settings import PATH_SETTINGS, literal_paths
from raytran.run.setting_mistakes import check_kinds
from raytran.run.train.settings import RunConfig
from raytran.setting_limits import check_settings

FENCED = re.compile(r"^```(?:bash|sh|console|)\n(.*?)^```", re.MULTILINE | re.DOTALL)
INDENTED = re.compile(r"(?:^(?: {4}.*)?\n)+", re.MULTILINE)
CALL = re.compile(r"(?:^|\s)(?:raytran +|-m raytran\.)(\w+|-\S+)(?=\s|$)(.*)$")
STANDS_FOR_MORE = {"…", "SETTING", "CONF"}
"""Words that stand for settings of the reader's own."""

NOT_COMPOSED = {
    "-sc": "a shell reads what it prints",
    "--config-dir": "wants a folder of the reader's own, which test_how_to_add.py writes and runs",
}
"""What a line begins with, or contains → why it is not composed."""


def command_lines(text):
    """Yield verb and rest of each command in the code blocks of a page, without comments, on one line."""
    blocks = FENCED.findall(text)
    blocks += INDENTED.findall(FENCED.sub("", text))
    for block in blocks:
        for line in re.sub(r"\\\n\s*", " ", block).splitlines():
            found = CALL.search(re.split(r"(?:^|\s)#", line.strip())[0])
            if found:
                yield found.groups()


def words_of(rest):
    """Return the words of a line as a shell parts them, each choice ``a|b`` and ``[key=value]`` as typed."""
    words = []
    for word in shlex.split(rest, comments=True):
        optional = re.fullmatch(r"\[([\w.]+=.*)\]", word)
        word = optional[1] if optional else word
        key, equals, value = word.partition("=")
        if word not in STANDS_FOR_MORE and value != "…":
            is_choice = equals and "|" in value and not re.search(r"[\[({\"']", value)
            words.append([f"{key}={each}" for each in value.split("|")] if is_choice else [word])
    return [list(each) for each in product(*words)]


@functools.cache
def chosen(verb, groups):
    return compose(verb, list(groups))


@functools.cache
def choices(verb):
    """Return the groups that a command chooses from."""
    return set(compose(verb, [], return_hydra_config=True).hydra.runtime.choices)


@functools.cache
def comments(verb):
    return {option.name: option.comment for option in options(verb)}


def complaint(verb, words):
    """Return why a command would be refused before it does anything, None if it would not."""
    if verb not in VERBS:
        return f"there is no verb {verb}"
    options_typed, unknown = hydra_parser().parse_known_args([word for word in words if word[0] == "-"])
    if unknown:
        return f"there is no option {unknown[0]}"
    try:
        settings = [word for word in words if not word.startswith("-")]
        settings = literal_paths(verb, with_keys(verb, with_number_lists(settings)))
        for job in jobs(settings, sweeps=options_typed.multirun):
            check(verb, job)
    except (RaytranError, HydraException, OmegaConfBaseException) as error:
        return str(error).splitlines()[0]
    return None


def jobs(settings, *, sweeps):
    """Return the settings of each job of a sweep; those of one that is none are a job."""
    overrides = OverridesParser.create().parse_overrides(settings)
    if not sweeps:
        return [settings]
    return product(
        *(
            [f"{each.key_or_group}={value}" for value in each.sweep_string_iterator()]
            if each.is_sweep_override() and each.is_discrete_sweep()
            else []
            if each.is_sweep_override()
            else [each.input_line]
            for each in overrides
        )
    )


def check(verb, settings):
    """Raise what the command would raise before it does anything."""
    overrides = OverridesParser.create().parse_overrides(list(settings))
    groups = [each for each in overrides if each.key_or_group in choices(verb) or is_folder(each)]
    for each in groups:
        names = each.value() if isinstance(each.value(), list) else [each.value()]
        if each.key_or_group not in choices(verb) or not all(is_file(each.key_or_group, it) for it in names):
            raise ConfigError(f"{verb} takes no {each.input_line}")
    own = [each for each in overrides if each not in groups and not each.key_or_group.startswith("hydra.")]
    try:
        cfg = with_overrides(verb, (), own)
    except ConfigCompositionException:  # composing takes long: with the groups only where it matters
        cfg = with_overrides(verb, tuple(each.input_line for each in groups), own)
    if verb == "train":
        cfg.output_dir = "unused"
        RunConfig.read(cfg)
    names = {each.key_or_group for each in groups}
    check_kinds(verb, cfg, settings, groups=names, default=lambda typed: chosen(verb, tuple(typed)))
    check_settings(OmegaConf.to_container(cfg, resolve=False))
    for each in own:
        if each.key_or_group not in PATH_SETTINGS[verb]:
            check_choice(each.key_or_group, each.value(), comments(verb).get(each.key_or_group, ""))


def is_folder(override):
    return (config_dir() / override.key_or_group).is_dir()


def is_file(group, name):
    return name is None or (config_dir() / group / f"{name}.yaml").is_file()


def with_overrides(verb, groups, own):
    cfg = deepcopy(chosen(verb, groups))
    ConfigLoaderImpl._apply_overrides_to_config(own, cfg)
    return cfg


def check_choice(key, value, comment):
    """Raise if a comment in conf/ lists what can be chosen, and the word that was typed is not there."""
    is_word = isinstance(value, str) and re.fullmatch(r"[\w-]+", value)
    listed = re.search(rf"(?<![\w-]){re.escape(str(value))}(?![\w-])", comment)
    if is_word and re.search(r" \| |^\w+: .*; \w", comment) and not listed:
        raise ConfigError(f"{key} knows no {value}")


@pytest.fixture(scope="module")
def shown(project_root):
    """Each line by what is typed, with the pages that show it."""
    found: dict[tuple[str, str], list[str]] = {}
    for page in (project_root / "README.md", *sorted((project_root / "docs").rglob("*.md"))):
        for line in command_lines(page.read_text(encoding="utf-8")):
            found.setdefault(line, []).append(str(page.relative_to(project_root)))
    return found


@pytest.fixture(scope="module")
def hydra():
    entry_point("train")  # makes OmegaConf know our resolvers
    with initialize_config_dir(str(config_dir()), version_base="1.3"):
        yield


def test_every_line_composes(shown, hydra):
    wrong = [
        f"{pages[0]}: raytran {verb} {' '.join(words)}: {found}"
        for (verb, rest), pages in shown.items()
        if not any(sign in f"{verb} {rest}".split() for sign in NOT_COMPOSED)
        for words in words_of(rest)
        if (found := complaint(verb, words))
    ]
    assert not wrong, "\n".join(wrong)
    assert len(shown) > 80
    assert {verb for verb, _ in shown} >= set(VERBS)


@pytest.mark.parametrize(
    ("verb", "rest"),
    [
        ("trane", "experiment=stage1"),
        ("train", "experimen=stage1"),
        ("train", "experiment=stage1 data.roots=x"),
        ("train", "preset=huge"),
        ("train", "seed=abc"),
        ("train", "--resume experiment=stage1"),
        ("train", "experiment=stage1 and so on"),
        ("train", "-m seed=1,2 sede=3"),
        ("train", "seed=1,2"),
        ("train", "schedule.stage1.steps=-4"),
        ("prepare", "dataset=rooms-v3 output=x"),
        ("demo", "overrides=[seed=1]"),
        ("evaluate", "checkpoint=x protocol=scan2cat"),
        ("predict", "one two"),
    ],
)
def test_a_line_with_a_mistake_is_found(hydra, verb, rest):
    assert all(complaint(verb, words) for words in words_of(rest))


def test_lines_of_all_kinds_are_found():
    page = """Text with `raytran train nope=1`.

```bash
raytran train seed=1 \\
    preset=tiny   # not raytran train seed=2
cd x && raytran view prediction
python -m raytran.plan gpu=8GB
```

    raytran predict sample
    pip install raytran

```python
raytran.load()
```
"""
    found = [(verb, words) for verb, rest in command_lines(page) for words in words_of(rest)]
    assert found == [
        ("train", ["seed=1", "preset=tiny"]),
        ("view", ["prediction"]),
        ("plan", ["gpu=8GB"]),
        ("predict", ["sample"]),
    ]
    assert words_of("a=x|y … [b=1] 'c=[1,2]'") == [["a=x", "b=1", "c=[1,2]"], ["a=y", "b=1", "c=[1,2]"]]
