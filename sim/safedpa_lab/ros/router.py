"""A robot's Zenoh router, as ``rmw_zenohd`` is one: ``python -m safedpa_lab.ros.router PORT``."""

from __future__ import annotations

import json
import sys
import threading

import zenoh


def _main() -> None:
    """Passes on until it is killed."""
    settings = zenoh.Config()
    for path, value in (
        ("mode", "router"),
        ("listen/endpoints", [f"tcp/127.0.0.1:{int(sys.argv[1])}"]),
        ("scouting/multicast/enabled", False),
    ):
        settings.insert_json5(path, json.dumps(value))
    with zenoh.open(settings):
        sys.stdout.write("there\n")
        sys.stdout.flush()
        threading.Event().wait()


if __name__ == "__main__":
    _main()
