"""What people write who bring functions and classes of their own: arrays written again, wrong shapes, no numbers."""

import copy
import math
import pickle
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from safedpa.dynamics import load_model
from safedpa.errors import InputError
from safedpa.safety import (
    AbstractBarrier,
    FilterSettings,
    FunctionBarrier,
    HigherOrderBarrier,
    PendingActions,
    RolloutBarrier,
    SafetyFilter,
    Status,
)
from safedpa.safety.prediction.predictor import Prediction
from safedpa.safety.validation import Plausible

SETTINGS = FilterSettings(action_low=(-1.0,), action_high=(1.0,), epsilon=0.0)


def still(x: Any) -> Any:
    return x, np.eye(1)


def wall(x: Any) -> Any:
    return 1.0 - x[0]


def mass(x: Any) -> Any:
    return np.array([x[0] + 0.05 * x[1], x[1]]), np.array([[0.0], [0.05]])


def brake(x: Any) -> Any:
    return np.array([-np.sign(x[1]) * min(1.0, abs(x[1]) / 0.05)])


def writing(h: Callable[[Any], float]) -> Callable[[Any], Any]:
    """The same h, returned in one array that is written again with every call."""
    kept = np.zeros(1)

    def reported(x: Any) -> Any:
        kept[0] = h(x)
        return kept

    return reported


class Own(AbstractBarrier):
    kind, names = "rollout", ("post",)

    def __init__(self, h: Callable[[Any], float]) -> None:
        self._h = writing(h)

    def h(self, state: Any) -> Any:
        return self._h(state)

    def h_and_grad(self, state: Any) -> Any:
        return self._h(state), np.array([[np.sign(state[0] - 1.0), 0.0]])


def post(x: Any) -> float:
    return float(abs(x[0] - 1.0) - 0.1)


@pytest.mark.parametrize("h", [writing(post), Own(post)], ids=["function", "class"])
def test_a_rollout_sees_its_whole_path_though_h_writes_one_array_again(h: Any) -> None:
    """It saw the last place of the path alone, behind the post, and let the robot drive into it."""
    state = np.array([0.6, 1.0])
    wanted = RolloutBarrier(mass, brake, post, 80)
    found = RolloutBarrier(mass, brake, h, 80)
    np.testing.assert_array_equal(found.h(state), wanted.h(state))
    assert SafetyFilter(mass, [found], SETTINGS, backup=brake_or_rest).decide(state, [1.0]).status is Status.violated


def brake_or_rest(x: Any) -> Any:
    return np.zeros(1) if x is None else brake(x)


def test_barriers_that_write_one_array_are_two_barriers() -> None:
    kept = np.zeros(1)

    def side(sign: float) -> Callable[[Any], Any]:
        def h(x: Any) -> Any:
            return np.subtract(1.0, sign * x[:1], out=kept)

        return h

    safe = SafetyFilter(still, [FunctionBarrier(side(1.0)), FunctionBarrier(side(-1.0))], SETTINGS)
    verdict = safe.decide([0.9], [1.0])
    assert verdict.status is Status.corrected
    np.testing.assert_allclose(verdict.action, [0.02])


def test_arrays_that_are_written_again_or_of_another_length_are_not_mixed_up() -> None:
    h, gradient = FunctionBarrier(writing(wall)).h_and_grad(np.array([0.5]))
    np.testing.assert_allclose((h[0], gradient[0, 0]), (0.5, -1.0))
    # Three values for three names, but not the right ones: the margin of one was that of the other.
    parts = [Counts("function", ("a",), [0.8, 5.0]), Counts("speed", ("b", "c"), [5.0])]
    verdict = SafetyFilter(still, parts, SETTINGS).decide([0.2], [1.0])
    assert verdict.status is Status.fallback
    assert "h of barrier a: got shape (2,), wanted (1,)" in verdict.reason


class Counts(AbstractBarrier):
    """Returns another number of values than it has names."""

    def __init__(self, kind: str, names: tuple[str, ...], h: list[float]) -> None:
        self.kind, self.names, self._h = kind, names, h

    def h(self, state: Any) -> Any:
        return np.array(self._h)

    def h_and_grad(self, state: Any) -> Any:
        return np.array(self._h), np.zeros((len(self._h), 1))


@pytest.mark.parametrize(
    ("f", "g", "states", "phrase"),
    [
        (None, np.array([[0.05]]), 2, "g of the model: got shape (1, 1), wanted (2, 1)"),
        (None, np.array([0.05]), 2, "g of the model: got shape (1,), wanted (2, 1)"),
        (None, np.ones((1, 2)), 1, "g of the model: got shape (1, 2), wanted (1, 1)"),
        (np.zeros(2), np.ones((1, 1)), 1, "f of the model: got shape (2,), wanted (1,)"),
        (np.zeros((1, 1)), np.ones((1, 1)), 1, "f of the model: got shape (1, 1), wanted (1,)"),
        (np.zeros(1), np.full((2, 1), 0.05), 2, "f of the model: got shape (1,), wanted (2,)"),
        (0.0, np.full((2, 1), 0.05), 2, "f of the model: got shape (), wanted (2,)"),
    ],
)
def test_a_model_whose_shapes_numpy_would_stretch(f: Any, g: Any, states: int, phrase: str) -> None:
    safe = SafetyFilter(lambda x: (x if f is None else f, g), [FunctionBarrier(wall)], SETTINGS)
    verdict = safe.decide(np.zeros(states), [0.1])
    assert verdict.status is Status.fallback
    assert phrase in verdict.reason


def test_one_number_is_f_of_one_state() -> None:
    safe = SafetyFilter(lambda x: (float(x[0]), np.eye(1)), [FunctionBarrier(wall)], SETTINGS)
    assert safe.decide([0.0], [0.1]).status is Status.passed


@pytest.mark.parametrize("g", [np.ones(2), np.ones((2, 1)), np.ones((1, 3)), np.ones((1, 2, 1))], ids=str)
def test_slopes_given_with_a_step_have_a_row_for_each_state(g: Any) -> None:
    """The step knows the next state, and says nothing of their shape: the filter needs them once a nominal action is
    refused."""
    settings = FilterSettings(action_low=(-1.0,) * 2, action_high=(1.0,) * 2, epsilon=0.0)
    for given, status in ((g, Status.fallback), (np.ones((1, 2)), Status.corrected)):
        model = Prediction(lambda x, given=given: (x, given), lambda x, a: x + a.sum())
        verdict = SafetyFilter(model, [FunctionBarrier(wall)], settings).decide([0.5], [0.9, 0.9])
        assert verdict.status is status


@pytest.mark.parametrize("lowest", [-1.0, -3.0])
def test_an_action_is_found_though_the_model_has_no_number_for_others(lowest: float) -> None:
    """The actuator saturates above 1, and below ``lowest`` nothing is known: 0.5 - x allows an action of 0.5."""

    def step(x: Any, a: Any) -> Any:
        return np.array([min(float(a[0]), 1.0) if a[0] >= lowest else math.nan])

    def affine(x: Any, around: Any) -> Any:
        g = np.array([[float(around[0] < 1.0)]])
        return step(x, around) - g @ around, g

    barrier = FunctionBarrier(lambda x: 0.5 - x[0], lambda x: np.array([-1.0]))
    settings = FilterSettings(action_low=(-3.0,), action_high=(3.0,), eta=1.0, epsilon=0.0)
    verdict = SafetyFilter(Prediction(affine, step), [barrier], settings).decide([0.0], [2.0])
    assert (verdict.status, verdict.slack) == (Status.corrected, 0.0)
    assert verdict.action == pytest.approx([0.5], abs=1e-6)


def test_functions_of_several_values_return_one_for_each_name() -> None:
    one = FunctionBarrier(lambda x: x[0], lambda _: [1.0, 0.0])
    assert one.h_and_grad(np.array([0.5, 0.0]))[1].tolist() == [[1.0, 0.0]]
    two = FunctionBarrier(lambda x: x[:2], lambda _: [[1.0], [1.0]], names=("a", "b"))
    assert two.h(np.array([0.5, 0.25])).tolist() == [0.5, 0.25]
    with pytest.raises(InputError, match=r"of barrier a, b: got shape \(2, 1\), wanted \(2, 2\)"):
        two.h_and_grad(np.zeros(2))
    for wrong in ([1.0], [1.0, 2.0, 3.0], 1.0, [[1.0, 2.0]]):
        with pytest.raises(InputError, match=r"of barrier a, b: got shape \(.*\), wanted \(2,\)"):
            FunctionBarrier(lambda _, wrong=wrong: wrong, names=("a", "b")).h(np.zeros(2))


def test_three_slopes_are_no_table_of_three_actions() -> None:
    settings = FilterSettings(action_low=(-1.0,) * 3, action_high=(1.0,) * 3, epsilon=0.0)
    safe = SafetyFilter(lambda x: (x, np.full(3, 0.05)), [FunctionBarrier(wall)], settings)
    assert safe.decide(np.zeros(3), np.ones(3)).status is Status.fallback


def test_where_h_is_not_known_between_two_ticks_it_is_not_known() -> None:
    def blind(x: Any) -> float:
        return math.nan if 0.205 < x[0] < 0.245 else 1.0 - float(x[0])

    verdict = SafetyFilter(mass, [RolloutBarrier(mass, brake, blind, 80)], SETTINGS).decide([0.2, 1.0], [-1.0])
    assert verdict.status is Status.fallback
    assert "no finite number" in verdict.reason


@pytest.mark.parametrize("value", [True, "1", np.ma.array([1.0], mask=[True])], ids=["boolean", "text", "masked"])
def test_what_only_looks_like_numbers_on_the_way(value: Any) -> None:
    higher = HigherOrderBarrier([lambda x: value, lambda x: value], [1.0])
    assert SafetyFilter(mass, [higher], SETTINGS).decide([0.5, 0.5], [1.0]).status is Status.fallback
    last = HigherOrderBarrier([wall, lambda x: -x[1]], [lambda before: value])
    assert SafetyFilter(mass, [last], SETTINGS).decide([0.5, 0.5], [1.0]).status is Status.fallback
    rolled = RolloutBarrier(mass, lambda x: np.atleast_1d(value) if np.ndim(value) == 0 else value, wall, 3)
    with pytest.raises(InputError, match="backup: got"):
        rolled.h(np.array([0.5, 0.5]))
    late = PendingActions(mass, 1, (0.0,))
    entry = value if np.ndim(value) else [value, value]
    with pytest.raises(InputError, match="state: got"):
        late.state(entry)
    with pytest.raises(InputError, match="action: got"):
        late.next_state(late.state([0.5, 0.5]), entry if np.ndim(value) else [value], [0.5, 0.5])


class Nameless(Own):
    names = "post"  # type: ignore[assignment]


class Kindless(Own):
    kind = None  # type: ignore[assignment]


@pytest.mark.parametrize(
    ("made", "phrase"),
    [
        (lambda: SafetyFilter((wall, wall), [FunctionBarrier(wall)], SETTINGS), "affine: got tuple, wanted a function"),  # type: ignore[arg-type]
        (lambda: SafetyFilter(still, [FunctionBarrier(wall)], SETTINGS, step=3), "step: got int, wanted a function"),  # type: ignore[arg-type]
        (lambda: SafetyFilter(dict, [FunctionBarrier(wall)], SETTINGS), "which has no readable signature"),
        (
            lambda: SafetyFilter(still, [FunctionBarrier(wall)], SETTINGS, state_range=(-1, 1)),  # type: ignore[arg-type]
            "state_range: got tuple, wanted Plausible",
        ),
        (lambda: SafetyFilter(still, [Nameless(post)], SETTINGS), "got names 'post', wanted a tuple"),
        (lambda: SafetyFilter(still, [Kindless(post)], SETTINGS), "barrier Kindless: got kind None"),
        (lambda: FunctionBarrier(3), "h: got int, wanted a function"),  # type: ignore[arg-type]
        (lambda: FunctionBarrier(wall, ("left", "right")), "gradient: got tuple, wanted a function"),  # type: ignore[arg-type]
        (lambda: FunctionBarrier(None), "h: got NoneType, wanted a function"),
        (lambda: FunctionBarrier(wall, names=()), "names: got (), wanted a sequence with one name for each"),
        (lambda: FunctionBarrier(wall, names="ab"), "names: got 'ab', wanted a sequence with one name for each"),
        (lambda: FunctionBarrier(wall, names=(1,)), "names: got"),  # type: ignore[arg-type]
        (lambda: FunctionBarrier(wall, names=("left", 1)), "names: got"),  # type: ignore[arg-type]
        (lambda: FunctionBarrier(wall, kind=["a"]), "kind: got"),  # type: ignore[arg-type]
        (lambda: HigherOrderBarrier([1, 2], [1.0]), "derivatives: got"),  # type: ignore[list-item]
        (lambda: HigherOrderBarrier([wall, 2], [1.0]), "derivatives: got"),  # type: ignore[list-item]
        (lambda: HigherOrderBarrier([wall, wall], 1.0), "rates: got float, wanted a list"),  # type: ignore[arg-type]
        (lambda: HigherOrderBarrier([wall, wall], ["1"]), "rates: got '1'"),  # type: ignore[list-item]
        (lambda: HigherOrderBarrier(wall, [1.0]), "derivatives: got function, wanted a list"),
        (lambda: HigherOrderBarrier([], []), "rates: got 0 for 0 derivatives, wanted h and its"),
    ],
)
def test_mistakes_are_reported_when_they_are_made(made: Callable[[], Any], phrase: str) -> None:
    with pytest.raises(InputError, match="wanted") as reported:
        made()
    assert phrase in str(reported.value)
    assert "\n" not in str(reported.value)


@pytest.mark.parametrize("given", [FunctionBarrier(wall), 3, iter([FunctionBarrier(wall)])])
def test_something_other_than_a_list_of_barriers_is_reported(given: Any) -> None:
    verdict = SafetyFilter(still, [FunctionBarrier(wall)], SETTINGS).decide([0.0], [0.1], barriers=given)
    assert verdict.status is Status.fallback
    assert verdict.reason == f"Reason: InputError: barriers: got {type(given).__name__}, wanted a list of them."


def test_names_of_states_may_be_a_list() -> None:
    own = Own(post)
    own.reads = ["x", "v"]  # type: ignore[assignment]
    safe = SafetyFilter(mass, [own], SETTINGS, state_range=Plausible(np.array(-9.0), np.array(9.0), ("x", "v")))
    assert safe.decide([0.0, 0.0], [0.0]).status is Status.passed


def test_a_range_without_numbers_believes_everything() -> None:
    everything = Plausible(np.array([-np.inf]), np.array([np.inf]), ("x",))
    safe = SafetyFilter(still, [FunctionBarrier(wall)], SETTINGS, state_range=everything)
    assert safe.decide([-1e300], [0.0]).status is Status.passed
    for low, high in ((math.nan, 1.0), (0.0, math.nan)):
        with pytest.raises(ValueError, match="plausible range: got NaN"):
            Plausible(np.array([low]), np.array([high]), ("x",))


def test_a_period_with_a_default_is_no_latent() -> None:
    def period(x: Any, dt: float = 0.5) -> Any:
        return x, dt * np.eye(1)

    safe = SafetyFilter(period, [FunctionBarrier(wall)], SETTINGS, step=lambda x, a, dt=0.5: x + dt * a)
    verdict = safe.decide([0.0], [0.1])
    assert (verdict.status, verdict.h_next) == (Status.passed, 0.95)
    alone = SafetyFilter(period, [FunctionBarrier(wall)], SETTINGS).decide([0.0], [0.1])
    assert (alone.status, alone.h_next) == (Status.passed, 0.95)
    free = SafetyFilter(lambda x, latent=None: (x, float(latent[0]) * np.eye(1)), [FunctionBarrier(wall)], SETTINGS)
    assert free.decide([0.0], [0.1], [0.5]).h_next == 0.95


def test_a_period_with_a_default_keeps_it_when_a_latent_is_given() -> None:
    """The third argument of affine and the fourth of step are no one's: they keep their defaults."""

    def free(x: Any, latent: Any, dt: float = 0.5) -> Any:
        return x, latent[0] * dt * np.eye(1)

    def forward(x: Any, a: Any, latent: Any, dt: float = 0.5) -> Any:
        return x + latent[0] * dt * a

    safe = SafetyFilter(free, [FunctionBarrier(wall)], SETTINGS, step=forward)
    verdict = safe.decide([0.0], [0.1], [2.0])
    assert (verdict.status, verdict.h_next) == (Status.passed, 0.9)


def test_a_users_barrier_falls_by_its_share_a_step() -> None:
    """h = 1 - x[0] = 1 may fall to 1 - eta, though one step could use it up."""

    class Room(AbstractBarrier):
        kind, names = "obstacle", ("wall",)

        def h(self, state: Any) -> Any:
            return np.array([1.0 - state[0]])

        def h_and_grad(self, state: Any) -> Any:
            return self.h(state), np.array([[-1.0]])

    verdict = SafetyFilter(still, [Room()], SETTINGS).decide([0.0], [0.9])
    assert verdict.status is Status.corrected
    np.testing.assert_allclose(verdict.action, [SETTINGS.eta], atol=1e-9)


@pytest.mark.parametrize("copied", [copy.copy, copy.deepcopy, lambda one: pickle.loads(pickle.dumps(one))])
def test_a_copied_prediction_is_of_the_same_model(copied: Callable[[Any], Prediction]) -> None:
    model = load_model("car")
    other = copied(Prediction.of_model(model))
    assert other.system == model.system
    state = np.array([0.0, 0.0, 0.3, 0.5])
    action, latent = np.array([0.4, 0.1]), model.latent
    one = Prediction.of_model(model).next_state(state, action, latent, None)
    assert other.next_state(state, action, latent, None).tolist() == one.tolist()
    own = copied(Prediction(still))
    assert own.system is None
    assert own.next_state(np.zeros(1), np.ones(1), None, None).tolist() == [1.0]


def test_what_misses_a_margin_beyond_all_numbers_is_a_number() -> None:
    huge = FilterSettings(action_low=(-1.0,), action_high=(1.0,), epsilon=1.7e308)
    verdict = SafetyFilter(still, [FunctionBarrier(lambda x: 1e308 * (1.0 - x[0]))], huge).decide([0.0], [1.0])
    assert verdict.status not in (Status.passed, Status.corrected)
    assert math.isfinite(verdict.slack)


@pytest.mark.parametrize("copied", [copy.copy, copy.deepcopy, lambda safe: pickle.loads(pickle.dumps(safe))])
def test_a_copy_decides_the_same_and_takes_no_turns_with_the_first(copied: Callable[[Any], SafetyFilter]) -> None:
    other: list[SafetyFilter] = []
    safe = SafetyFilter(still, [FunctionBarrier(wall)], SETTINGS, state_range=Plausible(-np.ones(1), np.ones(1), "x"))
    other.append(copied(safe))
    first, second = (one.decide([0.9], [1.0]) for one in (safe, other[0]))
    assert (first.status, first.action.tolist()) == (second.status, second.action.tolist())
    assert other[0].decide([9.0], [1.0]).status is Status.fallback
    asked: list[Status] = []

    def asking(x: Any) -> float:
        asked.append(other[0].decide([0.0], [0.1]).status)
        return 1.0

    safe.decide([0.0], [0.1], barriers=[FunctionBarrier(asking)])
    assert set(asked) == {Status.passed}
