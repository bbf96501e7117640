"""Margins of the shipped robots, calibrated on whole drives and evaluated on unseen ones.

``experiment`` calibrates, counts and shows the tables, ``drives`` has the drive of each robot.
"""

from __future__ import annotations

from safedpa_lab.experiments.record import Experiment, integer, number, path, repeated

EXPERIMENTS = (
    Experiment(
        name="margins",
        help="Calibrate the margins of the shipped robots on whole drives, and count what they cover on unseen ones.",
        run=f"{__name__}.experiment:run",
        parameters=(
            repeated("--robot", "robots", "name of a shipped margin; repeatable; default: all"),
            integer("--drives", 200, "calibration drives per kind of margin; may be 0 with --kind shipped"),
            integer("--fresh", 200, "unseen drives per kind of margin"),
            integer("--skip", 0, "evaluation seeds to skip"),
            repeated(
                "--kind",
                "kinds",
                "kind of margin: conformal (of a step), drive, shipped; repeatable; default: conformal, drive",
            ),
            number("--seconds", 0.0, "length of a drive; default: that of each robot", show_default=False),
            number("--coverage", 0.99, "share of steps, and of drives"),
            integer("--processes", 2),
            number("--minutes", 0.0, "start no drive after this time; run again to continue", show_default=False),
            path("--out", "folder that keeps every drive", writes="folder", required=True),
        ),
        report=f"{__name__}.experiment:margins_page",
        extras=("sim",),
        small=("--robot", "pendulum", "--kind", "shipped", "--drives", "0", "--fresh", "2"),
    ),
)
