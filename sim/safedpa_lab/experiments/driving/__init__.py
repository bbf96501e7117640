"""Drives with and without the filter: safety, controllers, hidden effects, delays, and the constants of the theory.

``safety`` is the simplest: random scenes with every load, with the filter and without. Read it first.
"""

from __future__ import annotations

import click

from safedpa_lab.experiments.record import (
    FILE_OUT,
    MODEL,
    PROCESSES,
    SETTINGS,
    Experiment,
    Parameter,
    integer,
    number,
    path,
    repeated,
    scenes,
    switch,
    text,
)
from safedpa_services.command_line.names import complete_models

EXPERIMENTS = (
    Experiment(
        name="controllers",
        help="""Goals reached, collisions and computing time of the controllers.

    Random scenes with every load, behind the filter, for each controller.""",
        run=f"{__name__}.controllers:run",
        parameters=(
            repeated("--controller", "controllers", "controller; repeatable; default: all available ones"),
            *scenes(20, 200, "scenes per load", "scene"),
            MODEL,
            SETTINGS,
            path("--out", "also write the result to this JSON file, after each scene", writes="json"),
        ),
        report=f"{__name__}.controllers:report",
        extras=("sim",),
        small=("--seeds", "1", "--seconds", "1", "--controller", "goal_seeker"),
    ),
    Experiment(
        name="differential-drive",
        help="""Collisions of the differential drive in four worlds, with the filter and, every fourth time, without.

    plain; loaded: 40 % of its mass on board, on carpet; worn: wheels smaller and unlike, farther apart; slippery:
    little grip and slow motors. One policy heads straight for its goal, the other drives around obstacles.""",
        run=f"{__name__}.differential_drive:run",
        parameters=(
            integer("--drives", 50, "scenes per world and policy", positive=True),
            integer("--first-seed", 0, "first of the evaluation seeds"),
            number("--seconds", 20.0, "simulated time per drive", positive=True),
            PROCESSES,
            FILE_OUT,
        ),
        report=f"{__name__}.differential_drive:report",
        extras=("sim",),
        small=("--drives", "1", "--seconds", "1"),
    ),
    Experiment(
        name="implausible-states",
        help="""Drives of five robots whose measured state fails: jumps, restarts, freezes, drifts, turns, is lost.

    Counts contacts above 0.05 m/s, stops for the right reason in time, false stops in healthy drives with noise and
    30 % lost states, and the progress against a filter without the checks.""",
        run=f"{__name__}.implausible_states:run",
        parameters=(
            repeated("--robot", "robots", "only this robot; repeatable", known=f"{__name__}.state_faults:ROBOTS"),
            repeated(
                "--fault",
                "faults",
                "only this fault, and no healthy drives; repeatable",
                known=f"{__name__}.implausible_states:KNOWN_FAULTS",
            ),
            integer("--drives", 20, "drives per robot and fault", positive=True),
            integer("--healthy", 20, "healthy drives per robot", positive=True),
            integer("--first-seed", 0, "first of the evaluation seeds"),
            number("--seconds", 8.0, "simulated time per drive", positive=True),
            switch("--gateway", "send all messages through the ROS gateway, for robots with a ROS interface"),
            PROCESSES,
            FILE_OUT,
        ),
        report=f"{__name__}.implausible_states:report",
        extras=("sim",),
        small=("--drives", "1", "--healthy", "1", "--seconds", "2.5", "--robot", "car"),
    ),
    Experiment(
        name="false-stops",
        help="""Counts false stops of a plausible state in hours of healthy drives.

    The conditions take turns: loads, slip, wind, noise, 30 % lost states, an unknown delay of up to 0.15 s, and pauses
    of up to a second in which no process answers.""",
        run=f"{__name__}.false_stops:run",
        parameters=(
            repeated("--robot", "robots", "only this robot; repeatable", known=f"{__name__}.state_faults:ROBOTS"),
            number("--hours", 1.0, "simulated time per robot", positive=True),
            integer("--first-seed", 60_000, "first of the evaluation seeds"),
            number("--seconds", 20.0, "simulated time per drive", positive=True),
            PROCESSES,
            FILE_OUT,
        ),
        report=f"{__name__}.false_stops:report",
        extras=("sim",),
        small=("--hours", "0.001", "--seconds", "2.5", "--robot", "car"),
    ),
    Experiment(
        name="state-limits",
        help="""Measures the limits of a plausible state in healthy drives, with loads, slip, wind and noise.

    With --folder it writes one file per robot, as those that ship in safedpa/safety/named_state_limits.""",
        run=f"{__name__}.state_limits:run",
        parameters=(
            repeated("--robot", "robots", "only this robot; repeatable", known=f"{__name__}.state_faults:ROBOTS"),
            integer("--drives", 32, "drives per robot", positive=True),
            number("--seconds", 15.0, "simulated time per drive", positive=True),
            path("--folder", "also write NAME.toml into this folder", metavar="DIR"),
            PROCESSES,
            FILE_OUT,
        ),
        report=f"{__name__}.state_limits:report",
        extras=("sim",),
        small=("--drives", "1", "--seconds", "1", "--robot", "car"),
    ),
    Experiment(
        name="long-drives",
        help="""Goals and stops of the car in drives of minutes, by load.

    A car that is caught between the filter and its controller after half a minute shows only there.""",
        run=f"{__name__}.long_drives:run",
        parameters=(
            repeated(
                "--load", "loads", "load; repeatable; default: large_chair", known="safedpa_sim.robots.car.loads:LOADS"
            ),
            integer("--drives", 5, "drives per load", positive=True),
            integer("--first-seed", 0, "first of the evaluation seeds"),
            number("--seconds", 120.0, "simulated time per drive", positive=True),
            text("--controller", None, "controller; default: the first available one"),
            PROCESSES,
            FILE_OUT,
        ),
        report=f"{__name__}.long_drives:report",
        extras=("sim",),
        small=("--drives", "1", "--seconds", "1"),
    ),
    Experiment(
        name="safety",
        help="""Collisions with the filter and without.

    Random scenes with every load, each driven both ways.""",
        run=f"{__name__}.safety:run",
        parameters=(
            *scenes(100, 0, "scenes per load", "episode"),
            MODEL,
            SETTINGS,
            PROCESSES,
            FILE_OUT,
        ),
        report=f"{__name__}.safety:report",
        extras=("sim",),
        small=("--seeds", "1", "--seconds", "1"),
    ),
    Experiment(
        name="safety-pays",
        help="""What a model with the missing effect gains.

    The pymunk car with a bent linkage, a slow link or a chair that the model lacks. The filter uses the
    incomplete model, the one that the diagnosis completed, and the true one.""",
        run=f"{__name__}.safety_pays:run",
        parameters=(
            repeated(
                "--hidden",
                "hidden",
                "only this hidden effect; repeatable",
                known="safedpa_lab.experiments.driving.safety_pays:HIDDEN",
            ),
            *scenes(40, 0, "scenes per hidden effect", "episode"),
            integer("--drives", 4, "training drives given to the diagnosis", positive=True),
            number("--drive-seconds", 30.0, positive=True),
            PROCESSES,
            FILE_OUT,
        ),
        report=f"{__name__}.safety_pays:report",
        extras=("sim", "diagnosis"),
        small=("--seeds", "1", "--seconds", "1", "--drives", "2"),
    ),
    Experiment(
        name="theory",
        help="""Constants of the theoretical bound of a learned MODEL, compared with the measured error.

    Both are evaluated on unseen states of the training simulator.""",
        run=f"{__name__}.theory:run",
        parameters=(
            click.Argument(["model"], shell_complete=complete_models),
            text("--simulator", "car", "training configuration: a file or a name"),
            Parameter(
                "--states",
                type=click.IntRange(1, None),
                default=4000,
                show_default=True,
                help="states at which the constants are measured",
            ),
            Parameter("--coverage", type=click.FloatRange(0.0, 1.0, min_open=True, max_open=True), default=0.99),
            Parameter("--seed", type=click.IntRange(0, None), default=0, show_default=True),
            FILE_OUT,
        ),
        report=f"{__name__}.theory:report",
        extras=("train",),
        small=("--states", "2000"),
    ),
)
