"""``python -m safedpa_services.stack``: adaptation, policy and safety filter in one process, for fleets.

What the three say to each other does not travel, and is read once; everybody else sees and hears the same as of three
processes. They also end together: an error of one ends all, and the robots' watchdogs brake meanwhile.
"""

from __future__ import annotations

import argparse
import zlib
from collections.abc import Callable
from functools import lru_cache

from safedpa.bus.service.process import RealtimePriority, StopSignal, run_process
from safedpa.errors import InputError
from safedpa_services.nodes import adaptation, add_filter_options, add_policy_options, policy, safety_filter
from safedpa_services.serving import serve, service_parser

_ALL = "1/1"
_CACHED = 1024
"""Names: every message asks, and names may come from anybody."""


def assigned_robots(share: str) -> Callable[[str], bool]:
    """Which robots fall to a stack that is ``share``, such as ``2/3`` for the second of three.

    crc32(name) mod 3 = 1. Raises InputError when it is no such share.
    """
    number, _, of = share.partition("/")
    if not (number.isdecimal() and of.isdecimal() and 1 <= int(number) <= int(of)):
        raise InputError(f"--share: got '{share}', wanted a number and how many there are, such as 1/2")
    own, all_of_them = int(number) - 1, int(of)
    return lru_cache(maxsize=_CACHED)(lambda robot: zlib.crc32(robot.encode()) % all_of_them == own)


def work(options: argparse.Namespace, stop: StopSignal) -> int:
    """Serves until ``stop``; returns the exit code."""
    mine = None if options.share == _ALL else assigned_robots(options.share)
    return serve((adaptation(options), policy(options), safety_filter(options)), options, stop, mine)


if __name__ == "__main__":
    parser = service_parser("safedpa-stack")
    add_policy_options(parser)
    add_filter_options(parser)
    parser.add_argument("--share", default=_ALL, metavar="N/OF", help="of several stacks: serve the N-th part alone")
    run_process(work, parser, RealtimePriority.FILTER)
