"""What one function does to its arguments the next never sees; what only looks like numbers is not believed; and a
decision that another one would disturb is none."""

import math
import threading
import time
from collections import UserDict
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from safedpa.dynamics import load_model
from safedpa.errors import InputError
from safedpa.robots.car.barriers.obstacles import car_barriers
from safedpa.safety import AbstractBarrier, FilterSettings, FunctionBarrier, SafetyFilter, Status, Verdict
from safedpa.safety.barriers.base import Barriers
from safedpa.safety.validation import InvalidInput, checked_input, checked_names, checked_output, read_only

SETTINGS = FilterSettings(action_low=(-1.0,), action_high=(1.0,), epsilon=0.0)


def made(*barriers: Any, affine: Any = None, **other: Any) -> SafetyFilter:
    parts = barriers or (FunctionBarrier(lambda x: 1.0 - x[0]),)
    return SafetyFilter(affine or (lambda x: (x, np.eye(1))), parts, other.pop("settings", SETTINGS), **other)


def writes(x: Any) -> float:
    x[0] = -100.0
    return 1.0


class Writer(AbstractBarrier):
    """A user's own class that writes into what it is given."""

    kind, names = "own", ("own",)

    def h(self, state: Any) -> Any:
        state[0] = -100.0
        return np.ones(1)

    def h_and_grad(self, state: Any) -> Any:
        state[0] = -100.0
        return np.ones(1), np.zeros((1, len(state)))


@pytest.mark.parametrize("writer", [FunctionBarrier(writes), Writer()], ids=["function", "class"])
@pytest.mark.parametrize("first", [True, False])
def test_a_barrier_that_writes_changes_nothing(writer: AbstractBarrier, first: bool) -> None:
    wall = FunctionBarrier(lambda x: 1.0 - x[0])
    verdict = made(*((writer, wall) if first else (wall, writer))).decide(np.array([0.9]), [1.0])
    assert verdict.status is Status.fallback
    assert "read-only" in verdict.reason
    np.testing.assert_array_equal(verdict.action, [0.0])


def test_a_gradient_that_writes_and_a_barrier_asked_alone_leave_the_state_alone() -> None:
    def gradient(x: Any) -> Any:
        x[0] = 0.0
        return [-1.0]

    verdict = made(FunctionBarrier(lambda x: 1.0 - x[0], gradient)).decide(np.array([0.9]), [1.0])
    assert (verdict.status, "read-only" in verdict.reason) == (Status.fallback, True)
    state = np.array([0.5])
    for barrier in (FunctionBarrier(writes), FunctionBarrier(lambda x: x[0], writes)):
        with pytest.raises(ValueError, match="read-only"):
            barrier.h_and_grad(state)
    assert state == [0.5]
    assert state.flags.writeable


@pytest.mark.parametrize("place", ["state", "latent", "around", "step state", "step action"])
def test_functions_of_the_model_cannot_write(place: str) -> None:
    def affine(x: Any, z: Any, around: Any) -> Any:
        if place in ("state", "latent", "around"):
            {"state": x, "latent": z, "around": around}[place][0] = 0.0
        return x, np.eye(1)

    def step(x: Any, a: Any) -> Any:
        if place.startswith("step"):
            (x if place == "step state" else a)[0] = 0.0
        return x + a

    verdict = made(affine=affine, step=step).decide(np.array([0.5]), [1.0], [0.3])
    assert (verdict.status, "read-only" in verdict.reason) == (Status.fallback, True)


def test_the_callers_arrays_stay_the_callers() -> None:
    state, nominal, latent = np.array([0.5]), np.array([1.0]), np.array([0.3])
    made(affine=lambda x, z: (x, np.eye(1))).decide(state, nominal, latent)
    assert [array.flags.writeable for array in (state, nominal, latent)] == [True] * 3
    assert (state, nominal, latent) == ([0.5], [1.0], [0.3])


STRANGE = [
    "1.0",
    ["1.0"],
    np.array(["1.0"]),
    np.array([b"1.0"]),
    True,
    np.True_,
    [True],
    np.array([True]),
    1.0 + 0.0j,
    np.array([1.0 + 0.0j]),
    np.array([1.0], dtype=object),
    np.ma.array([1.0], mask=[True]),
    np.ma.array([1.0]),
    np.ma.masked,
    [np.ma.array(1.0)],
    np.array(["2026-01-01"], dtype="datetime64[D]"),
    None,
    {},
    {"h": 1.0},
    object(),
    [None],
    b"1",
]


class Answers(AbstractBarrier):
    kind, names = "own", ("own",)

    def __init__(self, value: Any, slope: Any) -> None:
        self._value, self._slope = value, slope

    def h(self, state: Any) -> Any:
        return self._value

    def h_and_grad(self, state: Any) -> Any:
        return self._value, self._slope


@pytest.mark.filterwarnings("ignore:Warning. converting a masked element")
@pytest.mark.parametrize("strange", STRANGE, ids=lambda value: type(value).__name__)
def test_what_only_looks_like_numbers_is_not_believed_from_functions_or_as_an_input(strange: Any) -> None:
    good = FunctionBarrier(lambda x: 0.5 - x[0])
    filters = {
        "h": made(FunctionBarrier(lambda x: strange)),
        "h of a class": made(Answers(strange, np.zeros((1, 1)))),
        "gradient": made(FunctionBarrier(lambda x: 0.5 - x[0], lambda x: strange)),
        "f": made(good, affine=lambda x: (strange, np.eye(1))),
        "g": made(good, affine=lambda x: (x, [strange])),
        "step": made(good, step=lambda x, a: strange),
    }
    for name, safe in filters.items():
        verdict = safe.decide(np.array([0.0]), [1.0])
        assert (name, verdict.status) == (name, Status.fallback)
        np.testing.assert_array_equal(verdict.action, [0.0])
    safe = made(affine=lambda x, z: (x, np.eye(1)))
    for inputs in ((strange, [1.0], [1.0]), ([0.0], strange, [1.0])):
        verdict = safe.decide(*inputs)
        assert verdict.status is Status.fallback
    if strange is not None:
        assert safe.decide([0.0], [0.1], strange).status is Status.fallback


@pytest.mark.parametrize("good", [0.5, np.float64(0.5), np.float32(0.5), [0.5], (0.5,), np.array([0.5]), np.array(0.5)])
def test_numbers_of_every_kind_are(good: Any) -> None:
    assert checked_output("h", good).dtype == np.float64
    assert made(FunctionBarrier(lambda x: good)).decide([0.0], [1.0]).h_next == 0.5
    assert checked_output("h", [1, np.int32(2), 3.0]).tolist() == [1.0, 2.0, 3.0]


def test_states_may_be_read_only_arrays_tuples_or_lists() -> None:
    mine = np.zeros(2)
    view = read_only(mine)
    assert (view.flags.writeable, mine.flags.writeable) == (False, True)
    assert read_only(view) is view
    assert checked_input("it", (1.0, 2.0), None) == (1.0, 2.0)
    assert checked_input("it", [1.0, float("nan")], None) == InvalidInput("it holds NaN or infinity")
    assert checked_input("it", [1, 2.0], None) == (1.0, 2.0)
    assert checked_input("it", [1.0, True], None) == InvalidInput("it does not consist of numbers")
    assert checked_input("it", (), None) == ()


@pytest.mark.parametrize(
    "stale", [None, 0, 3.5, "latent", b"x", [None], [3, "state"], np.array([1.0]), object(), {"a": 1}]
)
def test_a_list_of_stale_inputs_that_is_none(stale: Any) -> None:
    safe = made()
    for verdict in (safe.decide([0.0], [0.1], stale=stale), safe.stop("why", [0.0], stale=stale)):
        assert verdict.status in (Status.fallback, Status.stopped)
        np.testing.assert_array_equal(verdict.action, [0.0])
    assert "stale is no list of names" in safe.decide([0.0], [0.1], stale=stale).reason
    assert checked_names(stale) is None


def test_a_list_of_stale_inputs_of_any_sort() -> None:
    safe = made()
    for stale in (["latent"], ("latent",), {"latent"}, frozenset(("latent",))):
        assert safe.decide([0.0], [0.1], stale=stale).reason == "Reason: latent is stale."  # type: ignore[arg-type]
    for none in ([], (), set()):
        assert safe.decide([0.0], [0.1], stale=none).status is Status.passed  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "epsilon",
    [
        np.array([0.1]),
        np.zeros((2, 2)),
        0.1,
        0,
        "obstacle",
        [],
        [0.1],
        object(),
        {"function": "0.1"},
        {"function": None},
        {"function": True},
        {"function": 0.1j},
        {"function": np.array([0.1, 0.2])},
        {"function": np.array([0.1])},
        {"function": -1e-9},
        {"function": math.nan},
        {"default": math.inf},
        {"default": -1.0},
        {3: 0.1},
        {None: 0.1},
    ],
    ids=lambda value: type(value).__name__,
)
def test_margins_that_are_none(epsilon: Any) -> None:
    safe = made()
    for _ in range(2):
        verdict = safe.decide([0.0], [0.1], epsilon=epsilon)
        assert verdict.status is Status.fallback
        assert "margin epsilon" in verdict.reason
    assert safe.decide([0.0], [0.1], epsilon={"function": np.float32(0.05)}).status is Status.passed
    assert safe.decide([0.0], [0.1], epsilon=UserDict({"function": 0.06})).margin == 0.06
    assert safe.decide([0.0], [0.1], epsilon=None).status is Status.passed


def broken() -> float:
    raise OSError("no clock")


@pytest.mark.parametrize(
    "clock",
    [broken, lambda: None, lambda: float("nan"), lambda: float("inf"), lambda: 1e308, lambda: "noon", object],
    ids=["raises", "none", "nan", "infinity", "huge", "text", "object"],
)
def test_a_clock_that_fails_stops_no_decision(clock: Callable[[], Any]) -> None:
    verdict = made(clock=clock).decide([0.0], [0.1])
    assert (verdict.status, verdict.microseconds) == (Status.passed, 0.0)


RUBBISH = [7, "x", object(), [None], {"a": 1}, np.array(["a"]), float("nan"), np.full(9, np.nan), lambda: 1, b"", ()]


@pytest.mark.parametrize("rubbish", RUBBISH, ids=lambda value: type(value).__name__)
@pytest.mark.parametrize("name", ["car", "car_learned", "pendulum", "point_wind"])
def test_rubbish_in_any_place_is_answered(rubbish: Any, name: str) -> None:
    model = load_model(name)
    low, high = np.maximum(model.system.action_low, -0.01), np.minimum(model.system.action_high, 0.01)
    settings = FilterSettings(action_low=tuple(low), action_high=tuple(high))
    state, nominal = np.zeros(len(model.system.state)), np.zeros(len(low))
    safe = SafetyFilter.for_model(model, settings, [FunctionBarrier(lambda x: 9.0 - x[0])])
    good: dict[str, Any] = {"state": state, "nominal": nominal, "latent": model.latent}
    for place in ("state", "nominal", "latent", "memory", "barriers", "epsilon", "stale"):
        verdict = safe.decide(**{**good, place: rubbish})
        assert isinstance(verdict, Verdict)
        assert (verdict.action >= low).all()
        assert (verdict.action <= high).all()
        nothing = isinstance(rubbish, tuple) and place in ("stale", "latent")  # an empty one says so in good order
        if place != "memory" and not nothing:
            assert (place, verdict.status) == (place, Status.fallback)
    assert isinstance(safe.stop("why", rubbish, rubbish, memory=rubbish, stale=rubbish), Verdict)
    assert isinstance(safe.hold("the nominal action", rubbish, rubbish, memory=rubbish, epsilon=rubbish), Verdict)


class Unprintable(Exception):  # noqa: N818 - what a user's own may be called
    def __str__(self) -> str:
        raise RuntimeError("nor this")


def test_an_error_that_cannot_be_printed_is_answered_all_the_same() -> None:
    def raises(x: Any) -> float:
        raise Unprintable

    verdict = made(FunctionBarrier(raises)).decide([0.0], [0.1])
    assert (verdict.status, verdict.reason) == (Status.fallback, "Reason: RuntimeError.")
    np.testing.assert_array_equal(verdict.action, [0.0])


def test_two_threads_at_once_get_one_decision_and_one_refusal() -> None:
    inside, go_on = threading.Event(), threading.Event()

    def slow(x: Any) -> float:
        inside.set()
        assert go_on.wait(10.0)
        return float(1.0 - x[0])

    calls: list[Any] = []
    safe = made(FunctionBarrier(slow), backup=lambda state: calls.append(state) or np.zeros(1))
    found: list[Verdict] = []
    first = threading.Thread(target=lambda: found.append(safe.decide([0.0], [0.1])))
    first.start()
    assert inside.wait(10.0)
    free = [FunctionBarrier(lambda x: 99.0)]
    asked = len(calls)
    seconds = [
        safe.decide([0.0], [1.0], barriers=free),
        safe.hold("the nominal action", [0.0], barriers=free),
        safe.stop("why", [0.0], barriers=free),
    ]
    assert len(calls) == asked  # not even the backup: it is the other thread's as well
    go_on.set()
    first.join(10.0)
    for second in seconds:
        assert second.status is Status.fallback
        assert "another decision of this filter is in progress" in second.reason
        np.testing.assert_array_equal(second.action, [0.0])
    assert (found[0].status, found[0].h_now) == (Status.passed, 1.0)
    assert safe.decide([0.0], [1.0], barriers=free).status is Status.passed


def test_a_barrier_that_asks_its_own_filter_gets_a_refusal() -> None:
    found: list[Verdict] = []

    def asks(x: Any) -> float:
        found.append(safe.decide([0.0], [1.0]))
        return float(1.0 - x[0])

    safe = made(FunctionBarrier(asks))
    assert safe.decide([0.0], [0.1]).status is Status.passed
    assert {verdict.status for verdict in found} == {Status.fallback}


def test_many_threads_never_get_each_others_barriers() -> None:
    model, settings = load_model("car"), FilterSettings.for_robot("car")
    safe = SafetyFilter.for_model(model, settings)
    footprint = (0.08, 0.4, 0.12)
    scenes = {
        near: car_barriers(settings, footprint, [(0.9 if near else 90.0, 0.0, 0.3)], (-99.0, 99.0, -99.0, 99.0))
        for near in (True, False)
    }
    verdicts: dict[bool, list[Verdict]] = {True: [], False: []}
    until, patience = (time.monotonic() + seconds for seconds in (1.0, 60.0))

    def decides_on(near: bool) -> bool:
        now, found = time.monotonic(), verdicts[near]
        return now < until or (now < patience and not any(item.known for item in found))

    def drive(near: bool) -> None:
        while decides_on(near):
            verdicts[near].append(safe.decide([0.0, 0.0, 0.0, 1.0], [2.0, 0.0], model.latent, barriers=scenes[near]))

    threads = [threading.Thread(target=drive, args=(near,)) for near in (True, False)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert all(any(item.known for item in found) for found in verdicts.values())
    assert {item.status for item in verdicts[True]} <= {
        Status.relaxed,
        Status.corrected,
        Status.violated,
        Status.fallback,
    }
    for near, found in verdicts.items():
        assert {item.h_now < 1.0 for item in found if item.known} <= {near}


def test_parts_are_checked_by_the_stack_of_any_kind() -> None:
    stack = Barriers((Answers(["0.5"], [[0.0]]),))
    with pytest.raises(InputError, match=r"h: got list of <U3, wanted real numbers"):
        stack.h_floats((0.0,))
    with pytest.raises(InputError, match="gradient of h: got a masked array"):
        Barriers((Answers([0.5], np.ma.zeros((1, 1))),)).grad_h_floats((0.0,), [0])
