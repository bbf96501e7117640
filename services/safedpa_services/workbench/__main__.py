"""``python -m safedpa_services.workbench``: the live page next to a running loop, as the supervisor starts it."""

from __future__ import annotations

import argparse
import os
from pathlib import Path

from safedpa.bus.service.process import StopSignal, bus_from_options, run_process
from safedpa.extras import need
from safedpa_services.serving import service_parser


def work(options: argparse.Namespace, stop: StopSignal) -> int:
    """Serves until ``stop``; returns exit code 0."""
    os.nice(10)  # the loop comes first
    need("workbench", what="the workbench", alone=True)  # its container writes no reports
    from safedpa_services.workbench.bench import Bench
    from safedpa_services.workbench.page_address import PageServerOptions
    from safedpa_services.workbench.recordings import InputSelection
    from safedpa_services.workbench.server import chosen_port, serve

    serving = PageServerOptions(
        options.host,
        chosen_port(options.host, options.port),
        tuple(options.name),
        tuple(options.folder),
        options.tls_certificate,
        options.tls_key,
        options.token_only,
    )
    with bus_from_options(options) as bus:
        serve(Bench(InputSelection(options.model), Path(options.out)), serving, browser=False, bus=bus, stop=stop)
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = service_parser("safedpa-workbench")
    parser.add_argument("--out", default="workbench", metavar="DIR", help="folder for saved models")
    parser.add_argument("--host", default="127.0.0.1", help="0.0.0.0 for other machines; needs a password or TLS")
    parser.add_argument("--name", action="append", default=[], metavar="HOST", help="name by which browsers come")
    parser.add_argument("--folder", action="append", default=[], type=Path, metavar="DIR", help="holds recordings")
    parser.add_argument("--tls-certificate", type=Path, metavar="FILE.pem", help="serve over TLS")
    parser.add_argument("--tls-key", type=Path, metavar="FILE.pem", help="of the certificate")
    parser.add_argument("--token-only", action="store_true", help="the port is mapped to a loopback interface")
    parser.add_argument("--port", type=int, default=None, help="default: 8080 or the next free one")
    return parser


if __name__ == "__main__":
    run_process(work, _parser())
