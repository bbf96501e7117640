"""The safety filter: barriers, the quadratic program, the margin and the verdict.

What is named here is imported when it is asked for: a process that needs the settings alone loads no search.
"""

import importlib
import warnings
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from safedpa.safety.barrier import AbstractBarrier, Barriers
    from safedpa.safety.calibration import MarginCalibration, calibrate_margin, one_step_errors
    from safedpa.safety.check_report import FilterIssue, FilterReport
    from safedpa.safety.corridor_barrier import CorridorBarrier
    from safedpa.safety.equation_barrier import AbstractEquationBarrier
    from safedpa.safety.filter_check import check_filter
    from safedpa.safety.function_barrier import FunctionBarrier
    from safedpa.safety.gymnasium_wrapper import GymnasiumSafetyFilter, GymnasiumVectorSafetyFilter
    from safedpa.safety.higher_order_barrier import HigherOrderBarrier
    from safedpa.safety.inputs import Plausible
    from safedpa.safety.margin import OnlineMargin, smallest_sample, split_conformal_margin
    from safedpa.safety.pending_actions import PendingActions
    from safedpa.safety.prediction import Prediction
    from safedpa.safety.quadratic_program import QuadraticProgram, Solution
    from safedpa.safety.rollout_barrier import RolloutBarrier
    from safedpa.safety.safety_filter import SafetyFilter
    from safedpa.safety.settings import FilterSettings, load_settings, parse_settings, save_settings, write_settings
    from safedpa.safety.speed_barrier import SpeedBarrier
    from safedpa.safety.verdict import Status, Verdict

__all__ = [
    "AbstractBarrier",
    "AbstractEquationBarrier",
    "Barriers",
    "CorridorBarrier",
    "FilterIssue",
    "FilterReport",
    "FilterSettings",
    "FunctionBarrier",
    "GymnasiumSafetyFilter",
    "GymnasiumVectorSafetyFilter",
    "HigherOrderBarrier",
    "MarginCalibration",
    "OnlineMargin",
    "PendingActions",
    "Plausible",
    "Prediction",
    "QuadraticProgram",
    "RolloutBarrier",
    "SafetyFilter",
    "Solution",
    "SpeedBarrier",
    "Status",
    "Verdict",
    "calibrate_margin",
    "check_filter",
    "load_settings",
    "one_step_errors",
    "parse_settings",
    "save_settings",
    "smallest_sample",
    "split_conformal_margin",
    "write_settings",
]


_HOMES = {
    "barrier": "AbstractBarrier Barriers",
    "calibration": "MarginCalibration calibrate_margin one_step_errors",
    "check_report": "FilterIssue FilterReport",
    "corridor_barrier": "CorridorBarrier",
    "equation_barrier": "AbstractEquationBarrier",
    "filter_check": "check_filter",
    "function_barrier": "FunctionBarrier",
    "gymnasium_wrapper": "GymnasiumSafetyFilter GymnasiumVectorSafetyFilter",
    "higher_order_barrier": "HigherOrderBarrier",
    "inputs": "Plausible",
    "margin": "OnlineMargin smallest_sample split_conformal_margin",
    "pending_actions": "PendingActions",
    "prediction": "Prediction",
    "quadratic_program": "QuadraticProgram Solution",
    "rollout_barrier": "RolloutBarrier",
    "safety_filter": "SafetyFilter",
    "settings": "FilterSettings load_settings parse_settings save_settings write_settings",
    "speed_barrier": "SpeedBarrier",
    "verdict": "Status Verdict",
}
"""By module of this package, what of it is named here."""
_HOME = {name: f"safedpa.safety.{module}" for module, names in _HOMES.items() for name in names.split()}
_MOVED = {
    "Braking": "safedpa.safety.braking",
    "FieldBarrier": "safedpa.robots.car.barriers",
    "Footprint": "safedpa.robots.car.barriers",
    "ObstacleBarrier": "safedpa.robots.car.barriers",
    "car_barriers": "safedpa.robots.car.barriers",
}
"""Where what was once asked for here is now."""


def __getattr__(name: str) -> Any:
    """Imports what is asked for the first time; what has moved is told of."""
    if name in _MOVED:
        warnings.warn(f"safedpa.safety.{name} is now {_MOVED[name]}.{name}", DeprecationWarning, stacklevel=2)
        return getattr(importlib.import_module(_MOVED[name]), name)
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    found = globals()[name] = getattr(importlib.import_module(_HOME[name]), name)
    return found


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
