"""``python -m safedpa_services.dashboard``: shows a fleet live in the browser and keeps it as a Rerun recording."""

from __future__ import annotations

import argparse
import os
import sys
import uuid
from pathlib import Path

from safedpa.bus import NO_ROBOT
from safedpa.bus.service.process import StopSignal, bus_from_options, run_process
from safedpa.dynamics import load_model
from safedpa.errors import InputError
from safedpa.extras import need
from safedpa.robot import DEFAULT_ROBOT
from safedpa.safety.defaults import settings_named
from safedpa_services.dashboard.dashboard import Dashboard
from safedpa_services.dashboard.fleet_view import FleetView
from safedpa_services.dashboard.http_proxy import (
    FIRST_OF_ITS_OWN,
    DataProxy,
    ViewerServer,
    choose_port,
    open_server,
    private_loopback,
)
from safedpa_services.dashboard.look import display_settings
from safedpa_services.serving import service_parser

_DRIVE_ENDED = "The drive has ended, and this dashboard with it: what is shown is the last of it."
_DASHBOARD_ENDED = "This dashboard was ended: what is shown is the last that it heard; the robots do not need it."


def work(options: argparse.Namespace, stop: StopSignal) -> int:
    """Shows until ``stop``; returns exit code 0."""
    os.nice(10)  # the loop comes first; what arrives meanwhile waits, and is thinned out when it waits for long
    os.environ.setdefault("RUST_LOG", "error")
    need("view", what="the dashboard")
    if not options.viewer and not options.save:
        raise InputError("--no-viewer: got no --save either; name a file to record to, or leave --no-viewer out")
    settings = settings_named(options.settings)
    look = display_settings(load_model(options.model), settings)
    from safedpa_services.dashboard.painter import RerunRecording

    grpc_port = choose_port(options.grpc_port, 9876, "--grpc-port", options.bind) if options.viewer else None
    save = Path(options.save) if options.save else None
    behind = private_loopback()
    data_port = choose_port(None, FIRST_OF_ITS_OWN, "--grpc-port", behind) if options.viewer else None
    painter = RerunRecording(look, options.fleet, save=save, bind=behind, grpc_port=data_port)
    if grpc_port is not None and data_port is not None:
        own = (behind, data_port)
        grpc_port = open_server(
            lambda port: DataProxy(options.bind, port, own, options.name),
            grpc_port,
            required=options.grpc_port is not None,
        )
    address = "" if grpc_port is None else _open_door(options, grpc_port)
    sys.stdout.write(f"dashboard: {address or 'no viewer'}{f', recording {save}' if save else ''}\n")
    sys.stdout.flush()
    with bus_from_options(options) as bus:
        bus.announce(NO_ROBOT, "dashboard", uuid.uuid4().hex[:12])
        dashboard = Dashboard(bus, FleetView(look, options.fleet), painter, options.robot, address)
        dashboard.run(stop)
        dashboard.end(_DRIVE_ENDED if options.supervised else _DASHBOARD_ENDED)
    painter.close()
    return 0


def _open_door(options: argparse.Namespace, grpc_port: int) -> str:
    first = choose_port(options.web_port, 9090, "--web-port", options.bind)
    required = options.web_port is not None
    port = open_server(lambda port: ViewerServer(options.bind, port, grpc_port, options.name), first, required=required)
    host = "localhost" if options.bind in ("127.0.0.1", "0.0.0.0", "::", "::1") else options.bind
    return f"http://{host}:{port}"


def _parser() -> argparse.ArgumentParser:
    parser = service_parser("safedpa-dashboard")
    parser.add_argument(
        "--settings", default=DEFAULT_ROBOT, metavar="FILE.toml", help="settings of the filter: a file or a name"
    )
    parser.add_argument("--save", default="", metavar="FILE.rrd", help="keep a recording")
    parser.add_argument("--web-port", type=int, default=None, help="port to open in the browser; default 9090 or next")
    parser.add_argument("--grpc-port", type=int, default=None, help="port of the data; default 9876 or the next free")
    parser.add_argument("--bind", default="127.0.0.1", help="0.0.0.0 to look from other machines")
    parser.add_argument("--name", action="append", default=[], metavar="HOST", help="name by which browsers come")
    parser.add_argument("--no-viewer", dest="viewer", action="store_false", help="record only")
    return parser


if __name__ == "__main__":
    run_process(work, _parser())
