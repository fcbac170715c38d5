# SPDX-License-Identifier: Apache-2.0
"""Damage and malice: changes of small valid files, as disks, editors, programs and attackers make them.

All take a ``random.Random``, so that a number stands for an input.
"""

from __future__ import annotations

import contextlib
import json
import random
import struct
import zipfile
from collections.abc import Callable
from io import BytesIO
from pathlib import Path
from typing import Any

NUMBERS = (b"\0" * 8, b"\xff" * 8, b"\xff\xff\xff\x7f", struct.pack("<Q", 1 << 60), struct.pack("<d", 1e300))
RAW = {
    "@infinity": "1e999",
    "@huge": "9" * 400,
    "@long": "-" + "9" * 60_000,
    "@nan": "NaN",
    "@half": '"\\ud800"',
    "@deep": "[" * 3000 + "]" * 3000,
    "@million": "[" + "0," * 300_000 + "0]",
}
"""What ``json.dumps`` would not write, by stand-ins."""

NONSENSE: tuple[Any, ...] = (
    *(
        None,
        True,
        False,
        "",
        "x",
        "x" * 10_000,
        "\0",
        "../../../etc/passwd",
        "/etc/passwd",
        "a\nb\x1b[2J",
        "1",
        "nan",
    ),
    *(0, -1, 1, 2, 3.5, 1e300, -1e300, 1e-300, 1e9, 10**12, 65_537, [], {}, [[]], [0], {"a": 1}, [None] * 4),
    *([1] * 100, [[1e300] * 4] * 4, [[0.0] * 4] * 4),
    *RAW,
)
WORDS = (
    *(
        "nan",
        "inf",
        "-inf",
        "1e300",
        "1e999",
        "-1",
        "0",
        "x",
        "",
        "9" * 400,
        "9" * 5000,
        "1_000",
        "１２",
        "0x10",
        "\0",
    ),
    *(
        "1e-300",
        "-0",
        "1,5",
        '"',
        "#",
        "../../x",
        "ü" * 3,
        "1;2",
        "65537",
        "4294967296",
        "NaN",
        "[/x]",
        "${a}",
    ),
)


def mutated_bytes(content: bytes, rng: random.Random) -> bytes:
    """Return bytes with one to three changes that know nothing of their format."""
    data = bytearray(content)
    for _ in range(rng.choice((1, 1, 2, 3))):
        at = rng.randrange(len(data) + 1)
        length = min(rng.choice((1, 2, 4, 8, 64, 1000)), len(data) - at)
        kind = rng.randrange(9)
        if kind == 0 and length:
            data[at] ^= 1 << rng.randrange(8)
        elif kind == 1 and length:
            data[at] = rng.randrange(256)
        elif kind == 2:
            number = rng.choice(NUMBERS)
            data[at : at + len(number)] = number
        elif kind == 3:
            del data[at:]
        elif kind == 4:
            del data[at : at + length]
        elif kind == 5:
            data[at:at] = data[at : at + length] * rng.choice((1, 2, 100, 1000))
        elif kind == 6:
            data[at:at] = rng.randbytes(rng.choice((1, 8, 100)))
        elif kind == 7:
            other = rng.randrange(len(data) + 1)
            data[at : at + length] = data[other : other + length]
        else:
            data[: rng.choice((0, at))] = b""
    return bytes(data[: 4 * 2**20])


def mutated_json(value: Any, rng: random.Random) -> Any:
    """Return a JSON value with one part changed; ``RAW`` says what some texts in it stand for."""
    places = list(_places(value))
    if not places:
        return rng.choice(NONSENSE)
    node, key = rng.choice(places)
    kind = rng.randrange(8)
    if kind < 4:
        node[key] = rng.choice(NONSENSE)
    elif kind == 4:
        del node[key]
    elif kind == 5 and isinstance(node, dict):
        node[rng.choice((str(key).upper(), "x", "", str(key) + " "))] = node.pop(key)
    elif kind == 5:
        node.extend([node[key]] * rng.choice((1, 3, 1000)))
    elif kind == 6:
        node[key] = rng.choice(([node[key]], {"x": node[key]}, str(node[key])[:1000], [node[key]] * 3))
    elif isinstance(node[key], int | float) and not isinstance(node[key], bool):
        node[key] = node[key] * rng.choice((-1, 0, 1e3, 1e6, 1e30, 1e-6))
    else:
        other, place = rng.choice(places)
        node[key] = json.loads(json.dumps(other[place]))
    return value


def json_text(value: Any, rng: random.Random | None = None) -> str:
    """Return the JSON of a value with stand-ins; sometimes with a key twice."""
    text = json.dumps(value)
    for name, raw in RAW.items():
        text = text.replace(json.dumps(name), raw)
    if rng is not None and rng.random() < 0.02 and text.startswith("{") and len(text) > 2:
        text = text[:-1] + "," + text[1:]
    return text


_DEEPEST = 200


def with_raw_values(value: Any, depth: int = 0) -> Any:
    """Return a value with Python's own in place of stand-ins, as deep as the mutations of one input reach."""
    if depth > _DEEPEST:
        return value
    if isinstance(value, dict):
        return {key: with_raw_values(part, depth + 1) for key, part in value.items()}
    if isinstance(value, list):
        return [with_raw_values(part, depth + 1) for part in value]
    if not isinstance(value, str) or value not in RAW:
        return value
    deep: list[Any] = []
    for _ in range(60):
        deep = [deep]
    values = {"@infinity": float("inf"), "@nan": float("nan"), "@huge": 10**400, "@long": -(10**4000)}
    return {**values, "@half": "x", "@deep": deep, "@million": [0] * 100_000}[value]


def _places(value: Any, depth: int = 0) -> Any:
    """Yield every container with each of its keys or positions."""
    if depth < 12 and isinstance(value, dict | list):
        for key in list(value) if isinstance(value, dict) else range(len(value)):
            yield value, key
            yield from _places(value[key], depth + 1)


def mutated_text(text: str, rng: random.Random) -> bytes:
    """Return a table, list or key-value file with words and lines changed, perhaps in another encoding."""
    lines = text.split("\n")
    for _ in range(rng.choice((1, 1, 2, 4))):
        at = rng.randrange(len(lines))
        kind = rng.randrange(8)
        separator = "," if "," in lines[at] else " "
        words = lines[at].split(separator)
        if kind < 4:
            words[rng.randrange(len(words))] = rng.choice(WORDS)
            lines[at] = separator.join(words)
        elif kind == 4:
            del words[rng.randrange(len(words))]
            lines[at] = separator.join(words)
        elif kind == 5:
            lines[at : at + 1] = [lines[at]] * rng.choice((0, 2, 2, 500))
        elif kind == 6:
            lines[at] = separator.join(words * rng.choice((2, 1000)))
        else:
            rng.shuffle(lines)
        lines = lines or [""]
    content = rng.choice(("\n", "\n", "\n", "\r\n", "\r", "\n\n")).join(lines)
    encoding = rng.choice(("utf-8", "utf-8", "utf-8", "utf-8-sig", "utf-16", "utf-16-be", "latin-1"))
    return content.encode(encoding, errors="replace")[: 4 * 2**20]


def mutated_zip(content: bytes, rng: random.Random, inside: Callable[[str, bytes], bytes]) -> bytes:
    """Return an archive in which one part is changed and its check sum right, or which is damaged itself."""
    if rng.random() < 0.3:
        return mutated_bytes(content, rng)
    with zipfile.ZipFile(BytesIO(content)) as archive:
        parts = [(part.filename, archive.read(part), part.compress_type) for part in archive.infolist()]
    out = BytesIO()
    chosen = rng.randrange(len(parts))
    kind = rng.randrange(12)
    with zipfile.ZipFile(out, "w") as archive:
        for index, (name, data, compression) in enumerate(parts):
            if index == chosen:
                if kind == 0:
                    continue
                if kind == 1:
                    name = rng.choice(("../x", "/x", "a" * 60_000, "\0", name.upper()))
                elif kind == 2:
                    data, compression = bytes(50_000_000), zipfile.ZIP_DEFLATED
                elif kind == 3:
                    compression = zipfile.ZIP_DEFLATED
                else:
                    data = inside(name, data)
            archive.writestr(name, data, compression)
    return out.getvalue()


def mutate_file(path: Path, rng: random.Random) -> None:
    """Change one file in a way that its ending suggests."""
    content = path.read_bytes()
    changed = None
    if rng.random() > 0.15:
        with contextlib.suppress(Exception):  # it was damaged before
            changed = _mutated_as_what_it_is(path.suffix, content, rng)
    path.write_bytes(mutated_bytes(content, rng) if changed is None else changed)


def _mutated_as_what_it_is(suffix: str, content: bytes, rng: random.Random) -> bytes:
    if suffix == ".json" or content[:1] in (b"{", b"["):
        value = json.loads(content)
        for _ in range(rng.choice((1, 1, 1, 2, 4))):
            value = mutated_json(value, rng)
        return json_text(value, rng).encode("utf-8", errors="surrogatepass")
    if suffix in (".npz", ".zip", ".sh3f", ".ckpt", ".pth", ".r3d"):
        return mutated_zip(content, rng, lambda name, data: _mutated_part(name, data, rng))
    if _is_text(content):
        return mutated_text(content.decode(), rng)
    return mutated_bytes(content, rng)


def _mutated_part(name: str, data: bytes, rng: random.Random) -> bytes:
    if data[:1] in (b"{", b"[") and _is_text(data):
        return json_text(mutated_json(json.loads(data), rng)).encode("utf-8", errors="surrogatepass")
    if _is_text(data) and data:
        return mutated_text(data.decode(), rng)
    return mutated_bytes(data, rng)


def _is_text(content: bytes) -> bool:
    if b"\0" in content:
        return False
    try:
        content.decode()
    except UnicodeDecodeError:
        return False
    return True
