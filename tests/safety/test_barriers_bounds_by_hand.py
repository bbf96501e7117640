"""What barriers are made of: each number just beyond its range is refused with its name, and just within is taken."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from safedpa.errors import InputError
from safedpa.robots.car.system import CAR
from safedpa.safety.barrier import AbstractBarrier
from safedpa.safety.braking import Braking
from safedpa.safety.ceiling import Ceiling, Seen
from safedpa.safety.closed_loop import ClosedLoop, prediction_of
from safedpa.safety.compatibility import check_backup, check_barriers, check_margins, check_reads, check_settings
from safedpa.safety.corridor_barrier import CorridorBarrier
from safedpa.safety.function_barrier import FunctionBarrier
from safedpa.safety.higher_order_barrier import HigherOrderBarrier
from safedpa.safety.prediction import Prediction
from safedpa.safety.settings import FilterSettings
from safedpa.safety.speed_barrier import SpeedBarrier
from safedpa.systems import System, systems


def height(state: Any) -> float:
    return float(state[0])


def slope(_: Any) -> float:
    return 1.0


MADE: dict[str, tuple[Callable[[], Any], str]] = {
    "braking 0": (lambda: Braking(0.0, 1.0), "braking deceleration: got 0.0, wanted a positive finite number"),
    "braking below 0": (lambda: Braking(-1.0, 1.0), "braking deceleration: got -1.0, wanted a positive finite number"),
    "braking infinite": (lambda: Braking(math.inf, 1.0), "braking deceleration: got inf, wanted a positive finite"),
    "braking nan": (lambda: Braking(math.nan, 1.0), "braking deceleration: got nan, wanted a positive finite number"),
    "gain 0": (lambda: Braking(1.0, 0.0), "braking gain: got 0.0, wanted a positive finite number"),
    "gain infinite": (lambda: Braking(1.0, math.inf), "braking gain: got inf, wanted a positive finite number"),
    "speeds equal": (lambda: SpeedBarrier(1.0, 1.0), "speed limits: got 1.0 to 1.0, wanted finite numbers, low < high"),
    "speeds turned": (
        lambda: SpeedBarrier(1.0, 0.5),
        "speed limits: got 1.0 to 0.5, wanted finite numbers, low < high",
    ),
    "speed infinite": (lambda: SpeedBarrier(0.0, math.inf), "speed limits: got 0.0 to inf, wanted finite numbers"),
    "speed minus infinite": (lambda: SpeedBarrier(-math.inf, 0.0), "speed limits: got -inf to 0.0, wanted finite"),
    "speed nan": (lambda: SpeedBarrier(math.nan, 0.0), "speed limits: got nan to 0.0, wanted finite numbers"),
    "corridor equal": (lambda: CorridorBarrier(0.5, 0.5, 0.1), "corridor: got 0.5 to 0.5, wanted finite low < high"),
    "corridor turned": (lambda: CorridorBarrier(0.5, -0.5, 0.1), "corridor: got 0.5 to -0.5, wanted finite low < high"),
    "corridor infinite": (lambda: CorridorBarrier(-math.inf, 0.5, 0.1), "corridor: got -inf to 0.5, wanted finite low"),
    "corridor open": (
        lambda: CorridorBarrier(0.5, math.inf, 0.1),
        "corridor: got 0.5 to inf, wanted finite low < high",
    ),
    "corridor 0 s": (lambda: CorridorBarrier(-0.5, 0.5, 0.0), "corridor: got 0.0 s ahead, wanted a finite time > 0"),
    "corridor back": (lambda: CorridorBarrier(-0.5, 0.5, -0.1), "corridor: got -0.1 s ahead, wanted a finite time > 0"),
    "corridor for ever": (lambda: CorridorBarrier(-0.5, 0.5, math.inf), "corridor: got inf s ahead, wanted a finite"),
    "no function": (lambda: FunctionBarrier(1.0), "h: got float, wanted a function of the state"),  # type: ignore[arg-type]
    "none as h": (lambda: FunctionBarrier(None), "h: got NoneType, wanted a function of the state"),  # type: ignore[arg-type]
    "no gradient": (lambda: FunctionBarrier(height, 1.0), "gradient: got float, wanted a function of the state"),  # type: ignore[arg-type]
    "no names": (
        lambda: FunctionBarrier(height, names=()),
        r"names: got \(\), wanted a sequence with one name for each",
    ),
    "one text": (
        lambda: FunctionBarrier(height, names="ab"),
        "names: got 'ab', wanted a sequence with one name for each",
    ),
    "a number as name": (lambda: FunctionBarrier(height, names=("a", 1)), r"names: got \('a', 1\), wanted a sequence"),  # type: ignore[arg-type]
    "kind of a number": (lambda: FunctionBarrier(height, kind=1), "kind: got 1, wanted the name by which epsilon"),  # type: ignore[arg-type]
    "reads a text": (lambda: FunctionBarrier(height, reads="xy"), "reads: got 'xy', wanted a sequence with the names"),
    "no list of derivatives": (lambda: HigherOrderBarrier(height, [1.0]), "derivatives: got function, wanted a list"),  # type: ignore[arg-type]
    "no list of rates": (lambda: HigherOrderBarrier([height, slope], 1.0), "rates: got float, wanted a list"),  # type: ignore[arg-type]
    "derivatives no functions": (
        lambda: HigherOrderBarrier([height, 1.0], [1.0]),  # type: ignore[list-item]
        r"derivatives: got \[.*, 1.0\], wanted functions of the state",
    ),
    "one derivative": (lambda: HigherOrderBarrier([height], []), "rates: got 0 for 1 derivatives, wanted h and its"),
    "no derivative": (lambda: HigherOrderBarrier([], []), "rates: got 0 for 0 derivatives, wanted h and its"),
    "one rate too few": (lambda: HigherOrderBarrier([height, slope, slope], [1.0]), "rates: got 1 for 3 derivatives"),
    "one rate too many": (lambda: HigherOrderBarrier([height, slope], [1.0, 2.0]), "rates: got 2 for 2 derivatives"),
    "rate 0": (lambda: HigherOrderBarrier([height, slope], [0.0]), "rate.*0.0"),
    "rate below 0": (lambda: HigherOrderBarrier([height, slope], [-1.0]), "rate.*-1.0"),
    "rate infinite": (lambda: HigherOrderBarrier([height, slope], [math.inf]), "rate.*inf"),
    "rate nan": (lambda: HigherOrderBarrier([height, slope], [math.nan]), "rate.*nan"),
    "rate a text": (lambda: HigherOrderBarrier([height, slope], ["1"]), "rate.*1"),  # type: ignore[list-item]
    "the first rate 0": (lambda: HigherOrderBarrier([height, slope, slope], [0.0, 1.0]), "rate.*0.0"),
}


@pytest.mark.parametrize("case", MADE)
def test_a_barrier_of_what_is_beyond_its_range_is_not_made(case: str) -> None:
    make, said = MADE[case]
    with pytest.raises(InputError, match=f"^{said}"):
        make()


WITHIN: tuple[Callable[[], Any], ...] = (
    lambda: Braking(1e-300, 1e300),
    lambda: SpeedBarrier(1.0, math.nextafter(1.0, 2.0)),
    lambda: SpeedBarrier(-2.0, -1.0),
    lambda: CorridorBarrier(-3.0, 3.0, 1e-300),
    lambda: CorridorBarrier(0.5, math.nextafter(0.5, 1.0), 10.0),
    lambda: FunctionBarrier(height, slope),
    lambda: FunctionBarrier(height, None),
    lambda: FunctionBarrier(height, names=["a"], reads=()),
    lambda: HigherOrderBarrier([height, slope], [1e-9]),
    lambda: HigherOrderBarrier([height, slope, slope], (1, np.float64(2.0))),
)


@pytest.mark.parametrize("place", range(len(WITHIN)))
def test_a_barrier_of_what_is_just_within_is_made(place: int) -> None:
    WITHIN[place]()


def test_what_functions_of_several_values_return_has_a_row_for_each_name() -> None:
    """One name's value may be a bare number; a state's slopes may be one row."""
    one = FunctionBarrier(height, lambda _: [1.0, 0.0])
    assert one.values(np.array([0.5, 0.0])).tolist() == [0.5]
    assert one.evaluate(np.array([0.5, 0.0]))[1].tolist() == [[1.0, 0.0]]
    two = FunctionBarrier(lambda state: state[:2], lambda _: np.eye(2), names=("a", "b"))
    assert two.values(np.array([0.5, 0.25])).tolist() == [0.5, 0.25]
    for wrong in (lambda state: [1.0], lambda state: [1.0, 2.0, 3.0], lambda state: 1.0, lambda state: [[1.0, 2.0]]):
        with pytest.raises(InputError, match=r"of barrier a, b: got shape \(.*\), wanted \(2,\)"):
            FunctionBarrier(wrong, names=("a", "b")).values(np.array([0.5, 0.25]))
    with pytest.raises(InputError, match=r"of barrier a, b: got shape \(2, 1\), wanted \(2, 2\)"):
        FunctionBarrier(lambda state: state[:2], lambda _: [[1.0], [1.0]], names=("a", "b")).evaluate(np.zeros(2))


class Named(AbstractBarrier):
    """A barrier of a class of one's own."""

    kind: Any = "own"
    names: Any = ("wall",)
    reads: Any = ()

    def values(self, state: Any) -> Any:
        return np.asarray(state)[:1]

    def evaluate(self, state: Any) -> Any:
        return np.asarray(state)[:1], np.eye(1, len(state))


def own(**changed: Any) -> Named:
    part = Named()
    for name, value in changed.items():
        setattr(part, name, value)
    return part


@pytest.mark.parametrize(
    ("barriers", "said"),
    [
        pytest.param(1.0, "barriers: got float, wanted a list of them", id="a number"),
        pytest.param({own()}, "barriers: got set, wanted a list of them", id="a set"),
        pytest.param([], "barriers: got none, wanted at least one, or None in place of the list", id="none"),
        pytest.param([own(names=())], "barriers: got none, wanted at least one, or None", id="one without a value"),
        pytest.param([height], "barriers: got one of type function, wanted an AbstractBarrier", id="a function"),
        pytest.param([own(), 1.0], "barriers: got one of type float, wanted an AbstractBarrier", id="the second"),
        pytest.param([own(kind=None)], "barrier Named: got kind None, wanted the name of its margin", id="no kind"),
        pytest.param([own(), own(kind=1)], "barrier Named: got kind 1, wanted the name of its margin", id="a number's"),
        pytest.param(
            [own(names="wall")], "barrier 'own': got names 'wall', wanted a tuple with one for each", id="text"
        ),
        pytest.param(
            [own(names=(1,))], r"barrier 'own': got names \(1,\), wanted a tuple with one for each", id="no text"
        ),
        pytest.param(
            [own(names=None)], "barrier 'own': got names None, wanted a tuple with one for each", id="no names"
        ),
        pytest.param(
            [own(reads=("y",))], "barrier 'own': reads the states y, the model has x, y; wanted", id="the second"
        ),
        pytest.param([own(reads=("y", "x"))], "barrier 'own': reads the states y, x, the model has x, y", id="turned"),
        pytest.param(
            [own(reads=("x", "y", "z"))], "barrier 'own': reads the states x, y, z, the model has x, y", id="more"
        ),
    ],
)
def test_what_is_no_list_of_barriers_of_these_states_is_refused(barriers: Any, said: str) -> None:
    with pytest.raises(InputError, match=f"^{said}"):
        check_barriers(barriers, ("x", "y"))


def test_barriers_of_these_states_are_taken() -> None:
    parts = [own(), own(reads=("x",)), own(reads=["x", "y"]), own(names=[]), own(names=["a", "b"])]
    assert check_barriers(parts, ("x", "y")) == tuple(parts)
    assert check_barriers(None, ("x", "y")) is None


@pytest.mark.parametrize(("entries", "refused"), [(None, False), (2, False), (1, True), (3, True)])
def test_without_names_the_number_of_states_is_compared(entries: int | None, refused: bool) -> None:
    part = own(reads=("x", "y"))
    if refused:
        with pytest.raises(InputError, match=f"got a state of {entries} entries; wanted 2, or the names of the states"):
            check_reads([part], (), entries)
    else:
        check_reads([part], (), entries)
    check_reads([part], ("x", "y", "z"), 3)
    check_reads([own()], (), entries)


@pytest.mark.parametrize(
    ("epsilon", "barriers", "refused"),
    [
        ({"own": 0.1}, [own()], ""),
        ({"default": 0.1, "obstacle": 0.1}, [own()], ""),
        ({"oan": 0.1}, [own()], "oan"),
        ({"own": 0.1, "oan": 0.1}, [own()], "oan"),
        ({"own": 0.1}, [own(names=())], "own"),
        ({"own": 0.1}, [], "own"),
        ({"obstacle": 0.1, "default": 0.0}, [], ""),
        ({"own": 0.1}, None, ""),
        ({"obstacel": 0.1}, None, "obstacel"),
        ({"obstacel": 0.1, "obstacle": 0.1}, None, ""),
    ],
)
def test_a_margin_for_what_no_barrier_is_would_be_none(
    epsilon: dict[str, float], barriers: list[AbstractBarrier] | None, refused: str
) -> None:
    """Where the barriers are not known yet, only what is nearly a known kind without a margin is misspelt."""
    if refused:
        with pytest.raises(InputError, match=rf"^epsilon.{refused}: no barrier is of this kind"):
            check_margins(epsilon, barriers)
    else:
        check_margins(epsilon, barriers)


def settings_of(own: System, **changed: Any) -> FilterSettings:
    low, high = (tuple(float(number) for number in side) for side in (own.action_low, own.action_high))
    return FilterSettings(**{"system": "", "action_low": low, "action_high": high, **changed})


@pytest.mark.parametrize("name", sorted(systems()))
def test_bounds_lie_within_those_of_the_system(name: str) -> None:
    """On them they do; a hair beyond one of them they do not."""
    system = systems()[name]
    check_settings(settings_of(system), system)
    for place, variable in enumerate(system.action):
        for side, beyond in (("action_low", variable.low - 1e-9), ("action_high", variable.high + 1e-9)):
            bounds = [float(number) for number in getattr(system, side)]
            bounds[place] = beyond
            with pytest.raises(InputError, match=rf"for {variable.name}, the system .* takes .*; wanted bounds within"):
                check_settings(settings_of(system, **{side: tuple(bounds)}), system)


def test_settings_are_of_the_model_s_system() -> None:
    check_settings(FilterSettings(), CAR)
    with pytest.raises(InputError, match="settings: got dict, wanted FilterSettings"):
        check_settings({}, CAR)  # type: ignore[arg-type]
    with pytest.raises(InputError, match="settings: made for the system 'other', the model is of 'car'"):
        check_settings(settings_of(CAR, system="other"), CAR)
    for count in (1, 3):
        bounds = {"action_low": (0.0,) * count, "action_high": (0.1,) * count}
        with pytest.raises(InputError, match=f"settings: got bounds of {count} actions, the system 'car' has 2"):
            check_settings(settings_of(CAR, **bounds), CAR)


@pytest.mark.parametrize(
    ("backup", "said"),
    [
        (None, ""),
        (lambda _: [0.0, 0.0], ""),
        (lambda state: [float(state[0])] * 2, ""),  # raises without a state
        (1.0, "backup: got float, wanted a function of the state or None"),
        (lambda _: [0.0], r"backup: got \[0.0\], wanted 2 finite numbers, one for each action"),
        (lambda _: [0.0, 0.0, 0.0], r"backup: got \[0.0, 0.0, 0.0\], wanted 2 finite numbers"),
        (lambda _: [0.0, math.inf], r"backup: got \[0.0, inf\], wanted 2 finite numbers"),
        (lambda _: [math.nan, 0.0], r"backup: got \[nan, 0.0\], wanted 2 finite numbers"),
        (lambda _: [[0.0, 0.0]], r"backup: got \[\[0.0, 0.0\]\], wanted 2 finite numbers"),
    ],
)
def test_a_backup_answers_with_an_action_where_no_state_is_known(backup: Any, said: str) -> None:
    if said:
        with pytest.raises(InputError, match=f"^{said}"):
            check_backup(backup, 2)
    else:
        check_backup(backup, 2)


def test_what_is_no_model_is_refused_and_a_function_of_two_is_a_step() -> None:
    for wrong in (None, 1.0, "model", [height]):
        with pytest.raises(InputError, match=r"^model: got .*, wanted a model, a Prediction, affine"):
            prediction_of(wrong)  # type: ignore[arg-type]
    step = prediction_of(lambda state, action: state + action)
    assert isinstance(step, Prediction)
    with pytest.raises(InputError, match=r"^backup: got shape .*, wanted"):
        ClosedLoop(step, lambda _: [[1.0]]).action(np.zeros(1))
    assert ClosedLoop(step, lambda _: [1.0]).action(np.zeros(1)).tolist() == [1.0]


def test_above_its_ceiling_no_error_counts() -> None:
    """eta 0.5 and H 1: what lies above H is taken for H; where all of it does there is no error at all."""
    ceiling = Ceiling(0.5, {"a": 1.0})
    assert ceiling.error("a", Seen(1.0, 1.0, 1.0, 1.0), 0.0) is None
    assert ceiling.error("a", Seen(5.0, 5.0, 5.0, 5.0), 0.0) is None
    assert ceiling.error("a", Seen(5.0, 0.5, 5.0, 5.0), 0.0) == 0.5
    assert ceiling.error("a", Seen(0.75, 0.5, 0.5, 0.25), 0.0) == 0.25 - 0.5 * 0.25
    assert ceiling.error("b", Seen(9.0, 5.0, 0.0, 0.0), 0.0) == 4.0
    assert (ceiling.of("a", 0.1), ceiling.of("a", 0.6), ceiling.of("b", 0.1)) == (1.0, 1.2, math.inf)
    assert ceiling.errors("a", np.array([[2.0] * 4, [1.0, 0.5, 1.0, 1.0]])).tolist() == [0.5]


@pytest.mark.parametrize(
    ("margins", "fits"),
    [([0.5], 1.0), ([0.5001, 0.5001], 2.0), ([0.9, 1.8, 1.9], 4.0), ([math.inf], 1.0), ([0.9, math.inf], 2.0)],
)
def test_a_ceiling_is_doubled_until_its_margin_fits_below_it(margins: list[float], fits: float) -> None:
    """eta H is 0.5, 1, 2, ...: an infinite margin fits below none, and is not looked for."""
    asked: list[Ceiling] = []

    def margin(ceiling: Ceiling) -> float:
        asked.append(ceiling)
        return margins[len(asked) - 1]

    found, ceiling = Ceiling(0.5, {"a": 1.0}).fitting("a", margin)
    assert (found, ceiling.by_kind["a"], len(asked)) == (margins[-1], fits, len(margins))


def test_the_ceiling_of_settings_is_ten_layers() -> None:
    settings = FilterSettings(eta=0.5, epsilon={"a": 0.1, "b": 0.0, "default": 0.2})
    assert Ceiling.of_settings(settings).by_kind == {"a": 2.0, "default": 4.0}
