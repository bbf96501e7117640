"""The safety filter: barriers, the quadratic program, the margin and the verdict."""

from safedpa.safety.barrier import AbstractBarrier, Barriers
from safedpa.safety.braking import Braking
from safedpa.safety.car_barriers import car_barriers
from safedpa.safety.field_barrier import FieldBarrier
from safedpa.safety.function_barrier import FunctionBarrier
from safedpa.safety.inputs import Plausible
from safedpa.safety.obstacle_barrier import Footprint, ObstacleBarrier
from safedpa.safety.prediction import Prediction
from safedpa.safety.quadratic_program import QuadraticProgram, Solution
from safedpa.safety.safety_filter import SafetyFilter
from safedpa.safety.settings import FilterSettings, load_settings, parse_settings, save_settings, write_settings
from safedpa.safety.speed_barrier import SpeedBarrier
from safedpa.safety.verdict import Status, Verdict

__all__ = [
    "AbstractBarrier",
    "Barriers",
    "Braking",
    "FieldBarrier",
    "FilterSettings",
    "Footprint",
    "FunctionBarrier",
    "ObstacleBarrier",
    "Plausible",
    "Prediction",
    "QuadraticProgram",
    "SafetyFilter",
    "Solution",
    "SpeedBarrier",
    "Status",
    "Verdict",
    "car_barriers",
    "load_settings",
    "parse_settings",
    "save_settings",
    "write_settings",
]
