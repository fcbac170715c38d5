# SPDX-License-Identifier: Apache-2.0
"""Settings that are paths take any path; other settings keep Hydra's grammar."""

from __future__ import annotations

import os
import runpy
import shlex
from pathlib import Path

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import QuotedString
from omegaconf import OmegaConf

from raytran.errors import ConfigError
from raytran.run.config_dir import config_dir
from raytran.run.entry import compose, with_keys
from raytran.run.path_settings import PATH_SETTINGS, check_run_folder, literal_paths, quoted
from raytran.run.train.build import build_data

NAMES = [
    *(
        "room",
        "room 2",
        "scan (1)",
        "wohnzimmer ä",
        "部屋",
        "mum's room",
        "R&D",
        "a=b",
        "a,b",
        "room[2]",
        "[a]",
        "{a}",
    ),
    *(
        "{a: b}",
        "room #2",
        "!bang;",
        "$HOME",
        "~",
        "~/room",
        "*?",
        "%TEMP%",
        "|<>",
        "`ls`",
        "@",
        ":",
        "😀",
        "e\u0301",
    ),
    *(
        " lead",
        "trail ",
        "\ttab",
        "new\nline",
        "\x1b[31m",
        "null",
        "Null",
        "1",
        "1e3",
        "0x10",
        "true",
        "False",
    ),
    *(
        "inf",
        "nan",
        "_",
        "-m",
        "--multirun",
        "none",
        "auto",
        "choice(a,b)",
        "glob(*)",
        "range(1,3)",
        "str(1)",
    ),
    *(
        "${a}",
        "${oc.env:HOME}",
        "${",
        "\\${a}",
        "\\\\${a}",
        "$${a}",
        "${a",
        "x${a}\\",
        "a\\b",
        "a\\",
        "\\\\",
        "a\\'b",
    ),
    *(
        '"',
        '"a',
        'a"',
        "'",
        "'a",
        '"a"b"',
        "'a' and 'b'",
        '\\"',
        "C:\\rooms\\a (1)",
        "\\\\server\\rooms",
        "x\udcfc",
    ),
    *("(" * 3000, "[" * 3000, "a" * 4000),
]

# Words of these in a comment or a name: it says that the setting is a file or a folder.
SIGNS = (
    "folder",
    "file",
    "dir",
    "DIR",
    "FILE",
    "FOLDER",
    "CHECKPOINT",
    "CKPT",
    "checkpoint",
    "JSON",
    "json",
    "CSV",
)
NO_PATHS = {
    "card": "a switch",
    "trust": "names of packages",
    "protocol": "a name",
    "scenes": "names of scans",
    "splits": "names",
    "num_views": "a number",
    "format": "a name",
    "check_parent": "a name",
    "dtype": "of the file that output= names",
    "viewer": "a switch",
    "turntable": "a number",
    "checks": "a number",
    "checkpoint_every": "a number",
    "model.backbone.checkpoint_blocks": "a switch",
    "check": "of predict: a switch",
    "stage.new_views": "a number",
    "max_frames": "a number",
    "program.part": "a name",
    "launcher.resume": "auto or none",
    "trainer.enable_checkpointing": "a switch",
    "trainer.profiler.filename": "a name inside of a folder",
    "trainer.accumulate_grad_batches": "a number",
}


def value_of(word):
    """Return what Hydra makes of a word's value, as OmegaConf gives it."""
    value = OverridesParser.create().parse_override(word).value()
    cfg = OmegaConf.create({"scene": None, "output": "y"})
    OmegaConf.update(cfg, "scene", value.text if isinstance(value, QuotedString) else value)
    return cfg.scene


@pytest.mark.parametrize("name", NAMES, ids=[ascii(name)[:30] for name in NAMES])
def test_a_path_arrives_as_typed(name):
    (word,) = literal_paths("predict", [f"scene={name}"])
    assert value_of(word) == name
    assert literal_paths("predict", [word]) == [word], "twice is once"
    assert literal_paths("predict", [f"++scene={name}"]) == [f"++{word}"]
    assert value_of(f"scene={quoted(name)}") == name


@pytest.mark.parametrize(
    ("command", "word"), [("predict", "scene="), ("train", "data.root="), ("demo", "output=")]
)
def test_nothing_is_no_path(command, word):
    """Else it were the folder that one is in: an unset variable of a shell leaves nothing."""
    with pytest.raises(ConfigError, match=rf"{word} is empty: give a path"):
        literal_paths(command, [word])


def test_a_path_that_looks_like_a_missing_value():
    assert value_of(literal_paths("predict", ["scene=???"])[0]) == "./???"


@pytest.mark.parametrize("name", ["${a}", "\\${a}", "x${a}\\"])
def test_settings_that_refer_to_a_path_get_it_too(name):
    cfg = compose("train", ["preset=tiny", f"data.root={name}", "output_dir=x"])
    assert cfg.data.root == name
    assert cfg.data.dataset.cache_dir == f"{name}/cache"
    data = build_data(cfg)
    assert (str(data.root), str(data._dataset.keywords["cache_dir"])) == (name, f"{name}/cache")


@pytest.mark.parametrize(
    "word", ["scene=/rooms/a-1/b_2.mp4", "scene=room 2", "output=../x", "scene=C:\\rooms"]
)
def test_paths_that_need_no_quotes_get_none(word):
    """Sweeps and curricula find their folders by the words typed, earlier ones without quotes among them."""
    assert literal_paths("predict", [word]) == [word]


@pytest.mark.parametrize(
    ("typed", "meant"),
    [
        ('scene="room (2)"', "room (2)"),
        ("scene='room (2)'", "room (2)"),
        ('scene="say \\"a\\""', 'say "a"'),
        ('scene="${output}/x"', "y/x"),
    ],
)
def test_what_is_in_quotes_is_hydras(typed, meant):
    assert value_of(literal_paths("predict", [typed])[0]) == meant


@pytest.mark.parametrize(
    ("command", "word", "null"),
    [
        ("predict", "cads=null", True),
        ("predict", "truth=NULL", True),
        ("predict", "scene=null", False),
        ("prepare", "output=null", True),
        ("predict", "output=null", True),
        ("evaluate", "predictions=null", True),
        ("train", "data.make.cads=null", True),
        ("train", "model.backbone.encoder.weights=null", True),
        ("train", "init_from=null", False),
        ("predict", "cads=", True),
        ("prepare", "check=", True),
    ],
)
def test_null_means_none_where_that_is_a_choice(command, word, null):
    (word,) = literal_paths(command, [word])
    assert (OverridesParser.create().parse_override(word).value() is None) == null


def test_other_settings_and_options_are_left_alone():
    words = [
        "trust=[a,b]",
        "up=+x",
        "~cads",
        "scene",
        "--config-dir",
        "/x/a=b (1)",
        "num_views=4",
        "sweep=seeds",
    ]
    assert literal_paths("train", words) == words
    # A folder for prepare, a switch for predict.
    assert literal_paths("predict", ["check=a,b"]) == ["check=a,b"]
    assert literal_paths("prepare", ["check=a,b"]) == ['check="a,b"']


@pytest.mark.parametrize("sign", ["-m", "--multirun", "hydra.mode=MULTIRUN", "sweep=seeds"])
def test_in_a_sweep_a_comma_parts_paths(sign):
    (word,) = literal_paths("train", [sign, "data.root=/a (1),'/b, c',/d=e, f"])[1:]
    parsed = OverridesParser.create().parse_override(word)
    values = [value.text if hasattr(value, "text") else value for value in parsed.value().list]
    assert values == ["/a (1)", "/b, c", "/d=e", "f"]
    chosen = literal_paths("train", [sign, "data.root=choice(a,b)"])[1]
    assert OverridesParser.create().parse_override(chosen).is_sweep_override()


def test_a_job_of_a_sweep_keeps_the_commas_of_a_path():
    words = ["sweep=seeds", "hydra.mode=RUN", "data.root=a,b"]
    assert literal_paths("train", words)[-1] == 'data.root="a,b"'


@pytest.mark.parametrize(
    ("typed", "meant"),
    [
        ("draw_with=[a,b]", ["a", "b"]),
        ("draw_with=[a (1), 'b,c']", ["a (1)", "b,c"]),
        ("draw_with=[]", []),
        ("draw_with=a=b", ["a=b"]),
        ("draw_with='a,b'", ["a,b"]),
        ("draw_with=a,b", ["a,b"]),
    ],
)
def test_lists_of_paths(typed, meant):
    assert list(compose("evaluate", [typed]).draw_with) == meant
    more = compose("train", [typed.replace("draw_with", "data.more_roots"), "output_dir=unused"])
    assert list(more.data.more_roots) == meant


def test_the_folder_that_lightning_gives_to_a_rank():
    folder = '/x/a "b" \\ (1)'
    words = ["preset=tiny", f'hydra.run.dir="{folder}"', "hydra.job.name=train_ddp_process_1"]
    assert literal_paths("train", words) == ["preset=tiny", f"hydra.run.dir={quoted(folder)}", words[2]]


@pytest.mark.parametrize("word", ["output_dir=a${b}", "outputs=${", "resume=${a}/checkpoints/last.ckpt"])
def test_a_run_cannot_be_kept_where_hydra_reads_a_reference(word):
    with pytest.raises(ConfigError, match=r"without \$\{ in its name"):
        check_run_folder([word])
    check_run_folder(["data.root=${a}", 'output_dir="${outputs}/x"'])


def test_a_word_without_a_key_may_have_an_equals_sign(tmp_path, monkeypatch):
    (tmp_path / "a=b").mkdir()
    monkeypatch.chdir(tmp_path)
    assert with_keys("view", ["a=b", "port=0"]) == ['folder="a=b"', "port=0"]
    assert [with_keys("view", [word])[0] for word in ("/x/a=b", "./a=b", "部=屋")] == [
        'folder="/x/a=b"',
        'folder="./a=b"',
        'folder="部=屋"',
    ]


@pytest.mark.parametrize(
    "name", ["scan (1)", "a,b", "a=b", "部屋", "mum's", '"', "${a}", "null", "x\udcfc", "[x]\n\x1b[2J"]
)
def test_the_command_line_looks_for_what_was_typed(name, command, tmp_path):
    (tmp_path / os.fsencode(name).decode(errors="surrogateescape")).mkdir()
    done = command("predict", f"scene={name}", "output=out", "num_views=3", folder=tmp_path)
    (sentence,) = done.stderr.splitlines()
    assert done.returncode == 1
    assert sentence.startswith("raytran: ")
    assert sentence.isprintable()
    assert " is empty: give the folder of a scene" in sentence


@pytest.mark.parametrize(
    "typed", ["variant_prefix=a(b", "variant_prefix=ü", "variant_prefix=a=b", "variant_prefix=a,b"]
)
def test_a_mistake_in_another_setting_says_how_to_write_it(typed, command, tmp_path):
    done = command("train", typed, "output_dir=x", folder=tmp_path)
    (sentence,) = done.stderr.splitlines()
    key, value = typed.split("=", 1)
    assert typed in sentence
    (way_out,) = shlex.split(sentence[sentence.index("as in ") + 6 :].split(", or add -m")[0])
    assert compose("train", [way_out, "output_dir=x"])[key] == value


def test_options_may_stand_between_settings(command, tmp_path):
    words = ["preset=tiny", "--cfg", "job", "data.root=a, (b)", "--resolve", "output_dir=x"]
    done = command("train", *words, folder=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "cache_dir: a, (b)/cache" in done.stdout


def test_no_path_setting_of_conf_is_missing(project_root):
    listed = runpy.run_path(str(project_root / "docs" / "options.py"))["options"]
    known = {name for names in PATH_SETTINGS.values() for name in names}
    found = {}
    for path in sorted(Path(config_dir()).rglob("*.yaml")):
        name = path.relative_to(config_dir()).with_suffix("")
        if name.parts[0] == "hydra":
            continue
        for option in listed(str(name)):
            names = option.name.rpartition(".")[2].split("_")
            is_path = any(
                sign in option.comment.split() or sign in names for sign in (*SIGNS, "root", "path")
            )
            is_path = is_path or any(
                sign in option.comment for sign in ("folder", "file", "CHECKPOINT", "FILE")
            )
            if option.value is not None and is_path:
                found[option.name] = name
    missing = {name: where for name, where in found.items() if name not in known | set(NO_PATHS)}
    assert not missing, (
        "settings that seem to be paths: name them in PATH_SETTINGS, or above why they are none"
    )
    assert len(found) > 20


@pytest.mark.parametrize("command", PATH_SETTINGS)
def test_path_settings_are_settings(command):
    chosen = {
        "train": ["preset=tiny", "debug=profiler"],
        "curriculum": ["preset=tiny", "debug=profiler"],
        "demo": ["debug=profiler"],
        "evaluate": ["preset=tiny"],
        "plan": ["preset=tiny"],
    }.get(command, [])
    names = [name for name in PATH_SETTINGS[command] if not (command == "plan" and name.startswith("data."))]
    for logger in ("many", "mlflow") if command in ("train", "curriculum", "demo") else (None,):
        others = (
            () if logger is None else ("logger.mlflow.",) if logger == "many" else ("logger.t", "logger.w")
        )
        settings = [
            f"++{name}=x" if name == "trainer.default_root_dir" else f"{name}=x"
            for name in names
            if not name.startswith(others)
        ]
        compose(command, [*chosen, *([f"logger={logger}"] if logger else []), *settings])
