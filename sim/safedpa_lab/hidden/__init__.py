"""Measurements with a hidden effect: simulators that share no code with the models that are fitted to them."""

from safedpa_lab.hidden.case import CAR_EFFECTS, PENDULUM_EFFECTS, Case, Strength, truth_of
from safedpa_lab.hidden.suites import SUITES, cases_of
from safedpa_lab.hidden.write import Log, write_case, write_cases

__all__ = [
    "CAR_EFFECTS",
    "PENDULUM_EFFECTS",
    "SUITES",
    "Case",
    "Log",
    "Strength",
    "cases_of",
    "truth_of",
    "write_case",
    "write_cases",
]
