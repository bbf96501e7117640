"""What a process has used so far, as the kernel counts it, and what a command of this project writes.

The kernel's account is robust where the machine is busy with other things.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import takewhile
from pathlib import Path
from typing import final

from safedpa.errors import SafedpaError


@final
@dataclass(frozen=True)
class Usage:
    """Processor time [s] of all threads, the memory that is in use now [MiB], open files, sockets and pipes."""

    cpu_seconds: float
    resident_mib: float
    handles: int


def usage_of(pid: int) -> Usage | None:
    """Of a running process; None where it is gone, or where the system has no /proc."""
    try:
        # the name in brackets may hold anything, so the fields are counted from behind it
        fields = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").rsplit(")", 1)[1].split()
        pages = int(Path(f"/proc/{pid}/statm").read_text(encoding="utf-8").split()[1])
        handles = len(os.listdir(f"/proc/{pid}/fd"))
    except (OSError, IndexError):
        return None
    ticks = (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
    return Usage(max(ticks, _of_threads(pid)), pages * os.sysconf("SC_PAGE_SIZE") / 2**20, handles)


def _of_threads(pid: int) -> float:
    """s; of the threads that live, to the nanosecond: what needs less than a tick of the clock is not nothing."""
    total = 0
    for path in Path(f"/proc/{pid}/task").glob("*/schedstat"):
        try:
            total += int(path.read_text(encoding="utf-8").split()[0])
        except (OSError, IndexError):  # it ended meanwhile, or this kernel does not count it
            continue
    return 1e-9 * total


def output_of(*arguments: str, environment: Mapping[str, str] | None = None) -> str:
    """What ``safedpa`` writes, as a process of its own. Raises SafedpaError with its message where it fails."""
    command = [sys.executable, "-m", "safedpa_services", *arguments]
    surroundings = {**os.environ, **(environment or {})}
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=surroundings)
    if done.returncode != 0:
        subcommand = " ".join(takewhile(lambda part: not part.startswith("-"), arguments))
        raise SafedpaError(f"safedpa {subcommand}: {done.stderr.strip()}")
    return done.stdout


def load_average() -> float | None:
    """Processes that wanted to run over the last minute; None where the system does not tell."""
    try:
        return round(os.getloadavg()[0], 2)
    except OSError:
        return None
