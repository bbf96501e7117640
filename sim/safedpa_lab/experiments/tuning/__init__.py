"""Tuning of the car's networks: every method on unseen drives, in simulation and on the real car.

``experiment`` compares the rows, ``models`` makes them, ``real_car`` does the same with recordings.
"""

from __future__ import annotations

from pathlib import Path

from safedpa_lab.experiments.record import Experiment, integer, path, repeated, switch

__all__ = ["EXPERIMENTS"]

EXPERIMENTS = (
    Experiment(
        name="tuning",
        help="""Tune the car's networks in every way, and compare them on fresh drives, with loads and without.

    With --out, an interrupted run continues.""",
        run=f"{__name__}.experiment:run",
        parameters=(
            path(
                "--models",
                "folder of car_simulated and car_learned; default: the shipped ones",
                default=Path("learned/car"),
                show_default=True,
            ),
            path("--data", "folder with recordings of the real car; left out without it"),
            repeated(
                "--part",
                "parts",
                "only this part (car, real); repeatable",
                known="safedpa_lab.experiments.tuning.experiment:PARTS",
            ),
            repeated("--row", "rows", "only this row of the car's table; repeatable"),
            integer("--seed", 0, "seed of trainings and unseen drives"),
            integer("--drives", 10, "unseen drives per load"),
            switch("--small", "trainings of seconds that only show that it runs"),
            path("--out", "folder for tuning.json, tuning.md and finished trainings", writes="folder"),
        ),
        report=f"{__name__}.experiment:tuning_page",
        extras=("train",),
        small=("--small", "--drives", "2", "--row", "shipped"),
    ),
)
