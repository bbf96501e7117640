"""The command line ``safedpa``.

Read ``group.py`` first: it finds the commands and turns errors into exit codes. Every other module with a ``command``
is one command, imported when it is called. Shared between commands: ``options.py`` and ``bus_options.py`` (options),
``names.py`` (completion), ``json_answer.py`` (``--json``), ``change_requests.py`` and ``stop_orders.py`` (requests).
"""

from __future__ import annotations

import io
import os
import sys

from safedpa_services.command_line.group import safedpa

__all__ = ["main"]


def main(arguments: list[str] | None = None) -> None:
    """Runs the command line and exits: 0 success, 2 invalid input (one line on standard error), 1 any other failure."""
    # Set before numpy is imported. Matrices are tiny here, and OpenBLAS's threads busy-wait for each other: a search
    # took twelve times the CPU time with two threads. PyTorch, used for training, is not affected.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # For every process that a command starts: no module of the working directory, which may be someone else's folder
    # of logs, is taken for one of the standard library or of ours.
    os.environ["PYTHONSAFEPATH"] = "1"
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # names out of a file may have signs that a terminal lacks
            stream.reconfigure(errors="backslashreplace")
    sys.exit(safedpa.run(sys.argv[1:] if arguments is None else arguments))
