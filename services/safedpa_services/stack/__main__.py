"""``python -m safedpa_services.stack``: adaptation, policy and safety filter in one process, for fleets.

Messages between the three stay in the process and are decoded once. For all other processes the stack looks like three
services. An error in one of the three ends the process, and the robots' watchdogs brake until it is restarted.
"""

from __future__ import annotations

import argparse
import zlib
from collections.abc import Callable
from functools import lru_cache

from safedpa.bus.service.process import RealtimePriority, StopSignal, run_process
from safedpa.errors import InputError
from safedpa_services.service_factories import adaptation, add_filter_options, add_policy_options, policy, safety_filter
from safedpa_services.service_main import serve, service_parser

_ALL = "1/1"
_CACHED = 1024
"""Robot names whose assignment is cached: it is looked up for every message. Bounded, because any client can send
names."""


def assigned_robots(share: str) -> Callable[[str], bool]:
    """Returns whether a robot is assigned to the stack ``share``, such as ``2/3`` for the second of three stacks.

    A robot belongs to the stack number crc32(name) mod 3, counted from 0. Raises InputError if ``share`` is malformed.
    """
    number, _, of = share.partition("/")
    if not (number.isdecimal() and of.isdecimal() and 1 <= int(number) <= int(of)):
        raise InputError(f"--share: got '{share}', wanted NUMBER/COUNT, such as 1/2 for the first of two")
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
    parser.add_argument(
        "--share", default=_ALL, metavar="N/OF", help="serve the N-th part of the fleet only, of OF parts"
    )
    run_process(work, parser, RealtimePriority.FILTER)
