"""What remains after a diagnosis is noise, or the verdict says so; effects that hide each other are found together."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from safedpa.diagnosis.diagnose import diagnose
from safedpa.diagnosis.report_schema import Report
from safedpa.diagnosis.search.joint_trials import textbook_combinations
from safedpa.dynamics import AbstractBase, PhysicsModel, Setting
from safedpa.effects import Parameter, effects_of, general_effects
from safedpa.effects.library import REGISTERED
from safedpa.records.run import Run, Stretch
from safedpa.report.diagnosis_story import rounded
from safedpa.systems import System, Variable

PERIOD = 0.02
ARM = System(
    "remainder_arm",
    (Variable("position", "rad", -50.0, 50.0), Variable("rate", "rad/s", -9.0, 9.0)),
    (Variable("current", "A", -9.0, 9.0),),
)
Named = Mapping[str, Any]
Force = Callable[[float, float, float], float]
"""(current, rate, time) -> what is added to the acceleration."""


class Inertia(AbstractBase):
    """d(rate)/dt = gain current."""

    kind = "remainder_inertia"
    equation = "d(rate)/dt = gain current"
    source = "Newton"
    system = ARM
    parameters = (Parameter("gain", "rad/s2/A", 0.05, 500.0, 3.0, neutral=None),)

    def rates(self, state: Named, action: Named, parameters: Named, operations: Any) -> dict[str, Any]:
        """Rates of the state by name."""
        return {"position": state["rate"], "rate": parameters["gain"] * action["current"]}


@pytest.fixture
def library() -> None:
    REGISTERED.update({(ARM.name, item.name): item for item in general_effects(ARM, moving={"rate": 0.5})})


def arm(*, free: bool = True) -> PhysicsModel:
    return PhysicsModel(Inertia(), [], {"base.gain": Setting(3.0 if free else 1.8, free)}, PERIOD)


def logs(force: Force, *, seconds: float = 30.0, runs: int = 2, gain: float = 1.8) -> list[Run]:
    """Runs of an arm that is driven through its friction by steps, with a little noise."""
    return [_log(force, seed, round(seconds / PERIOD), gain) for seed in range(runs)]


def _log(force: Force, seed: int, rows: int, gain: float) -> Run:
    random, steps = np.random.default_rng(seed), 20
    current = np.repeat(random.uniform(-6.0, 6.0, rows // 40 + 1), 40)[:rows]
    states: NDArray[np.float64] = np.empty((rows, 2))
    x, v = 0.0, 0.0
    for row in range(rows):
        states[row] = x, v
        for step in range(steps):
            time = (row + step / steps) * PERIOD
            v += PERIOD / steps * (gain * current[row] - 2.0 * v + force(float(current[row]), v, time))
            x += PERIOD / steps * v
    noisy = states + random.standard_normal(states.shape) * (0.001, 0.005)
    times = PERIOD * np.arange(rows, dtype=np.float64)
    return Run(f"run {seed}", ARM, times, noisy, current[:, None], (Stretch(0, rows),))


def friction(_current: float, rate: float, _time: float) -> float:
    return -2.5 * float(np.tanh(rate / 0.01)) - 2.0 * rate


@pytest.mark.long
@pytest.mark.parametrize("free", [True, False])
def test_two_frictions_that_ruin_the_fit_of_the_base_are_found_together(library: None, *, free: bool) -> None:
    report = diagnose(arm(free=free), logs(friction))
    assert {"rate_friction", "rate_drag"} <= set(report.added)
    assert report.parameters["rate_friction.deceleration"].value == pytest.approx(2.5, rel=0.1)
    assert report.stages[-1].heldout_error < 0.1 * report.stages[0].heldout_error


def _drag(_current: float, _rate: float, _time: float) -> float:
    return 0.0


def _periodic(_current: float, _rate: float, time: float) -> float:
    return 1.5 * float(np.sin(2.0 * np.pi * time / 3.7))


@pytest.mark.long
def test_what_depends_on_the_time_alone_is_not_nothing(library: None) -> None:
    model = arm()
    report = diagnose(model, logs(_periodic))
    assert report.verdict == "unexplained"
    assert report.remainder is not None
    assert "of what remains of unseen data depends on" in report.remainder.sentence


class _Heating:
    """A motor that weakens over seconds as it heats up, from a cold start in each log."""

    def __init__(self) -> None:
        self.heat = 0.0

    def __call__(self, current: float, rate: float, time: float) -> float:
        self.heat = 0.0 if time == 0.0 else self.heat + PERIOD / 20 * ((current / 6.0) ** 2 - self.heat / 6.0)
        return 1.8 * current * (1.0 / (1.0 + 0.6 * self.heat) - 1.0)


@pytest.mark.long
def test_a_motor_that_weakens_with_use_is_not_nothing(library: None) -> None:
    report = diagnose(arm(), logs(_Heating()))
    assert report.verdict == "unexplained"


class _Ringing:
    """A load on a spring that the current excites, and that rings for many seconds."""

    def __init__(self) -> None:
        self.place = self.speed = 0.0

    def __call__(self, current: float, rate: float, time: float) -> float:
        if time == 0.0:
            self.place = self.speed = 0.0
        self.speed += PERIOD / 20 * (9.0 * (9.0 * (0.5 * current - self.place) - 0.1 * self.speed))
        self.place += PERIOD / 20 * self.speed
        return 0.3 * self.speed


@pytest.mark.long
def test_a_load_that_rings_is_not_nothing(library: None) -> None:
    report = diagnose(arm(), logs(_Ringing()))
    assert report.verdict == "unexplained"
    assert report.remainder is not None
    assert "of what remains of unseen data depends on" in report.remainder.sentence


@pytest.mark.long
def test_noise_alone_depends_on_nothing(library: None) -> None:
    report: Report = diagnose(arm(), logs(_drag))
    assert report.remainder is not None
    assert report.remainder.sentence == ""
    assert report.added == ("rate_drag",)
    assert report.tried[0] > 10


def _pairs(robot: str) -> set[frozenset[str]]:
    found = textbook_combinations(list(effects_of(robot).values()))
    return {frozenset(item.name for item in pair) for pair in found}


def test_textbook_pairs_follow_from_what_effects_declare(library: None) -> None:
    pairs = _pairs(ARM.name)
    assert frozenset({"rate_friction", "rate_drag"}) in pairs
    assert frozenset({"current_lag", "current_gain"}) in pairs
    assert frozenset({"current_gain", "rate_friction"}) not in pairs
    assert frozenset({"rolling_resistance", "quadratic_drag"}) in _pairs("car")


@pytest.mark.parametrize(
    ("value", "std", "text"),
    [
        (0.0008754, 0.0018, "0.0009"), (0.728, 0.0024, "0.7280"), (18.78, 8.2, "18.8"), (1234.0, 56.0, "1234"),
        (0.25, None, "0.25"), (1.6e-7, 2.5e-8, "1.6e-07"), (0.0, 0.01, "0.00"),
    ],
)  # fmt: skip
def test_a_value_has_the_digits_of_its_deviation(value: float, std: float | None, text: str) -> None:
    assert rounded(value, std) == text
