"""The table of all experiments, by name. Each subject's package lists its own; this module joins them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from safedpa_lab import log_faults
from safedpa_lab.experiments import (
    adversary,
    car,
    diagnosis,
    driving,
    fleet,
    hostile,
    margins,
    operation,
    pendulum,
    point,
    ros,
    sensing,
    tuning,
)
from safedpa_lab.experiments.record import Experiment, path, repeated, switch

_ALL = Experiment(
    name="all",
    help="""Run every experiment whose figures the pages quote, one after the other.

    Results of the current code are kept: an interrupted run continues, and after a change of code only results that
    depend on it are made again. DIR/all.json holds the time of each part. Exit code 1 if one failed.""",
    run="safedpa_lab.experiments.run_all:run",
    parameters=(
        path("--out", "folder with one subfolder per result; may hold earlier results", metavar="DIR"),
        repeated("--only", "only", "only this part; repeatable", metavar="NAME"),
        path("--data", "recordings of real robots, for real-logs and tuning-real", metavar="DIR"),
        switch("--small", "short versions that only show that all run"),
        switch("--list", "list the parts and their approximate time without running them", "listed"),
    ),
    report="safedpa_lab.experiments.run_all:report",
    verdict="safedpa_lab.experiments.run_all:verdict",
    listing="safedpa_lab.experiments.run_all:listing",
    extras=("sim", "diagnosis"),
)

_PACKAGES = (
    adversary, car, diagnosis, driving, fleet, hostile, log_faults, margins,
    operation, pendulum, point, ros, sensing, tuning,
)  # fmt: skip

EXPERIMENTS: Final[Mapping[str, Experiment]] = {
    each.name: each
    for each in sorted((_ALL, *(one for package in _PACKAGES for one in package.EXPERIMENTS)), key=lambda one: one.name)
}
"""In the order of the command line's help."""
