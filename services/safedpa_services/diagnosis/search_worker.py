"""``python -m safedpa_services.diagnosis.search_worker FOLDER``: runs one search or calibration.

The process ends when its standard input closes, that is, when the service ends for whatever reason. It has the
service's priority, and pauses for a second on SIGURG.
"""

from __future__ import annotations

import argparse
import os
import resource
import shutil
import signal
import sys
import threading
import time
from pathlib import Path

from safedpa.adaptation import HistoryEstimator, LatentEstimator
from safedpa.calibration.from_runs import live_margin
from safedpa.dynamics import LearnedBase, PhysicsModel
from safedpa.live.search_jobs import Calibrate, WorkOutcome, execute_job
from safedpa.records.run import Run
from safedpa.safety.defaults import settings_named
from safedpa.systems.robots import DEFAULT_ROBOT
from safedpa_services.diagnosis.work_files import CPU_SECONDS, PAUSE_SECONDS, PAUSE_SIGNAL, read_work, write_outcome


def calibrate_with(settings: str) -> Calibrate:
    """Returns a calibration for the filter's settings (a file or a name).

    It estimates the latent along the run, in the same way as the adaptation.
    """

    def calibrate(model: PhysicsModel, run: Run, footprint: tuple[float, ...]) -> str:
        learned = isinstance(model.base, LearnedBase) and model.base.weights.has("phi")
        estimator = HistoryEstimator if learned else LatentEstimator
        along = (lambda: estimator(model)) if model.latent_names else None
        return live_margin(model, settings_named(settings), run, footprint, along)

    return calibrate


def main() -> None:
    """Reads the job, runs it and writes the result."""
    parser = argparse.ArgumentParser(prog="safedpa-diagnosis-worker")
    parser.add_argument("folder", type=Path)
    parser.add_argument("--settings", default=DEFAULT_ROBOT)
    options = parser.parse_args()
    resource.setrlimit(resource.RLIMIT_CPU, (CPU_SECONDS, CPU_SECONDS + 1))
    signal.signal(PAUSE_SIGNAL, lambda *_: time.sleep(PAUSE_SECONDS))
    writing = threading.Lock()
    threading.Thread(target=_watch_service, args=(options.folder, writing), daemon=True).start()
    try:
        outcome = execute_job(read_work(options.folder), calibrate_with(options.settings))
    except Exception as error:  # noqa: BLE001 - the service reports any failure
        outcome = WorkOutcome(failure=f"{type(error).__name__}: {' '.join(str(error).split())}")
    with writing:
        write_outcome(outcome, options.folder)


def _watch_service(folder: Path, writing: threading.Lock) -> None:
    """Waits for the end of the service, then removes the job's folder and ends this process."""
    while os.read(sys.stdin.fileno(), 4096):
        continue
    writing.acquire()  # never released: no result is written into a removed folder
    shutil.rmtree(folder, ignore_errors=True)
    os._exit(1)


if __name__ == "__main__":
    main()
