"""A simulated ROS 2 car that drives through the gateway.

``experiment`` drives it, lets something fail meanwhile, and has the tables.
"""

from __future__ import annotations

from safedpa_lab.experiments.record import FILE_OUT, PAGE_OUT, Experiment, integer, number, repeated

__all__ = ["EXPERIMENTS"]

EXPERIMENTS = (
    Experiment(
        name="ros",
        help="""A simulated ROS 2 car, driven by its own policy through the gateway: collisions, sense to act, faults.

    The car uses another implementation of the protocol (zenoh-ros2-sdk). Runs in real time: keep the machine idle
    otherwise.""",
        run=f"{__name__}.experiment:run",
        parameters=(
            integer("--drives", 10, "drives with the filter, and as many without", positive=True),
            integer("--first-seed", 0, "first of the evaluation seeds"),
            number("--seconds", 10.0, "simulated time per drive", positive=True),
            repeated("--fault", "faults", "only this fault; 'none' for none; repeatable; default: all", metavar="NAME"),
            FILE_OUT,
            PAGE_OUT,
        ),
        report=f"{__name__}.experiment:page_of",
        extras=("ros", "sim"),
        small=("--drives", "1", "--seconds", "2"),
    ),
)
