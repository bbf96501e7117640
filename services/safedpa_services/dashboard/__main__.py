"""``python -m safedpa_services.dashboard``: shows a fleet live in the browser, and records it for Rerun."""

from __future__ import annotations

import argparse
import os
import sys
import uuid
from functools import partial
from pathlib import Path

from safedpa.bus import NO_ROBOT
from safedpa.bus.service.process import StopSignal, bus_from_options, run_process
from safedpa.dynamics import load_model
from safedpa.errors import InputError
from safedpa.extras import need
from safedpa.safety.defaults import settings_named
from safedpa.systems.robots import DEFAULT_ROBOT
from safedpa_services.dashboard.dashboard import Dashboard
from safedpa_services.dashboard.display_settings import display_settings
from safedpa_services.dashboard.fleet_view import FleetView
from safedpa_services.dashboard.pages import FIRST_RERUN_PORT, DataProxy, Readers, ViewerServer, private_loopback
from safedpa_services.service_main import service_parser
from safedpa_services.web.ports import choose_port, open_server

_DRIVE_ENDED = "The drive and this dashboard have ended. The panes show the last data."
_FILE_INTERVAL = 0.2
"""s; a file of 5 rows a second is not larger than the recording of the bus."""
_DASHBOARD_ENDED = "This dashboard was ended. The panes show the last data; the robots drive on without it."


def work(options: argparse.Namespace, stop: StopSignal) -> int:
    """Shows until ``stop``; returns exit code 0."""
    os.nice(10)  # the control loop has priority; if drawing falls behind, frames are skipped
    os.environ.setdefault("RUST_LOG", "error")
    need("view", what="the dashboard")
    if not options.viewer and not options.save:
        raise InputError("--no-viewer: got it without --save; name a file to record to, or leave out --no-viewer")
    settings = settings_named(options.settings)
    display = display_settings(load_model(options.model), settings)
    from safedpa_services.dashboard.rerun_recording import FileLimits, RerunRecording

    grpc_port = choose_port(options.grpc_port, 9876, "--grpc-port", options.bind) if options.viewer else None
    save = Path(options.save) if options.save else None
    rerun_host = private_loopback()
    data_port = choose_port(None, FIRST_RERUN_PORT, "--grpc-port", rerun_host) if options.viewer else None
    limits = FileLimits(interval=_FILE_INTERVAL)
    recording = RerunRecording(display, options.fleet, save=save, bind=rerun_host, grpc_port=data_port, limits=limits)
    readers = Readers()
    if grpc_port is not None and data_port is not None:
        where, required = (rerun_host, data_port), options.grpc_port is not None
        start = partial(DataProxy, options.bind, behind=where, names=options.name, readers=readers)
        grpc_port = open_server(start, grpc_port, required=required)
    address = "" if grpc_port is None else _start_viewer(options, grpc_port)
    sys.stdout.write(f"dashboard: {address or 'no viewer'}{f', recording {save}' if save else ''}\n")
    sys.stdout.flush()
    with bus_from_options(options) as bus:
        bus.announce(NO_ROBOT, "dashboard", uuid.uuid4().hex[:12])
        view, lag = FleetView(display, options.fleet), lambda: readers.lag
        dashboard = Dashboard(bus, view, recording, options.robot, address, lag)
        dashboard.run(stop)
        dashboard.end(_DRIVE_ENDED if options.supervised else _DASHBOARD_ENDED)
    recording.close()
    return 0


def _start_viewer(options: argparse.Namespace, grpc_port: int) -> str:
    first = choose_port(options.web_port, 9090, "--web-port", options.bind)
    start = partial(ViewerServer, options.bind, grpc_port=grpc_port, names=options.name)
    port = open_server(start, first, required=options.web_port is not None)
    host = "localhost" if options.bind in ("127.0.0.1", "0.0.0.0", "::", "::1") else options.bind
    return f"http://{host}:{port}"


def _parser() -> argparse.ArgumentParser:
    parser = service_parser("safedpa-dashboard")
    parser.add_argument(
        "--settings", default=DEFAULT_ROBOT, metavar="FILE.toml", help="settings of the filter: a file or a name"
    )
    parser.add_argument("--save", default="", metavar="FILE.rrd", help="file to record to")
    parser.add_argument(
        "--web-port", type=int, default=None, help="port of the page; default: 9090 or the next free one"
    )
    parser.add_argument(
        "--grpc-port", type=int, default=None, help="port of the data; default: 9876 or the next free one"
    )
    parser.add_argument("--bind", default="127.0.0.1", help="address to listen on; 0.0.0.0 allows other machines")
    parser.add_argument(
        "--name",
        action="append",
        default=[],
        metavar="HOST",
        help="further host name under which browsers may open the page",
    )
    parser.add_argument("--no-viewer", dest="viewer", action="store_false", help="only record")
    return parser


if __name__ == "__main__":
    run_process(work, _parser())
