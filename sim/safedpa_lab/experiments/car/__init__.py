"""The car of the paper: success and safety of every method, prediction errors, latents, margins, and sweeps.

``experiment`` runs the table, ``curves`` the sweeps. ``methods`` lists what is compared, ``episodes`` drives one
episode, ``report`` and ``figures`` show the result. Read ``experiment`` first.
"""

from __future__ import annotations

from safedpa_lab.experiments.record import SETTINGS, Experiment, integer, path, repeated, text

_POLICIES = (
    path("--models", "folder of the learned models; default: learned/car or learned/car_paper, by family"),
    text(
        "--family",
        "best",
        "policies: best, with all of our improvements; paper, trained and calibrated without loads or filter",
    ),
)
EXPERIMENTS = (
    Experiment(
        name="car",
        help="""SafeDPA and its ablations on the car.

    Success and safety in four configurations, with each filter's own margin and with SafeDPA's for all, and whether
    SafeDPA differs from each other method; prediction errors with and without tuning, latents, margins. Methods
    without models are left out and listed. For the family best, models missing in --models are taken from the shipped
    ones. With --out, an interrupted run continues.""",
        run=f"{__name__}.experiment:run",
        parameters=(
            *_POLICIES,
            integer("--episodes", 100, "per method and configuration"),
            integer("--first-seed", 0, "seed of the first scene"),
            repeated("--method", "methods", "only this method; repeatable"),
            repeated("--load", "loads", "only this configuration (none, box, ...); repeatable"),
            repeated("--part", "parts", "only this part (table, errors, latent, equal-margin); repeatable"),
            integer(
                "--equal-margin-episodes",
                50,
                "per filter and configuration, in the table with SafeDPA's margin for all; at most --episodes",
            ),
            text(
                "--margin",
                "conformal",
                "of every filter: conformal or theorem (each model's own, 99 %), or one number in m for all",
            ),
            SETTINGS,
            integer("--drives", 6, "recorded drives per kind and load"),
            integer("--drive-ticks", 400, "length of a recorded drive, in periods of 0.05 s"),
            integer("--processes", 2),
            path("--out", "folder for tables, JSON, figures and finished cells", writes="folder"),
        ),
        report=f"{__name__}.report:markdown_of",
        figures=f"{__name__}.figures:write_figures",
        extras=("train",),
        small=("--episodes", "1", "--part", "table", "--load", "none"),
    ),
    Experiment(
        name="car-curves",
        help="""The car made harder one thing at a time, until each method breaks.

    Narrower passages, heavier loads, a load hitched or released while driving, speed, grip, noise, delay. Reports
    success and safety of each method at each value, on the same scenes, and whether SafeDPA differs from the others.
    Margins are calibrated once, as in 'experiment car'. With --out, an interrupted run continues.""",
        run=f"{__name__}.curves:run",
        parameters=(
            *_POLICIES,
            repeated(
                "--sweep",
                "sweeps",
                "only this one (passage, row, load, towing, speed, friction, noise, delay, delay_untold); repeatable",
            ),
            repeated("--method", "methods", "only this method; repeatable; default: four"),
            integer("--episodes", 100, "per method and value"),
            integer("--first-seed", 1000, "seed of the first scene"),
            integer("--drives", 6, "recorded drives per load that calibrate the margins"),
            integer("--processes", 2),
            path("--out", "folder for tables, JSON, figure and finished episodes", writes="folder"),
        ),
        report=f"{__name__}.report:curves_markdown",
        figures=f"{__name__}.figures:write_figure",
        extras=("train",),
        small=("--episodes", "1", "--drives", "1", "--sweep", "friction", "--method", "safedpa"),
    ),
)
