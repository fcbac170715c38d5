# SPDX-License-Identifier: Apache-2.0
"""``raytran VERB …``, which is ``python -m raytran.VERB …``; alone it lists the verbs."""

from __future__ import annotations

import os
import runpy
import sys
from collections.abc import Sequence
from difflib import get_close_matches
from importlib import import_module

from raytran import __version__
from raytran.run.closed_pipe import survive_closed_pipe

VERBS = {
    "demo": "the whole path on generated rooms in minutes: train, measure, predict, one page to look at",
    "predict": "the objects of a scene, with class, pose and mesh, from a posed video",
    "poses": "the cameras of a video whose poses are not known, for predict",
    "view": "look at a prediction in the browser",
    "prepare": "make a data set, or look through one for mistakes",
    "train": "train one stage",
    "curriculum": "train the three stages, one after another",
    "plan": "will it fit? memory and time, before anything is run",
    "evaluate": "how good a checkpoint is, or anybody's predictions",
    "export_model": "the network of a checkpoint, in a file to give away",
}
"""Every command, in the order in which most people come to them, and what it is for."""

_EXAMPLES = (
    ("raytran predict sample", "a room that raytran carries; or a folder, a recording, a video"),
    ("raytran train experiment=stage2 preset=tiny", "settings are key=value"),
    ("raytran VERB --help", "all settings of a command"),
)
_ELSEWHERE = {
    **dict.fromkeys(("test", "val", "validate", "score"), "evaluate"),
    **dict.fromkeys(("infer", "inference", "detect", "run"), "predict"),
    **dict.fromkeys(("process-data", "sfm", "colmap", "mapper"), "poses"),
    **dict.fromkeys(("show", "viewer", "open"), "view"),
    **dict.fromkeys(("check", "data", "doctor"), "prepare"),
    **dict.fromkeys(("fit", "finetune"), "train"),
}
"""What other programs call such commands."""

_COMPLETION = ("-sc", "--shell-completion")
_ANY = "view"
"""A command to ask for what all have; it has the fewest settings."""


def main(words: Sequence[str] | None = None) -> None:
    """Run the command that is typed after ``raytran``.

    Args:
        words: of the command line, without the program's name; None for those of this process.
    """
    survive_closed_pipe()
    words = sys.argv[1:] if words is None else list(words)
    if not words or words[0] in ("--help", "-h"):
        sys.stdout.write(listing())
    elif words[0] == "--version":
        sys.stdout.write(f"raytran {__version__}\n")
    elif words[0] in _COMPLETION or words[0].startswith("--shell-completion="):
        _complete(words)
    elif words[0] in VERBS:
        sys.argv[1:] = words[1:]
        # As the module that Python runs: Lightning starts further ranks by its name.
        runpy.run_module(f"raytran.{words[0]}", run_name="__main__", alter_sys=True)
    else:
        sys.stderr.write(f"raytran: {_no_verb(words[0])}\n")
        raise SystemExit(1)


def listing() -> str:
    """Return what ``raytran`` alone says."""
    width = max(map(len, VERBS)) + 2
    verbs = [f"  {name:{width}}{purpose}" for name, purpose in VERBS.items()]
    width = max(len(typed) for typed, _ in _EXAMPLES) + 3
    examples = [f"  {typed:{width}}{meaning}" for typed, meaning in _EXAMPLES]
    return "\n".join(
        [
            f"raytran {__version__}: every object of a room, from a posed RGB video",
            "",
            "  raytran VERB [PATH] [key=value …]",
            "",
            *verbs,
            "",
            *examples,
            "",
        ]
    )


def _no_verb(word: str) -> str:
    """Return what to say of a first word that is no command."""
    lists = "raytran alone lists the verbs"
    if os.path.exists(word):
        return f"{word} is a path and no verb: is raytran predict {word} meant? {lists}"
    if "=" in word or word.startswith("-"):
        return f"a verb comes first, as in raytran train {word}: {lists}"
    begun = [verb for verb in VERBS if verb.startswith(word)]
    other = [_ELSEWHERE[word]] if word in _ELSEWHERE else []
    meant = other or begun or get_close_matches(word, VERBS, n=2, cutoff=0.6)
    question = f"is {' or '.join(meant)} meant? " if meant else ""
    return f"there is no verb {word}: {question}{lists}"


def _complete(words: Sequence[str]) -> None:
    """Answer a shell that completes what is typed, or install that; both are Hydra's."""
    line = os.environ.get("COMP_LINE", "").lstrip()
    typed = line.split()[1:]
    is_query = "query" in " ".join(words)
    if is_query and (len(typed) == 0 or (len(typed) == 1 and not line[-1:].isspace())):
        sys.stdout.write(f"{' '.join(verb for verb in VERBS if verb.startswith(''.join(typed)))}\n")
        return
    verb = typed[0] if is_query else _ANY
    if verb not in VERBS:
        return
    # Hydra takes the first word for the program, and completes the settings behind it.
    os.environ["COMP_LINE"] = f"raytran {line.partition(verb)[2].lstrip()}"
    sys.argv = ["raytran", *words]
    import_module(f"raytran.{verb}").main()


if __name__ == "__main__":
    main()
