"""Experiments with the diagnosis: hidden effects, real logs, long logs, changes while driving, bad data.

``hidden_effects`` counts how often hidden effects are named, ``real_logs`` diagnoses recordings of real robots,
``live`` changes the car while it drives. Read ``hidden_effects`` first.
"""

from __future__ import annotations

from pathlib import Path

import click

from safedpa_lab.experiments.record import (
    FILE_OUT,
    PAGE_OUT,
    PROCESSES,
    Experiment,
    Parameter,
    integer,
    number,
    path,
    repeated,
    switch,
)
from safedpa_services.command_line.names import SuggestingChoice

__all__ = ["EXPERIMENTS"]

_SUITES = (
    "ordinary", "fifth", "two", "three", "hard", "none", "none_hard", "pendulum", "towing", "patches", "sags",
    "speed_gains", "bad", "wheels", "wheels_none", "one_log", "all",
)  # fmt: skip
"""Of hidden effects; the list of all experiments is read without the optional packages that a suite needs."""
_OWN_SUITES = ("own_one", "own_two", "own_none", "own_outside")
_REAL = ("car", "pendulum", "balls", "others")

EXPERIMENTS = (
    Experiment(
        name="bad-data",
        help="""Spoil a good LOG of a car (CSV, native columns) in twenty ways.

    Frozen sensors, dead commands, wrong signs, late channels, other units, decimal commas and more. Prints for each
    file the message that compare and diagnose have to give.""",
        run=f"{__name__}.bad_data:run",
        parameters=(
            click.Argument(["log"], type=click.Path(path_type=Path)),
            path("--out", "folder for the files", metavar="DIR", required=True),
        ),
        report=f"{__name__}.bad_data:report",
        extras=("diagnosis",),
    ),
    Experiment(
        name="data-faults",
        help="""Which of sixteen faults of the data of robots that do not ship are noticed.

    Signs, clocks, offsets, units, frozen and stale channels are planted into logs of five robots. Counts which are
    noticed with channel, time and size, which are diagnosed as physics, and the findings in good logs of ten robots:
    plain, with effects, braked, at an end stop, with an overflowing tank.""",
        run=f"{__name__}.data_faults:run",
        parameters=(
            integer("--seeds", 1, "logs per fault and robot", positive=True),
            integer("--good", 2, "logs per robot and kind of good log", least=0),
            integer("--first-seed", 0, least=0),
            repeated("--fault", "faults", "repeatable; default: all", known=f"{__name__}.data_faults:FAULTS"),
            repeated("--robot", "robots", "repeatable; default: five", known=f"{__name__}.data_faults:PLANTS"),
            switch("--diagnose", "also diagnose the faulty logs"),
            PROCESSES,
            FILE_OUT,
            PAGE_OUT,
        ),
        report=f"{__name__}.data_faults:report",
        extras=("sim", "diagnosis"),
        small=("--fault", "pose_frozen", "--robot", "own_conveyor", "--good", "0"),
    ),
    Experiment(
        name="demo",
        help="""'safedpa demo --yes' in many scenes, in real time, each with processes of its own.

    Counts in how many scenes a finding is raised, its effect is accepted, the error falls by at least 60 %, the car
    drives at least 5 m in the following 20 s, and never stands for more than 10 s without a message about it.""",
        run=f"{__name__}.demo:run",
        parameters=(
            Parameter(
                "--seed", type=click.IntRange(0, None), default=1, show_default=True, help="seed of the first scene"
            ),
            Parameter("--drives", type=click.IntRange(1, None), default=20, show_default=True, help="number of scenes"),
            Parameter(
                "--parallel",
                type=click.IntRange(1, 8),
                default=1,
                show_default=True,
                help="parallel drives, half a core each",
            ),
            Parameter(
                "--busy",
                type=click.IntRange(0, None),
                default=0,
                show_default=True,
                help="further processes that only compute, at normal priority",
            ),
            switch("--click", "accept by one click on the page in a headless Chromium, instead of --yes"),
            FILE_OUT,
            path("--recordings", None, default=Path("runs"), show_default=True, metavar="DIR"),
        ),
        report=f"{__name__}.demo:report",
        extras=("sim",),
        small=("--drives", "1"),
    ),
    Experiment(
        name="diagnosis-pictures",
        help="""Draw the figures that explain how to read a diagnosis.

    missing: a real pendulum and its candidates. undecided: what twelve seconds of a real car's drive could show.
    rehearse: effects hidden in the pendulum's own commands. condition: a simulated carpet and where it was found.""",
        run=f"{__name__}.pictures:run",
        parameters=(
            path("--data", "folder with the recordings: see docs/evidence/diagnosis.md", metavar="DIR", required=True),
            repeated(
                "--picture",
                "names",
                "default: all",
                type=click.Choice(("missing", "undecided", "rehearse", "condition")),
            ),
            path("--out", "an existing folder", metavar="DIR", required=True),
        ),
        report=f"{__name__}.pictures:report",
    ),
    Experiment(
        name="hidden-effects",
        help="""How often the diagnosis names a hidden effect.

    The logs come from simulators that share no code with the fitted models; the truth is compared afterwards.
    ordinary, fifth: each car effect in turn, at ordinary strength and at a fifth of it. two, three: so many.
    hard: coloured disturbance, three times the noise, lost rows, tracking glitches, servo gain 10 % off. none,
    none_hard: nothing hidden. pendulum: each of its effects. towing: the pymunk car with a chair hitched. patches,
    sags, speed_gains: an effect acts in one place only, or its parameter falls with time, or with speed. bad: nothing
    hidden, but one of three runs is corrupted in one of twenty ways. wheels, wheels_none: each effect of a differential
    drive in turn, and nothing hidden in one.

    With --horizons, each case is diagnosed for five horizons in one process, and only their agreement is reported.

    With the same --out, an interrupted run of the same command and code continues.""",
        run=f"{__name__}.hidden_effects:run",
        parameters=(
            integer("--cases", 48, "per suite", least=1),
            integer("--seed", 0, "seed of strengths, drives and noise", least=0),
            repeated("--suite", "suites", "repeatable; default: all", type=SuggestingChoice(_SUITES)),
            integer("--processes", 2, "with one thread each", least=1),
            path(
                "--out",
                "also write every case to this JSON file; cases that it holds are not repeated",
                writes="record",
            ),
            path("--page", "also write the tables to this Markdown file", writes="markdown"),
            switch("--horizons", "only compare verdict and names for horizons of 0.2 to 1 s"),
        ),
        report=f"{__name__}.hidden_effects:report",
        extras=("sim", "diagnosis"),
        small=("--cases", "1", "--suite", "ordinary"),
    ),
    Experiment(
        name="live",
        help="""Diagnosis next to a driving car, in lockstep.

    The car drives behind the safety filter with a model of the car alone. hitch: a chair is hitched. headwind: a steady
    wind begins. steering_offset: the linkage is bent. The diagnosis raises a finding and names the effect. The first
    effect that unseen data confirm is accepted automatically; the error before and after is reported. nothing: nothing
    changes, and nothing may be found.""",
        run=f"{__name__}.live:run",
        parameters=(
            Parameter(
                "--case",
                type=SuggestingChoice(("hitch", "headwind", "steering_offset", "nothing", "all")),
                default="all",
                show_default=True,
                help="the change",
            ),
            integer("--seed", 1, "seed of the first scene", least=0),
            integer("--drives", 10, "scenes per case with a change", positive=True),
            number("--after", 30.0, "s of driving before the change, at least 25"),
            number("--hours", 1.0, "total driving time without a change", positive=True),
            integer("--quiet-drives", 1, "scenes over which --hours are distributed", positive=True),
            integer("--processes", 1, positive=True),
            path("--record", "record one drive instead", writes="record", metavar="FILE.mcap"),
            FILE_OUT,
        ),
        report=f"{__name__}.live:report",
        extras=("sim",),
        small=("--case", "hitch", "--drives", "1", "--after", "25"),
    ),
    Experiment(
        name="long-logs",
        help="""Time and memory of a diagnosis of hours of logs.

    Writes logs of a car with air drag that the given model lacks into a temporary folder, and runs `safedpa diagnose`
    and `safedpa compare` on them as separate processes. Reports their time and peak memory.""",
        run=f"{__name__}.long_logs:run",
        parameters=(
            integer("--runs", 10, positive=True),
            number("--seconds", 3600.0, "per run", positive=True),
            number("--period", 0.01, "seconds between rows", positive=True),
            repeated(
                "--kind",
                "kinds",
                "of file; repeatable; default: csv",
                type=SuggestingChoice(("csv", "parquet", "mcap")),
            ),
            integer("--seed", 0, "seed of drives and noise"),
            FILE_OUT,
        ),
        report=f"{__name__}.long_logs:report",
        extras=("sim", "diagnosis"),
    ),
    Experiment(
        name="own-robots",
        help="""How often the diagnosis is right about robots that do not ship.

    Ten robots with models as a user writes them: servo, joint, tank, boat, omnidirectional base, crane, motor,
    quadrotor, bicycle with slip, conveyor. Their commands change between the rows of the log; every second round of
    robots has one log, the others three. own_one, own_two: so many hidden effects. own_none: nothing hidden.
    own_outside: an effect that no library has, which has to be reported as unexplained.

    With the same --out, an interrupted run of the same command and code continues.""",
        run=f"{__name__}.own_robots:run",
        parameters=(
            integer("--cases", 20, "per suite", least=1),
            integer("--seed", 0, "seed of strengths, drives and noise", least=0),
            repeated("--suite", "suites", "repeatable; default: all", type=SuggestingChoice(_OWN_SUITES)),
            integer("--processes", 2, "with one thread each", least=1),
            path(
                "--out",
                "also write every case to this JSON file; cases that it holds are not repeated",
                writes="record",
            ),
        ),
        report=f"{__name__}.own_robots:report",
        extras=("sim", "diagnosis"),
        small=("--cases", "1", "--suite", "own_none"),
    ),
    Experiment(
        name="real-logs",
        help="""What the diagnosis finds in recordings of real robots.

    A 1:10 car (four drives), a torque-limited pendulum (six logs), balls dropped from a bridge, and others whose
    models lie next to their logs: a servo, a joint of an arm, cascaded tanks. The car is also
    diagnosed on each three of its logs and evaluated on the fourth, which neither the search nor the fit used. The
    model of all four is evaluated on drives of another day, if the folder has them. ``outside`` is the share of rows
    of the evaluation log at a speed and throttle for which the other logs hold less than a second of driving.""",
        run=f"{__name__}.real_logs:run",
        parameters=(
            path("--data", "folder with the recordings: see docs/evidence/diagnosis.md", metavar="DIR", required=True),
            Parameter(
                "--part",
                type=SuggestingChoice(("car", "pendulum", "balls", "others", "all")),
                default="all",
                show_default=True,
            ),
            path("--ball", "defines the falling ball; see docs/guides/own-system.md", metavar="FILE.py"),
            PROCESSES,
            FILE_OUT,
        ),
        report=f"{__name__}.real_logs:report",
        extras=("diagnosis",),
        small=("--part", "balls"),
    ),
)
