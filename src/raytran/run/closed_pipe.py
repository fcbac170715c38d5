# SPDX-License-Identifier: Apache-2.0
"""What a command does when nobody reads its output any more, as behind ``| head``."""

from __future__ import annotations

import io
import os
import sys
from typing import Any


class _Forgiving(io.FileIO):
    """A stream that throws away what is written after its reader has gone."""

    def write(self, data: Any, /) -> int:
        """Write, or throw away; return how much was taken."""
        try:
            return super().write(data)
        except BrokenPipeError:
            nothing = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nothing, self.fileno())
            os.close(nothing)
            return memoryview(data).nbytes


def survive_closed_pipe() -> None:
    """Let this process go on without a word when the reader of its output has gone.

    Work goes on and results are written; a training must not die because ``head`` has seen enough.
    """
    stream = sys.stdout
    if stream is not sys.__stdout__ or not isinstance(stream, io.TextIOWrapper) or stream.isatty():
        return
    if isinstance(getattr(stream.buffer, "raw", None), _Forgiving):
        return
    stream.flush()
    raw = _Forgiving(stream.fileno(), "w", closefd=False)
    sys.stdout = sys.__stdout__ = io.TextIOWrapper(  # type: ignore[misc]
        io.BufferedWriter(raw),
        encoding=stream.encoding,
        errors=stream.errors,
        line_buffering=stream.line_buffering,
        write_through=stream.write_through,
    )
