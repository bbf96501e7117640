"""The command line ``safedpa``: one command a file, loaded when it is called."""

from __future__ import annotations

import sys

from safedpa_services.command_line.group import safedpa

__all__ = ["main"]


def main(arguments: list[str] | None = None) -> None:
    """Runs the command line; exit code 0 done, 2 bad input (one line on standard error), 1 anything else."""
    sys.exit(safedpa.run(sys.argv[1:] if arguments is None else arguments))
