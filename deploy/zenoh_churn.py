"""Peers that come and go in a mesh: how long Zenoh takes to open and close a session, and whether it is stationary.

    python deploy/zenoh_churn.py --seconds 25                       as our processes open their sessions
    python deploy/zenoh_churn.py --seconds 25 --net-threads 1 --both-connect    as Zenoh does by default

One process stays; ``--peers`` others open a session with a few subscribers, speak once, and close it, again and again.
Zenoh 1.10.2 with its single thread for links locks up in some of these runs for good
(https://github.com/eclipse-zenoh/zenoh/issues/2581): then a session does not close within 10 s.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import time
from typing import Any

from safedpa.bus import ZenohSettings
from safedpa.bus.transport import ports
from safedpa.bus.transport.zenoh import open_session, zenoh_session_configuration


def settings_of(port: int, number: int, both_connect: bool) -> dict[str, Any]:
    """Of peer ``number``; number 0 is the one that stays, and where the others meet."""
    door = f"tcp/127.0.0.1:{port}"
    found = (ZenohSettings(listen=(door,)) if number == 0 else ZenohSettings(connect=(door,))).configuration()
    if both_connect:
        found.pop("scouting/gossip/autoconnect_strategy", None)
    return found


def visit(settings: dict[str, Any]) -> float:
    """Opens a session, speaks, closes it; how long the closing took [s]. Raises zenoh.ZError where it does not."""
    import zenoh

    session = open_session(zenoh_session_configuration(settings))
    silent = zenoh.handlers.Callback(lambda sample: None, indirect=False)
    held: list[Any] = [session.declare_subscriber(f"churn/{number}", silent) for number in range(5)]
    held.append(session.liveliness().declare_token(f"churn/alive/{os.getpid()}"))
    session.put("churn/0", b"here")
    time.sleep(0.05)
    began = time.monotonic()
    session.close()  # type: ignore[no-untyped-call]
    return time.monotonic() - began


def be_a_peer(port: int, number: int, seconds: float, both_connect: bool) -> None:
    """Prints how long its sessions took to close, and what it was stationary for."""
    import zenoh

    end, took, failed = time.monotonic() + seconds, [], ""
    settings = settings_of(port, number, both_connect)
    if number == 0:  # stays
        resident = open_session(zenoh_session_configuration(settings))
        time.sleep(seconds)
        del resident
    while time.monotonic() < end and not failed:
        try:
            took.append(visit(settings))
        except zenoh.ZError as error:
            failed = str(error).split(" at /")[0]
    sys.stdout.write(json.dumps({"took": took, "failed": failed}))
    sys.stdout.flush()
    os._exit(0)  # a session that does not close would hold the process up


def main() -> None:
    """Prints what all of them found."""
    parser = argparse.ArgumentParser(prog="zenoh_churn")
    parser.add_argument("--peers", type=int, default=12)
    parser.add_argument("--seconds", type=float, default=25.0)
    parser.add_argument("--net-threads", type=int, help="threads with which Zenoh opens and closes links")
    parser.add_argument("--both-connect", action="store_true", help="of two peers each connects to the other")
    parser.add_argument("--be", type=int, nargs=2, metavar=("PORT", "NUMBER"), help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.be is not None:
        be_a_peer(*options.be, options.seconds, options.both_connect)
    environment = {**os.environ}
    if options.net_threads is not None:
        environment["ZENOH_RUNTIME"] = f"(net: (worker_threads: {options.net_threads}))"
    port = ports.free_port()
    command = [sys.executable, __file__, *sys.argv[1:], "--be", str(port)]
    peers = [
        subprocess.Popen([*command, str(number)], stdout=subprocess.PIPE, text=True, env=environment)
        for number in range(options.peers + 1)
    ]
    reported = [json.loads(peer.communicate(timeout=options.seconds + 60.0)[0]) for peer in peers]
    took = [seconds for one in reported for seconds in one["took"]]
    failed = [one["failed"] for one in reported if one["failed"]]
    usual = statistics.median(took)
    sys.stdout.write(
        f"{len(took)} sessions, closed within {usual:.2f} s in the median, {max(took):.2f} s at most\n"
        f"{len(failed)} of {options.peers} peers was stationary: {'; '.join(sorted(set(failed))) or '-'}\n"
    )


if __name__ == "__main__":
    main()
