"""Drives with a laser as the only sensor: among people, several cars, harder conditions, and margins of perception.

``experiment`` drives the scenes of ``scenes`` behind every guard. Read it first.
"""

from __future__ import annotations

from pathlib import Path

import click

from safedpa_lab.experiments.record import (
    FILE_OUT,
    PAGE_OUT,
    PROCESSES,
    RECORD,
    Experiment,
    integer,
    number,
    path,
    repeated,
    scenes,
    switch,
    text,
)

EXPERIMENTS = (
    Experiment(
        name="meeting",
        help="Several cars that see each other by their lasers: collisions while moving, and goals reached.",
        run=f"{__name__}.meeting:run",
        parameters=(
            repeated("--robots", "robots", "number of cars, 2 to 8; repeatable  [default: 2, 4, 8]", type=int),
            *scenes(5, 1000, "drives per number of cars", "drive"),
            number("--fastest", 2.0, "assumed speed of moving and hidden objects [m/s]"),
            repeated(
                "--guard",
                "guards",
                "safedpa, reported or nothing; repeatable  [default: all]",
                known="safedpa_lab.experiments.sensing.meeting:GUARDS",
            ),
            repeated(
                "--load",
                "loads",
                "what every car tows; repeatable  [none]",
                known="safedpa_lab.experiments.sensing.experiment:LOADS",
            ),
            PROCESSES,
            FILE_OUT,
            PAGE_OUT,
        ),
        report=f"{__name__}.meeting:page_of",
        extras=("sim",),
        small=("--robots", "2", "--seeds", "1", "--seconds", "1"),
    ),
    Experiment(
        name="sensing",
        help="Drives with a laser as the only sensor: among pillars and people, through doors, past a hidden person.",
        run=f"{__name__}.experiment:run",
        parameters=(
            *scenes(8, 1000, "drives per kind of scene", "drive", 30.0),
            number("--coming", 1.5, "assumed speed of hidden people [m/s]"),
            integer("--people", 3, "number of people in the scene 'people'", least=0),
            text(
                "--source",
                "laser",
                "the only kind of sensor of filter and controller",
                known="safedpa_sim.sensing.other_sources:KNOWN_SOURCES",
            ),
            switch(
                "--peers/--no-peers",
                "also drive with other projects' collision monitors, and without any",
                default=True,
            ),
            switch(
                "--perfect-knowledge/--no-perfect-knowledge",
                "also drive with perfect knowledge, for comparison",
                default=True,
            ),
            switch("--hiding/--no-hiding", "also drive with perfect knowledge of all visible objects", default=False),
            repeated(
                "--scene",
                "scenes",
                "kind of scene; repeatable  [default: all]",
                known="safedpa_lab.experiments.sensing.experiment:SCENES",
            ),
            repeated(
                "--load",
                "loads",
                "what is towed; repeatable, each with every seed  [none]",
                known="safedpa_lab.experiments.sensing.experiment:LOADS",
            ),
            text(
                "--policy",
                "way_seeker",
                "the controller; goal_seeker ignores the sensors",
                known="safedpa_lab.experiments.sensing.experiment:POLICIES",
            ),
            PROCESSES,
            RECORD,
            FILE_OUT,
            PAGE_OUT,
        ),
        report=f"{__name__}.experiment:page_of",
        extras=("sim",),
        small=("--seeds", "1", "--seconds", "1", "--scene", "pillars"),
    ),
    Experiment(
        name="sensing-robots",
        help="Other robots with a laser as the only sensor, among people: a differential drive, a drone, one's own.",
        run=f"{__name__}.planar:run",
        parameters=(
            *scenes(8, 1000, "drives per robot", "drive", 20.0),
            integer("--people", 3, "number of people"),
            repeated(
                "--robot",
                "robots",
                "kind of robot; repeatable  [default: all]",
                known="safedpa_lab.experiments.sensing.planar:ROBOTS",
            ),
            repeated(
                "--source",
                "sources",
                "the only kind of sensor; repeatable  [laser]",
                known="safedpa_sim.sensing.other_sources:KNOWN_SOURCES",
            ),
            repeated(
                "--monitor",
                "monitors",
                "parameters of Nav2's collision monitor (YAML): drive with their zones, too; repeatable",
                type=click.Path(path_type=Path, exists=True, dir_okay=False),
            ),
            PROCESSES,
            RECORD,
            FILE_OUT,
            PAGE_OUT,
        ),
        report=f"{__name__}.planar:page_of",
        extras=("sim",),
        small=("--seeds", "1", "--seconds", "1", "--robot", "differential_drive"),
    ),
    Experiment(
        name="sensing-losses",
        help="Where a car with a laser loses goals among people: one assumption of perception removed at a time.",
        run=f"{__name__}.losses:run",
        parameters=(
            *scenes(8, 1000, "drives per change and load", "drive", 30.0),
            integer("--people", 3, "number of people", least=0),
            repeated(
                "--load",
                "loads",
                "what is towed; repeatable, each with every seed  [none]",
                known="safedpa_lab.experiments.sensing.experiment:LOADS",
            ),
            PROCESSES,
            RECORD,
            FILE_OUT,
            PAGE_OUT,
        ),
        report=f"{__name__}.losses:page_of",
        extras=("sim",),
        small=("--seeds", "1", "--seconds", "1"),
    ),
    Experiment(
        name="sensing-curves",
        help="A laser among people, made harder: faster people, noisier, older and narrower scans.",
        run=f"{__name__}.curves:run",
        parameters=(
            *scenes(12, 1000, "drives per value", "drive"),
            PROCESSES,
            RECORD,
            FILE_OUT,
            PAGE_OUT,
            path("--picture", "also draw the curves into this PNG file", writes="figure"),
        ),
        report=f"{__name__}.curves:curves_page",
        figures=f"{__name__}.curves:draw_curves",
        extras=("sim",),
        small=("--seeds", "1", "--seconds", "1"),
    ),
    Experiment(
        name="sensing-margins",
        help="Calibrate the margin of laser perception (noise, age, lost rays, odometry), and count its coverage.",
        run=f"{__name__}.margins:run",
        parameters=(
            integer("--drives", 100, "calibration drives; at least 99 for 99 %", positive=True),
            integer("--fresh", 100, "unseen drives", positive=True),
            number("--seconds", 8.0, "simulated time per drive", positive=True),
            number("--coverage", 0.99, "share of steps, and of drives"),
            repeated(
                "--scene",
                "scenes",
                "kind of scene; repeatable  [people, rooms, steps-out]",
                known="safedpa_lab.experiments.sensing.scenes:SCENES",
            ),
            PROCESSES,
            RECORD,
            FILE_OUT,
            PAGE_OUT,
        ),
        report=f"{__name__}.margins:margins_page",
        extras=("sim",),
        small=("--drives", "2", "--fresh", "1", "--seconds", "1", "--coverage", "0.6"),
    ),
)
