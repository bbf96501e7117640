"""The paper's inverted pendulum in the wind, and a pendulum with hidden effects.

``experiment`` compares the methods, ``story`` diagnoses and corrects a model. Read ``experiment`` first.
"""

from __future__ import annotations

from pathlib import Path

import click

from safedpa_lab.experiments.record import (
    FOLDER_OUT,
    PROCESSES,
    Experiment,
    Parameter,
    integer,
    number,
    path,
    repeated,
    switch,
)

__all__ = ["EXPERIMENTS"]

EXPERIMENTS = (
    Experiment(
        name="pendulum",
        help="""SafeDPA and its baselines on the inverted pendulum in the wind.

    First task: random torques through the filter, within 45 degrees. Second: swing up the long way round, past a
    hazard. Every wind direction is tested with each filter's own margin, and with SafeDPA's. Then both tasks are made
    harder by wind, torque bound, edges and noise. Calibration, tuning of RMA-P and evaluation use different seeds.""",
        run=f"{__name__}.experiment:run",
        parameters=(
            path(
                "--models",
                "folder of the learned models; missing ones are taken from the shipped models",
                default=Path("learned/pendulum"),
                show_default=True,
            ),
            integer("--directions", 48, "wind directions, evenly spaced"),
            integer("--episodes", 5, "per method and direction"),
            integer("--sweep-episodes", 1, "per method, direction and value of a sweep; 0: no sweeps"),
            integer("--drives", 120, "calibration drives per task and round"),
            integer("--seed", 0, "evaluation seed; below 100: for development"),
            integer("--processes", 1),
            FOLDER_OUT,
        ),
        report=f"{__name__}.report:markdown_of",
        figures=f"{__name__}.figures:write_figures",
        document=f"{__name__}.report:without_points",
        extras=("train",),
        small=("--directions", "4", "--episodes", "1", "--sweep-episodes", "0", "--drives", "50"),
    ),
    Experiment(
        name="pendulum-story",
        help="""A pendulum with half a kilogram more, or with dry friction, which the model does not have.

    Swings are recorded and diagnosed, and the effects found are added. Then the filter keeps the pendulum within 45
    degrees with the shipped, the corrected and the true model, each with a margin calibrated to its errors.""",
        run=f"{__name__}.story:run",
        parameters=(
            repeated(
                "--hidden",
                "hidden",
                "only this one: payload, 'dry friction' or both; repeatable",
                known="safedpa_lab.experiments.pendulum.story:HIDDEN",
            ),
            integer("--directions", 12, "wind directions, evenly spaced", positive=True),
            integer("--episodes", 2, "per model and direction", positive=True),
            number("--seconds", 3.0, "per episode", positive=True),
            integer("--seed", 0),
            switch("--learned", "also the learned model, with and without the effects found: slow"),
            Parameter(
                "--data",
                type=click.Path(path_type=Path, exists=True, file_okay=False),
                help="logs of the DFKI pendulum: also identify payloads of a pendulum fitted to them",
            ),
            PROCESSES,
            FOLDER_OUT,
        ),
        report=f"{__name__}.story:story_markdown",
        figures=f"{__name__}.story:write_figure",
        extras=("train",),
        small=("--hidden", "payload", "--directions", "1", "--episodes", "1", "--seconds", "1"),
    ),
)
