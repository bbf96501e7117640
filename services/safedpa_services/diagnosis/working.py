"""``python -m safedpa_services.diagnosis.working FOLDER``: carries out one work at the lowest priority there is.

It ends when its standard input closes: with the service, however that ended.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import shutil
import sys
import threading
from pathlib import Path

from safedpa.adaptation import HistoryEstimator, LatentEstimator
from safedpa.calibration.from_runs import live_margin
from safedpa.dynamics import LearnedBase, PhysicsModel
from safedpa.live.work import Calibrate, WorkOutcome, execute_job
from safedpa.records.run import Run
from safedpa.robot import DEFAULT_ROBOT
from safedpa.safety.defaults import settings_named
from safedpa_services.diagnosis.work_files import read_work, write_outcome

__all__ = ["calibrate_with", "main"]


def calibrate_with(settings: str) -> Calibrate:
    """Calibration for the filter's settings (a file or a name), the latent estimated along as the adaptation does."""

    def calibrate(model: PhysicsModel, run: Run, footprint: tuple[float, ...]) -> str:
        learned = isinstance(model.base, LearnedBase) and model.base.weights.has("phi")
        estimator = HistoryEstimator if learned else LatentEstimator
        along = (lambda: estimator(model)) if model.latent_names else None
        return live_margin(model, settings_named(settings), run, footprint, along)

    return calibrate


_LARGEST_NICENESS = 19


def main() -> None:
    """Reads the work, does it, writes the outcome."""
    parser = argparse.ArgumentParser(prog="safedpa-diagnosis-working")
    parser.add_argument("folder", type=Path)
    parser.add_argument("--settings", default=DEFAULT_ROBOT)
    options = parser.parse_args()
    _yield_to_everyone()
    writing = threading.Lock()
    threading.Thread(target=_watch_service, args=(options.folder, writing), daemon=True).start()
    try:
        outcome = execute_job(read_work(options.folder), calibrate_with(options.settings))
    except Exception as error:  # noqa: BLE001 - whatever the numbers brought about, the service is to hear of it
        outcome = WorkOutcome(failure=f"{type(error).__name__}: {' '.join(str(error).split())}")
    with writing:
        write_outcome(outcome, options.folder)


def _yield_to_everyone() -> None:
    os.nice(_LARGEST_NICENESS)
    with contextlib.suppress(OSError, AttributeError):  # other systems have no such class
        os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))


def _watch_service(folder: Path, writing: threading.Lock) -> None:
    """Ends with the service, and takes away what that cannot take away any more."""
    while os.read(sys.stdin.fileno(), 4096):
        continue
    writing.acquire()  # for good: nothing is written any more
    shutil.rmtree(folder, ignore_errors=True)
    os._exit(1)


if __name__ == "__main__":
    main()
