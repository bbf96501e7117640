"""Attacks on the safety filter whose answers are checked by independent implementations.

An attack is a class in its own module; ``attack`` defines their interface and judges answers by a grid of actions,
``campaign`` runs them and ``linear`` holds the linear problems and their judge. Read ``attack`` first.
"""

from __future__ import annotations

import click

from safedpa_lab.experiments.record import Experiment, Parameter, integer, path, repeated, switch

EXPERIMENTS = (
    Experiment(
        name="adversary",
        help="""Attacks on the safety filter, judged by independent implementations.

    Random programs in all units, small systems under hostile nominal actions, the car against a grid of actions, whole
    drives, bad inputs, and other projects' filters on the same problems. Peers that are not installed are listed as
    missing. The report compares each count with its limit. The exit code is 0 even if a limit is exceeded.""",
        run=f"{__name__}.campaign:run",
        parameters=(
            repeated("--only", "only", "only this attack; repeatable", metavar="NAME"),
            switch("--small", "small problems: seconds instead of minutes"),
            switch("--list", "list the attacks without running them", "listed"),
            Parameter(
                "--seed",
                type=click.IntRange(0, None),
                default=0,
                show_default=True,
                help="seed of problems, states and nominal actions",
            ),
            integer("--workers", 2, "processes", least=1),
            repeated(
                "--peers", "peers", "another Python interpreter with peers installed; repeatable", metavar="PYTHON"
            ),
            path(
                "--out",
                "folder for adversary.json and adversary.md; keeps earlier attacks of the same code and seed",
                writes="folder",
                metavar="DIR",
            ),
        ),
        report=f"{__name__}.campaign:adversary_markdown",
        listing=f"{__name__}.campaign:listing",
        extras=("sim",),
        small=("--small",),
    ),
)
