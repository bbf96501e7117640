"""A robot's Zenoh router, as ``rmw_zenohd`` is one: ``python -m safedpa_lab.ros.router PORT``."""

from __future__ import annotations

import argparse
import sys
import threading

from safedpa.bus.transport.zenoh import open_session, zenoh_session_configuration


def _main() -> None:
    """Passes on until it is killed."""
    parser = argparse.ArgumentParser(description="A Zenoh router on this machine, as rmw_zenohd is one.")
    parser.add_argument("port", type=int, help="TCP port to listen on")
    settings = {
        "mode": "router",
        "listen/endpoints": [f"tcp/127.0.0.1:{parser.parse_args().port}"],
        "scouting/multicast/enabled": False,
    }
    with open_session(zenoh_session_configuration(settings)):
        sys.stdout.write("there\n")
        sys.stdout.flush()
        threading.Event().wait()


if __name__ == "__main__":
    _main()
