"""The safety filter: barriers, the optimisation that chooses an action, margins and the verdict.

These eight files hold the whole promise, in reading order: ``verdict`` (the result), ``filter`` (the entry point),
``decision`` (one decision), ``solver.constraints`` (the CBF constraints), ``solver.sqp`` (nearest feasible action),
``solver.least_violation`` (no action is feasible), ``barriers.base`` (h and its derivatives), ``margins.conformal``
(the margin). Names are imported on first use, so that a process that needs only the settings loads no solver.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from safedpa.safety.barriers.base import AbstractBarrier, Barriers
    from safedpa.safety.barriers.between_ticks import LipschitzBarrier
    from safedpa.safety.barriers.distance_field import DistanceFieldBarrier, distance_to_occupied
    from safedpa.safety.barriers.equation import AbstractEquationBarrier
    from safedpa.safety.barriers.function import FunctionBarrier
    from safedpa.safety.barriers.higher_order import HigherOrderBarrier
    from safedpa.safety.barriers.limits import CorridorBarrier, SpeedBarrier
    from safedpa.safety.barriers.look_ahead import LookAheadBarrier
    from safedpa.safety.barriers.rollout import RolloutBarrier
    from safedpa.safety.checks.check_filter import check_filter
    from safedpa.safety.checks.report import FilterIssue, FilterReport
    from safedpa.safety.filter import SafetyFilter
    from safedpa.safety.gymnasium import GymnasiumSafetyFilter, GymnasiumVectorSafetyFilter
    from safedpa.safety.margins.calibration import MarginCalibration, calibrate_margin, one_step_errors
    from safedpa.safety.margins.conformal import OnlineMargin, smallest_sample, split_conformal_margin
    from safedpa.safety.prediction.delayed_model import PendingActions
    from safedpa.safety.prediction.predictor import Prediction
    from safedpa.safety.session.filter_session import FilterSession
    from safedpa.safety.session.state_limits import Evidence, StateLimits, limits_from_evidence
    from safedpa.safety.settings import FilterSettings, load_settings, parse_settings, save_settings, write_settings
    from safedpa.safety.solver.qp import QuadraticProgram, Solution
    from safedpa.safety.validation import Plausible
    from safedpa.safety.verdict import Status, Verdict

__all__ = [
    "AbstractBarrier",
    "AbstractEquationBarrier",
    "Barriers",
    "CorridorBarrier",
    "DistanceFieldBarrier",
    "Evidence",
    "FilterIssue",
    "FilterReport",
    "FilterSession",
    "FilterSettings",
    "FunctionBarrier",
    "GymnasiumSafetyFilter",
    "GymnasiumVectorSafetyFilter",
    "HigherOrderBarrier",
    "LipschitzBarrier",
    "LookAheadBarrier",
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
    "StateLimits",
    "Status",
    "Verdict",
    "calibrate_margin",
    "check_filter",
    "distance_to_occupied",
    "limits_from_evidence",
    "load_settings",
    "one_step_errors",
    "parse_settings",
    "save_settings",
    "smallest_sample",
    "split_conformal_margin",
    "write_settings",
]


_HOMES = {
    "barriers.base": "AbstractBarrier Barriers",
    "barriers.between_ticks": "LipschitzBarrier",
    "barriers.distance_field": "DistanceFieldBarrier distance_to_occupied",
    "barriers.equation": "AbstractEquationBarrier",
    "barriers.function": "FunctionBarrier",
    "barriers.higher_order": "HigherOrderBarrier",
    "barriers.limits": "CorridorBarrier SpeedBarrier",
    "barriers.look_ahead": "LookAheadBarrier",
    "barriers.rollout": "RolloutBarrier",
    "checks.check_filter": "check_filter",
    "checks.report": "FilterIssue FilterReport",
    "filter": "SafetyFilter",
    "gymnasium": "GymnasiumSafetyFilter GymnasiumVectorSafetyFilter",
    "margins.calibration": "MarginCalibration calibrate_margin one_step_errors",
    "margins.conformal": "OnlineMargin smallest_sample split_conformal_margin",
    "prediction.delayed_model": "PendingActions",
    "prediction.predictor": "Prediction",
    "session.filter_session": "FilterSession",
    "session.state_limits": "Evidence StateLimits limits_from_evidence",
    "settings": "FilterSettings load_settings parse_settings save_settings write_settings",
    "solver.qp": "QuadraticProgram Solution",
    "validation": "Plausible",
    "verdict": "Status Verdict",
}
"""Public names by module of this package."""
_HOME = {name: f"safedpa.safety.{module}" for module, names in _HOMES.items() for name in names.split()}


def __getattr__(name: str) -> Any:
    """Imports a name when it is first used."""
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    found = globals()[name] = getattr(importlib.import_module(_HOME[name]), name)
    return found


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
