# SPDX-License-Identifier: Apache-2.0
"""Reads files of ``torch.save`` that anybody may have written: tensors and plain values, nothing is run.

``torch.load(weights_only=True)`` runs nothing either, but it takes the memory that a file claims: a few bytes
can ask for an array of gigabytes, stretch one number to a tensor of any shape, or hold lists of lists of the
same lists. So the pickle inside is first read with stand-ins for all tensors, and what it claims is held
against what the file has.
"""

from __future__ import annotations

import io
import math
import pickle
import pickletools
import struct
import zipfile
from collections import OrderedDict
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import torch

MAX_PICKLE = 8 * 2**20
"""Bytes of the pickle, which has all but the tensors' numbers; that of the largest preset has 0.3 MB."""

MAX_VALUES = 1_000_000
"""Values in a file, each counted as often as it is referred to; a training on 256 ranks has half as many."""

_MAX_OPCODES = 1_500_000
_MAX_DEPTH = 100
_MAX_DIMENSIONS = 16
_MAX_INTEGER = 2**72
"""Python needs quadratic time for a dictionary of longer ones that are chosen for it."""

_MAGIC = 2**80
"""Above the number with which a file from before PyTorch 1.6 begins."""

_STREAM_PICKLES = 5

_MAX_CLAIM = 2
"""Bytes of all tensors for each byte of the file: two names may share their numbers."""

_OPCODES = frozenset(
    (
        *("PROTO", "STOP", "MARK", "POP", "POP_MARK", "DUP", "NONE", "NEWTRUE", "NEWFALSE", "BININT"),
        *("BININT1", "BININT2", "LONG1", "BINFLOAT", "BINUNICODE", "EMPTY_DICT", "EMPTY_LIST"),
        *("EMPTY_TUPLE", "TUPLE", "TUPLE1", "TUPLE2", "TUPLE3", "APPEND", "APPENDS", "SETITEM", "SETITEMS"),
        *("GLOBAL", "REDUCE", "BUILD", "BINPERSID", "BINPUT", "LONG_BINPUT", "BINGET", "LONG_BINGET"),
    )
)
"""What ``torch.save`` writes and ``weights_only`` reads."""

_ITEM_SIZES = {
    **{"DoubleStorage": 8, "FloatStorage": 4, "HalfStorage": 2, "BFloat16Storage": 2, "LongStorage": 8},
    **{"IntStorage": 4, "ShortStorage": 2, "CharStorage": 1, "ByteStorage": 1, "BoolStorage": 1},
}

_ZIP_END = struct.Struct("<4s4H2IH")
_ZIP64_END = struct.Struct("<4sQ2H2I4Q20s")


def load_archive(path: Path) -> Any:
    """Return what ``torch.save`` wrote to a file, on the CPU.

    Raises:
        pickle.UnpicklingError: it holds more than tensors and plain values.
        ValueError: it is cut short, some of its bytes have changed, or it claims more than it holds.
        OSError: it cannot be read.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            _check_archive(archive, path)
            name = next((name for name in archive.namelist() if name.endswith("/data.pkl")), None)
            if name is None or archive.getinfo(name).file_size > MAX_PICKLE:
                raise ValueError("it has no pickle, or too large a one")
            read_claims(archive.read(name), archive, name.removesuffix("data.pkl"), path.stat().st_size)
        return torch.load(path, map_location="cpu", weights_only=True)
    except (pickle.UnpicklingError, ValueError, OSError):
        raise
    except Exception as error:  # a made-up file can fail anywhere in the readers
        raise ValueError(f"{type(error).__name__}: {error}") from error


def load_stream(path: Path) -> Any:
    """Return what ``torch.save`` wrote before PyTorch 1.6, on the CPU: five pickles, then all numbers.

    Raises:
        pickle.UnpicklingError: it holds more than tensors and plain values.
        ValueError: it is cut short, or claims more than it holds.
        OSError: it cannot be read.
    """
    size = path.stat().st_size
    try:
        with path.open("rb") as file:
            for _ in range(_STREAM_PICKLES):
                start = file.tell()
                content = file.read(MAX_PICKLE)
                length = _pickle_length(content)
                _check_opcodes(content[:length], largest=_MAGIC)
                _count(_ClaimReader(content[:length], None, size).load(), 0, {})
                file.seek(start + length)
        return torch.load(path, map_location="cpu", weights_only=True)
    except (pickle.UnpicklingError, ValueError, OSError):
        raise
    except Exception as error:  # a made-up file can fail anywhere in the readers
        raise ValueError(f"{type(error).__name__}: {error}") from error


class CompressedArchiveError(pickle.UnpicklingError):
    """What PyTorch never writes: small in the file, and as large as it likes in memory."""


def _pickle_length(content: bytes) -> int:
    """Return the bytes of the pickle with which ``content`` begins."""
    *_, (_, _, position) = pickletools.genops(content)
    return 1 + (position or 0)


def _check_archive(archive: zipfile.ZipFile, path: Path) -> None:
    """Raise unless a zip is as PyTorch writes them, and every part of it fits its check sum."""
    parts = archive.infolist()
    if len({part.filename for part in parts}) != len(parts):
        raise ValueError("two parts have one name")
    # PyTorch compresses nothing; what is small here and huge in memory is not from it. Nor do parts overlap.
    if any(part.compress_type != zipfile.ZIP_STORED for part in parts):
        raise CompressedArchiveError
    size = path.stat().st_size
    if any(part.file_size != part.compress_size for part in parts) or _total(parts) > size:
        raise ValueError("its parts are larger than the file")
    # PyTorch's own reader must find the same parts as this one, which looks for the list of them elsewhere.
    with path.open("rb") as file:
        file.seek(max(size - _ZIP64_END.size - _ZIP_END.size, 0))
        tail = file.read()
    end = _ZIP_END.unpack(tail[-_ZIP_END.size :])
    offset = end[6]
    if tail.startswith(b"PK\6\6"):
        offset = _ZIP64_END.unpack(tail[: _ZIP64_END.size])[9]
    if end[0] != b"PK\5\6" or end[7] or offset != archive.start_dir:
        raise ValueError("something stands before or after the archive")
    if archive.testzip() is not None:
        raise ValueError("a check sum is wrong")


def _total(parts: list[zipfile.ZipInfo]) -> int:
    return sum(part.file_size for part in parts)


def read_claims(content: bytes, archive: zipfile.ZipFile, root: str, size: int) -> Any:
    """Return what a pickle holds, with a stand-in for each tensor.

    Args:
        content: the pickle.
        archive: the zip with the tensors' numbers.
        root: folder of the pickle in the zip, with a slash.
        size: bytes of the file.

    Raises:
        pickle.UnpicklingError: it holds more than tensors and plain values.
        ValueError: it claims more than the file holds.
    """
    _check_opcodes(content)
    folder = f"{root}data/"
    stored = {
        part.filename.removeprefix(folder): part.file_size
        for part in archive.infolist()
        if part.filename.startswith(folder)
    }
    found = _ClaimReader(content, stored, size).load()
    _count(found, 0, {})
    return found


def _check_opcodes(content: bytes, *, largest: int = _MAX_INTEGER) -> None:
    for count, (opcode, argument, _) in enumerate(pickletools.genops(content)):
        if opcode.name not in _OPCODES:
            raise pickle.UnpicklingError(f"{opcode.name} in its pickle")
        # Python's reader makes room for all numbers below that under which a value is put.
        if opcode.name == "LONG_BINPUT" and argument is not None and argument > len(content):
            raise ValueError("a value is put under too large a number")
        if opcode.name == "LONG1" and argument is not None and abs(argument) > largest:
            raise ValueError("a number is too large")
        if count == _MAX_OPCODES:
            raise ValueError("its pickle is too long")


class _Storage(NamedTuple):
    """The numbers of one or several tensors."""

    numel: int
    item_size: int


class _TensorClaim(NamedTuple):
    """Stands in for a tensor."""

    shape: tuple[int, ...]


class _ClaimReader(pickle.Unpickler):
    """Reads a pickle of ``torch.save``; tensors become ``_TensorClaim``, and nothing else is made or run."""

    def __init__(self, content: bytes, stored: Mapping[str, int] | None, size: int) -> None:
        """Prepare to read.

        Args:
            content: the pickle.
            stored: bytes of each tensor's numbers, by key; None: they stand behind the pickles.
            size: bytes of the file.
        """
        super().__init__(io.BytesIO(content))
        self._stored, self._size = stored, size
        self._bytes_left = _MAX_CLAIM * size

    def find_class(self, module: str, name: str) -> Any:
        """Return the stand-in of a name, the only ones that a file can make anything of."""
        if (module, name) == ("collections", "OrderedDict"):
            return OrderedDict
        if (module, name) == ("torch._utils", "_rebuild_tensor_v2"):
            return _Rebuild(self)
        if (module, name) == ("torch._utils", "_rebuild_parameter"):
            return _First()
        if (module, name) == ("torch", "Size"):
            return tuple
        if module == "torch" and name in _ITEM_SIZES:
            return name
        raise pickle.UnpicklingError(f"{module}.{name} in its pickle")

    def persistent_load(self, reference: Any) -> _Storage:
        """Return the stand-in of a tensor's numbers, if the archive has so many."""
        kind, storage, key, _, numel = reference[:5]
        item_size = _ITEM_SIZES[storage]
        if kind != "storage" or type(numel) is not int or not 0 <= numel * item_size <= self._size:
            raise ValueError("a tensor is larger than the file")
        if self._stored is not None and self._stored[key] != numel * item_size:
            raise ValueError("a tensor has other bytes than its pickle says")
        return _Storage(numel, item_size)

    def rebuild(self, storage: _Storage, offset: int, shape: Any, stride: Any) -> _TensorClaim:
        """Return the stand-in of a tensor, if its numbers are there."""
        if type(storage) is not _Storage or len(shape) != len(stride) or len(shape) > _MAX_DIMENSIONS:
            raise ValueError("a tensor has no proper shape")
        if any(type(number) is not int or number < 0 for number in (offset, *shape, *stride)):
            raise ValueError("a tensor has no proper shape")
        count = math.prod(shape)
        last = offset + sum((side - 1) * step for side, step in zip(shape, stride, strict=True))
        if count and last >= storage.numel:
            raise ValueError("a tensor is larger than its numbers")
        self._bytes_left -= count * storage.item_size
        if self._bytes_left < 0:
            raise ValueError("its tensors are larger than the file")
        return _TensorClaim(tuple(shape))


class _Rebuild:
    """Stands in for PyTorch's function of that name. Not the method itself: a pickle can set attributes."""

    __slots__ = ("__reader",)

    def __init__(self, reader: _ClaimReader) -> None:
        self.__reader = reader

    def __call__(self, storage: Any, offset: Any, shape: Any, stride: Any, *_: Any) -> _TensorClaim:
        return self.__reader.rebuild(storage, offset, shape, stride)


class _First:
    __slots__ = ()

    def __call__(self, data: Any, *_: Any) -> Any:
        return data


def _count(node: Any, depth: int, known: dict[int, int]) -> int:
    """Return the number of values below a node, each as often as it is referred to."""
    if type(node) in (_TensorClaim, _Storage) or not isinstance(node, dict | list | tuple):
        return 1
    if id(node) in known:
        count = known[id(node)]
        if not count:
            raise ValueError("a value holds itself")
        return count
    if depth == _MAX_DEPTH:
        raise ValueError("its values are nested too deeply")
    known[id(node)] = 0
    parts = (*node.keys(), *node.values()) if isinstance(node, dict) else node
    count = 1 + sum(_count(part, depth + 1, known) for part in parts)
    if count > MAX_VALUES:
        raise ValueError("it holds too many values")
    known[id(node)] = count
    return count
