"""``python -m safedpa_services.recorder``: writes every message on the bus to an MCAP file."""

from __future__ import annotations

import argparse
import os
from pathlib import Path

from safedpa.bus.messages.service_info import setup_message
from safedpa.bus.service.process import StopSignal, bus_from_options, log_lifetime, run_process
from safedpa_services.recorder.recorder import Recorder
from safedpa_services.service_main import service_parser


def work(options: argparse.Namespace, stop: StopSignal) -> int:
    """Records until ``stop``; returns 0, or 1 if the recording is incomplete."""
    with bus_from_options(options) as bus, log_lifetime("recorder", stop):
        # The control loop has priority. Only this thread is niced: the network threads, which exist already, must send
        # their keep-alive messages in time.
        os.nice(10)
        setup = setup_message("recorder", vars(options))
        return Recorder(bus, Path(options.out), setup, options.robot).run(stop)


if __name__ == "__main__":
    parser = service_parser("safedpa-recorder")
    parser.add_argument("--out", required=True, metavar="FILE.mcap")
    run_process(work, parser)
