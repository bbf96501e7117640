"""The command line ``safedpa``: one command a file, loaded when it is called."""

from __future__ import annotations

import os
import sys

from safedpa_services.command_line.group import safedpa

__all__ = ["main"]


def main(arguments: list[str] | None = None) -> None:
    """Runs the command line; exit code 0 done, 2 bad input (one line on standard error), 1 anything else."""
    # Before numpy is imported: matrices are tiny here, and threads that wait for each other's share spin. A search
    # among effects took twelve times the processor time with two. Torch, which trains, is not concerned.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    sys.exit(safedpa.run(sys.argv[1:] if arguments is None else arguments))
