"""The safety filter: barriers, the quadratic program, the margin and the verdict."""

from typing import TYPE_CHECKING, Any

from safedpa.safety.barrier import AbstractBarrier, Barriers
from safedpa.safety.braking import Braking
from safedpa.safety.calibration import MarginCalibration, calibrate_margin, one_step_errors
from safedpa.safety.car_barriers import car_barriers
from safedpa.safety.check_filter import check_filter
from safedpa.safety.check_report import FilterIssue, FilterReport
from safedpa.safety.corridor_barrier import CorridorBarrier
from safedpa.safety.field_barrier import FieldBarrier
from safedpa.safety.function_barrier import FunctionBarrier
from safedpa.safety.higher_order_barrier import HigherOrderBarrier
from safedpa.safety.inputs import Plausible
from safedpa.safety.margin import OnlineMargin, smallest_sample, split_conformal_margin
from safedpa.safety.obstacle_barrier import Footprint, ObstacleBarrier
from safedpa.safety.pending_actions import PendingActions
from safedpa.safety.prediction import Prediction
from safedpa.safety.quadratic_program import QuadraticProgram, Solution
from safedpa.safety.rollout_barrier import RolloutBarrier
from safedpa.safety.safety_filter import SafetyFilter
from safedpa.safety.settings import FilterSettings, load_settings, parse_settings, save_settings, write_settings
from safedpa.safety.speed_barrier import SpeedBarrier
from safedpa.safety.verdict import Status, Verdict

if TYPE_CHECKING:
    from safedpa.safety.gymnasium_wrapper import GymnasiumSafetyFilter, GymnasiumVectorSafetyFilter

__all__ = [
    "AbstractBarrier",
    "Barriers",
    "Braking",
    "CorridorBarrier",
    "FieldBarrier",
    "FilterIssue",
    "FilterReport",
    "FilterSettings",
    "Footprint",
    "FunctionBarrier",
    "GymnasiumSafetyFilter",
    "GymnasiumVectorSafetyFilter",
    "HigherOrderBarrier",
    "MarginCalibration",
    "ObstacleBarrier",
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
    "car_barriers",
    "check_filter",
    "load_settings",
    "one_step_errors",
    "parse_settings",
    "save_settings",
    "smallest_sample",
    "split_conformal_margin",
    "write_settings",
]


def __getattr__(name: str) -> Any:
    """The gymnasium wrappers, imported when they are asked for: gymnasium is optional."""
    if name in ("GymnasiumSafetyFilter", "GymnasiumVectorSafetyFilter"):
        from safedpa.safety import gymnasium_wrapper

        return getattr(gymnasium_wrapper, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
