# SPDX-License-Identifier: Apache-2.0
"""Runs the notebooks of this folder and keeps what they show: ``python notebooks/execute.py [NAME …]``.

Nothing of the machine stays in the files: no times, no versions, no paths. A test fails when a notebook does
not run, or when what it prints is not what the file has.
"""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import nbformat
from jupyter_client.manager import KernelManager
from nbclient import NotebookClient

FOLDER = Path(__file__).resolve().parent
SECONDS = 300
"""A cell that takes longer is stopped."""


def notebooks() -> list[Path]:
    """Return the notebooks in their order."""
    return sorted(FOLDER.glob("*.ipynb"))


@contextmanager
def running_kernel() -> Iterator[KernelManager]:
    """Give a kernel that works in this folder on one core; it ends with the block."""
    # Sockets in a folder of our own, not TCP: nobody else on the machine can write to them.
    with tempfile.TemporaryDirectory() as folder:
        manager = KernelManager(kernel_name="python3", transport="ipc", ip=str(Path(folder) / "kernel"))
        manager.start_kernel(cwd=str(FOLDER), env=os.environ | {"OMP_NUM_THREADS": "1"})
        try:
            yield manager
        finally:
            manager.shutdown_kernel(now=True)


def executed(path: Path, manager: KernelManager) -> nbformat.NotebookNode:
    """Return a notebook run in a fresh namespace of a running kernel.

    Raises:
        nbclient.exceptions.CellExecutionError: a cell failed.
    """
    notebook = nbformat.read(path, as_version=4)
    client = NotebookClient(
        notebook,
        km=manager,
        timeout=SECONDS,
        iopub_timeout=SECONDS,  # else what a busy machine is slow to hand over is lost
        raise_on_iopub_timeout=True,
        coalesce_streams=True,
        record_timing=False,
    )
    client.kc = manager.client()
    client.kc.start_channels()
    client.kc.wait_for_ready(timeout=SECONDS)
    client.kc.execute("%reset -f", silent=True)
    for number, cell in enumerate(notebook.cells):
        client.execute_cell(cell, number)
    client.kc.stop_channels()
    return cleaned(notebook)


def cleaned(notebook: nbformat.NotebookNode) -> nbformat.NotebookNode:
    """Return a notebook without what differs from run to run or from machine to machine."""
    notebook.metadata = {
        "kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"},
        "language_info": {"name": "python"},
    }
    for number, cell in enumerate(notebook.cells):
        cell.id, cell.metadata = f"cell-{number:02}", {}
        if cell.cell_type == "code":
            cell.execution_count = None
            for output in cell.outputs:
                output.pop("execution_count", None)
                if output.output_type == "execute_result":
                    output.execution_count = None
                output.get("metadata", {}).clear()
    return notebook


def main(names: list[str]) -> None:
    """Run the named notebooks, or all, and write them with what they show."""
    with running_kernel() as manager:
        for path in notebooks():
            if not names or path.name in names:
                nbformat.write(executed(path, manager), path)


if __name__ == "__main__":
    main(sys.argv[1:])
