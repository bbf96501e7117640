"""``python -m safedpa_services.workbench`` serves the live page next to a running loop; the supervisor starts it."""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

import click

from safedpa.bus.service.process import StopSignal, bus_from_options, run_process
from safedpa.extras import need
from safedpa_services.service_main import service_parser


def work(options: argparse.Namespace, stop: StopSignal) -> int:
    """Serves the page until ``stop`` is set; returns exit code 0."""
    os.nice(10)  # the control loop has priority
    need("workbench", what="the workbench", alone=True)  # its container writes no reports and lacks their libraries
    from safedpa_services.web.page_options import PageServerOptions
    from safedpa_services.workbench.server import serve
    from safedpa_services.workbench.session.controller import SessionController
    from safedpa_services.workbench.session.inputs import InputSelection

    with bus_from_options(options) as bus:
        controller = SessionController(InputSelection(options.model), Path(options.out))
        # Its output goes to a log, and the address has the token that opens the page: the supervisor shows it.
        serve(controller, PageServerOptions.of(vars(options)), browser=False, bus=bus, stop=stop, announce=_announce)
    return 0


def _announce(where: str) -> None:
    if sys.stdout.isatty():
        click.echo(f"Workbench: {where}  (Ctrl-C ends it)")
    else:
        click.echo(f"Workbench: {where.partition('?')[0]}  (the token of its address is shown on a terminal only)")


def _parser() -> argparse.ArgumentParser:
    parser = service_parser("safedpa-workbench")
    parser.add_argument("--out", default="workbench", metavar="DIR", help="folder for saved models")
    parser.add_argument(
        "--host",
        default="127.0.0.1",
        help="address to serve on; 0.0.0.0 lets other machines in and needs a password or TLS",
    )
    parser.add_argument("--name", action="append", default=[], metavar="HOST", help="host name that browsers use")
    parser.add_argument(
        "--folder", action="append", default=[], type=Path, metavar="DIR", help="recordings below it may be opened"
    )
    parser.add_argument("--tls-certificate", type=Path, metavar="FILE.pem", help="serve over TLS")
    parser.add_argument("--tls-key", type=Path, metavar="FILE.pem", help="private key of the certificate")
    parser.add_argument(
        "--token-only", action="store_true", help="accept the token alone: the port is mapped to a loopback interface"
    )
    parser.add_argument("--port", type=int, default=None, help="default: 8080 or the next free one")
    return parser


if __name__ == "__main__":
    run_process(work, _parser())
