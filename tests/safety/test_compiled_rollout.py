"""A rollout compiled to C equals the one in NumPy, and is used only while it agrees with the user's functions."""

import copy
import pickle
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

from safedpa.dynamics import AbstractBase, PhysicsModel
from safedpa.effects import Parameter
from safedpa.errors import InputError
from safedpa.operations import NUMPY
from safedpa.safety import (
    AbstractEquationBarrier,
    FilterSettings,
    RolloutBarrier,
    SafetyFilter,
    Status,
    check_filter,
)
from safedpa.systems import System, Variable

PERIOD = 0.05
DISCS = [(1.5, 0.2, 0.4), (2.5, -0.8, 0.4), (1.0, 1.5, 0.02)]


def boat(x: Any, a: Any, operations: Any) -> list[Any]:
    """x, y, heading, speed; thrust and turn rate."""
    o = operations
    return [
        x[0] + PERIOD * x[3] * o.cos(x[2]),
        x[1] + PERIOD * x[3] * o.sin(x[2]),
        x[2] + PERIOD * a[1],
        x[3] + PERIOD * (a[0] - 0.1 * x[3] * o.absolute(x[3])),
    ]


def brake(x: Any, operations: Any) -> list[Any]:
    return [operations.clip(-x[3] / PERIOD, -1.0, 1.0), 0.3 * operations.tanh(x[3])]


def room(x: Any, operations: Any) -> list[Any]:
    return [operations.hypot(x[0] - cx, x[1] - cy) - r for cx, cy, r in DISCS]


class Discs(AbstractEquationBarrier):
    kind, numbers = "obstacle", 3

    def __init__(self, discs: Any) -> None:
        self.each, self.names = tuple(discs), tuple(f"disc {i}" for i in range(len(discs)))

    @staticmethod
    def equation(given: Any, operations: Any) -> Any:
        x, y, radius = given.each
        return [operations.hypot(given.state[0] - x, given.state[1] - y) - radius]


class Mass(AbstractBase):
    kind, equation, source, drag = "pushed_mass", "dv/dt = a - drag v", "Newton", 0.1
    parameters = (Parameter("mass", "kg", 0.1, 10.0, 1.0, neutral=1.0),)
    system = System(
        "pushed_mass",
        tuple(Variable(name, "1", -9.0, 9.0) for name in ("x", "y", "vx", "vy")),
        tuple(Variable(name, "N", -1.0, 1.0) for name in ("fx", "fy")),
    )

    def rates(self, state: Any, action: Any, parameters: Any, operations: Any) -> dict[str, Any]:
        pull = {axis: (action[f"f{axis}"] - self.drag * state[f"v{axis}"]) / parameters["mass"] for axis in "xy"}
        return {"x": state["vx"], "y": state["vy"], "vx": pull["x"], "vy": pull["y"]}


def plain(function: Callable[..., Any]) -> Callable[..., Any]:
    """The same function as one in NumPy, which is not compiled."""
    if function is boat:
        return lambda x, a: np.array(function(x, a, NUMPY))
    return lambda x: np.array(function(x, NUMPY))


NAMES = ("a", "b", "c")
COMPILED = RolloutBarrier(boat, brake, room, 40, NAMES)
TWIN = RolloutBarrier(plain(boat), plain(brake), plain(room), 40, NAMES)
STATES = st.tuples(*[st.floats(low, high) for low, high in ((0.0, 3.0), (-1.5, 2.0), (-3.0, 3.0), (-2.0, 2.0))])

pytestmark = pytest.mark.skipif("compiler" in COMPILED.not_compiled, reason=COMPILED.not_compiled)


@given(STATES)
@hypothesis_settings(max_examples=60, deadline=None)
def test_the_kernel_is_the_rollout_in_numpy(state: tuple[float, ...]) -> None:
    x, directions = np.array(state), np.array([[0.0, 0.0], [0.0, 0.0], [0.0, 0.1], [0.1, 0.0]])
    assert COMPILED.not_compiled == ""
    np.testing.assert_allclose(COMPILED.h(x), TWIN.h(x), rtol=1e-12, atol=1e-12)
    ahead = np.array(boat(x, [0.5, 0.3], NUMPY))
    found, wanted = COMPILED.starting_at(x), TWIN.starting_at(x)
    np.testing.assert_allclose(found.h(ahead), wanted.h(ahead), rtol=1e-12, atol=1e-12)
    # Brent's method ends within 1e-9 of a chord, and the quotient divides by a thousandth
    slopes = found.lie_derivative(ahead, directions), wanted.lie_derivative(ahead, directions)
    np.testing.assert_allclose(*slopes, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(found.h_and_grad(ahead)[1], wanted.h_and_grad(ahead)[1], rtol=1e-4, atol=1e-4)


@given(STATES)
@hypothesis_settings(max_examples=30, deadline=None)
def test_with_a_constant_backup_the_gradient_is_exact(state: tuple[float, ...]) -> None:
    x, near = np.array(state), 1e-6 * np.eye(4)
    coasting = RolloutBarrier(boat, [0.0, 0.1], Discs(DISCS), 20)
    assert coasting.not_compiled == ""
    h, gradient = coasting.h_and_grad(x)
    ahead, behind = (
        np.array([(coasting.h(x + sign * step) - h) / (sign * 1e-6) for step in near]).T for sign in (1, -1)
    )
    # where the one-sided differences disagree, H has a kink
    smooth = np.abs(ahead - behind) < 1e-3
    assert smooth.any()
    np.testing.assert_allclose(gradient[smooth], ahead[smooth], rtol=1e-3, atol=1e-3)


def test_other_items_need_no_other_kernel() -> None:
    for discs in (DISCS, DISCS[:1], [(x + 0.3, y, r) for x, y, r in DISCS]):
        x = np.array([0.2, 0.1, 0.3, 1.0])
        found = RolloutBarrier(boat, brake, Discs(discs), 40)
        assert found.not_compiled == ""
        np.testing.assert_allclose(found.h(x), RolloutBarrier(plain(boat), plain(brake), Discs(discs), 40).h(x))


def safe_mass(backup: Any, h: Any = room) -> tuple[SafetyFilter, RolloutBarrier]:
    model = PhysicsModel(Mass(), period=PERIOD)
    barrier = RolloutBarrier(model, backup, h, 60, NAMES)
    settings = FilterSettings(
        system="pushed_mass", action_low=(-1.0, -1.0), action_high=(1.0, 1.0), eta=0.2, epsilon={"default": 0.0}
    )
    return SafetyFilter.for_model(model, settings, [barrier], backup=barrier.backup), barrier


def stop(x: Any, operations: Any) -> Any:
    return operations.clip(-x[2:] / PERIOD, -1.0, 1.0)


def drive(safe: SafetyFilter, ticks: int = 40) -> list[Any]:
    x, actions = np.array([0.0, 0.1, 0.5, 0.0]), []
    for _ in range(ticks):
        verdict = safe.decide(x, [1.0, 0.0])
        assert verdict.status in {Status.passed, Status.corrected}
        actions.append(verdict.action)
        x = PhysicsModel(Mass(), period=PERIOD).step(x, verdict.action)
    return actions


def test_a_model_of_the_users_own_is_compiled_and_drives_as_without_a_compiler(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    safe, barrier = safe_mass(stop)
    assert barrier.not_compiled == ""
    compiled = drive(safe)
    monkeypatch.setenv("SAFEDPA_COMPILE", "0")
    safe, barrier = safe_mass(plain(stop), plain(room))
    assert barrier.not_compiled
    np.testing.assert_allclose(compiled, drive(safe), atol=1e-5)


def test_what_changes_after_the_recording_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    x = np.array([0.2, 0.1, 0.3, 1.0])
    before = COMPILED.h(x)
    monkeypatch.setitem(room.__globals__, "DISCS", [(cx, cy, r + 0.1) for cx, cy, r in DISCS])
    np.testing.assert_allclose(COMPILED.h(x), before - 0.1)
    safe, barrier = safe_mass(stop)
    passed = safe.decide([0.0, 0.1, 0.9, 0.0], [1.0, 0.0]).action
    monkeypatch.setattr(Mass, "drag", -30.0)
    assert not np.allclose(safe.decide([0.0, 0.1, 0.9, 0.0], [1.0, 0.0]).action, passed)
    np.testing.assert_allclose(barrier.path(x)[1], barrier.loop.after(x, barrier.backup(x)))


def hidden(x: Any, operations: Any, state: list[float] = [0.0]) -> Any:  # noqa: B006
    """Reads what no inspection sees: the contents of an object that hides them."""
    return [getattr(HIDDEN, "hidden")() + value for value in room(x, operations)]  # noqa: B009


class Hiding:
    __slots__ = ("offset",)
    offset: float

    def hidden(self) -> float:
        return float(self.offset)


HIDDEN = Hiding()


def test_a_kernel_that_disagrees_with_its_functions_is_given_up() -> None:
    x = np.array([0.2, 0.1, 0.3, 1.0])
    HIDDEN.offset = 0.0
    barrier = RolloutBarrier(boat, brake, hidden, 40, NAMES)
    assert barrier.not_compiled == ""
    before = barrier.h(x)
    HIDDEN.offset = -0.2
    np.testing.assert_allclose(barrier.h(x), before - 0.2)
    assert "other values" in barrier.not_compiled


def test_a_function_that_keeps_what_it_was_given_is_not_compiled() -> None:
    kept: list[Any] = [0.0]

    def keeping(x: Any, operations: Any) -> Any:
        kept[0] = x[0]
        return room(x, operations)

    assert "changes what it reads" in RolloutBarrier(boat, brake, keeping, 40, NAMES).not_compiled


def branching(x: Any, operations: Any) -> Any:
    return stop(x, operations) if x[0] > -9.0 else [0.0, 0.0]


@pytest.mark.parametrize(
    ("backup", "named"),
    [(branching, "line"), (plain(stop), "no parameter 'operations'"), (lambda x: np.zeros(2), "no parameter")],
)
def test_check_filter_names_what_prevents_compiling(backup: Any, named: str) -> None:
    safe, barrier = safe_mass(backup)
    report = check_filter(safe, [[0.0, 0.1, 0.5, 0.0]], ticks=1)
    assert named in str(report)
    assert "test_compiled_rollout.py" in barrier.not_compiled
    assert report.notes


def test_a_step_over_operations_is_the_filters_model_as_well(monkeypatch: pytest.MonkeyPatch) -> None:
    settings = FilterSettings(action_low=(-1.0, -1.0), action_high=(1.0, 1.0), eta=0.2, epsilon={"default": 0.0})
    states = np.random.default_rng(1).uniform((-1, -1, -1, 0), (0, 1, 1, 1), (20, 4))

    def decided() -> list[Any]:
        barrier = RolloutBarrier(boat, brake, room, 40, NAMES)
        safe = SafetyFilter(barrier.prediction, [barrier], settings, backup=barrier.backup)
        return [safe.decide(state, [1.0, 0.0]).action for state in states]

    compiled = decided()
    monkeypatch.setenv("SAFEDPA_COMPILE", "0")
    np.testing.assert_allclose(compiled, decided(), atol=1e-5)


def test_states_that_are_not_finite_raise_as_in_numpy() -> None:
    for state in ([np.nan, 0.0, 0.0, 1.0], [0.0, 0.0, 0.0, np.inf], [1e308, 1e308, 1.0, 1e308]):
        with np.errstate(all="ignore"), pytest.raises(InputError, match="NaN or infinity"):
            COMPILED.h(np.array(state))


def test_copies_are_compiled_again_when_they_are_used() -> None:
    x = np.array([0.2, 0.1, 0.3, 1.0])
    for other in (copy.deepcopy(COMPILED), pickle.loads(pickle.dumps(COMPILED))):
        np.testing.assert_array_equal(other.h(x), COMPILED.h(x))
        assert other.not_compiled == ""
