"""The diagnosis of a simulated fleet, compared with the truth.

``diagnosis`` writes, diagnoses and judges a fleet, and asks which effects the size of the error would miss.
``object_storage`` diagnoses many small logs in a local S3-compatible store, with workers that are killed.
"""

from __future__ import annotations

from safedpa_lab.experiments.record import Experiment, integer, number, path, switch

__all__ = ["EXPERIMENTS"]

EXPERIMENTS = (
    Experiment(
        name="fleet-diagnosis",
        help="""How well the diagnosis of a fleet finds the faulty robots.

    5 % of the robots have a dragging brake, 3 % a bent steering, one stands on a slope, the rest are healthy. The
    truth is compared afterwards. With --out, an interrupted run continues.""",
        run=f"{__name__}.diagnosis:run",
        parameters=(
            integer("--robots", 60, least=5),
            integer("--seed", 0, "seed of faults, drives and noise", least=0),
            switch("--plain", "logs without disturbance, glitches, lost rows and wrong gains"),
            switch("--common", "also hide a weak air drag in all robots"),
            switch("--screen", "instead: effects that a search of robots with large errors would miss"),
            integer("--runs", 4, "per robot", least=1),
            number("--seconds", 40.0, "per run", positive=True),
            integer("--jobs", 2, "processes with one thread each", least=1),
            path("--out", "folder for recordings and pages; default: a temporary one"),
            path("--record", "also write the result to this file", writes="json", metavar="FILE.json"),
            path("--page", "also write the tables to this file", writes="markdown", metavar="FILE.md"),
        ),
        report=f"{__name__}.diagnosis:report",
        extras=("sim", "diagnosis"),
        small=("--robots", "5", "--runs", "2", "--seconds", "10"),
    ),
    Experiment(
        name="object-storage",
        help="""Diagnose many small logs in a local S3-compatible store with two Ray workers, one of which is killed.

    The command is killed after half of the robots, too, and resumed. One log in fifty is unreadable, one in fifty
    lasts --seconds, the others one second, which is read and too short for a diagnosis. Needs the packages moto,
    flask, flask-cors, py-partiql-parser and s3fs. Exit code 1 if a robot is missing, or a worker needs 500 MiB.""",
        run=f"{__name__}.object_storage:run",
        parameters=(
            integer("--logs", 10000, "robots with one log each", least=10),
            number("--seconds", 3.0, "of a long log", positive=True),
            integer("--seed", 0, "seed of the drives", least=0),
            path("--record", "also write the result to this file", writes="json", metavar="FILE.json"),
        ),
        report=f"{__name__}.object_storage:report",
        verdict=f"{__name__}.object_storage:verdict",
        extras=("sim", "diagnosis"),
        small=("--logs", "10", "--seconds", "1"),
    ),
)
