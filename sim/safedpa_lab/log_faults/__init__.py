"""Faults of logs: 41 kinds, each written into a drive whose true pairing is known, in every format it can have.

``drive`` makes the drive, ``faults`` is the matrix, ``write`` writes the files, ``judge`` compares what was read with
the truth, ``experiment`` counts. Read ``faults`` first.
"""

from __future__ import annotations

from safedpa_lab.experiments.record import FILE_OUT, PAGE_OUT, PROCESSES, Experiment, integer, repeated

__all__ = ["EXPERIMENTS"]

EXPERIMENTS = (
    Experiment(
        name="log-faults",
        help="Logs with 41 kinds of faults in five formats: rows paired wrongly, rows lost, and what was reported.",
        run=f"{__name__}.experiment:run",
        parameters=(
            integer("--seeds", 20, "drives per fault and format", positive=True),
            integer("--first-seed", 0, least=0),
            repeated(
                "--fault", "faults", "repeatable  [default: all]", known="safedpa_lab.log_faults.experiment:NAMES"
            ),
            repeated("--format", "formats", "repeatable  [default: all]", known="safedpa_lab.log_faults.faults:FORMS"),
            PROCESSES,
            FILE_OUT,
            PAGE_OUT,
        ),
        report=f"{__name__}.experiment:report",
        extras=("diagnosis", "ros"),
        small=("--seeds", "1", "--fault", "gap"),
    ),
)
