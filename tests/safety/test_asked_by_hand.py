"""What the filter is asked with: margins, numbers of functions, pending actions, orders; beyond and just within."""

from __future__ import annotations

import math
from collections import UserDict
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from safedpa.bus.wire.requests import Request
from safedpa.errors import InputError
from safedpa.safety import held_model
from safedpa.safety.calibration import MarginCalibration
from safedpa.safety.decision import DecisionError
from safedpa.safety.held_model import HeldModel, checked_calibration, held_offer
from safedpa.safety.margins_in_force import Margins
from safedpa.safety.numbers_returned import numbers_returned
from safedpa.safety.orders import Orders
from safedpa.safety.pending_actions import PendingActions
from safedpa.safety.settings import FilterSettings


def stack(*kinds: str) -> Any:
    return SimpleNamespace(kinds=kinds, of_each=lambda table, otherwise: [table.get(kind, otherwise) for kind in kinds])


@pytest.mark.parametrize(
    ("asked", "epsilon"),
    [
        ({}, [0.1, 0.2]),
        ({"wall": 0.5}, [0.5, 0.2]),
        ({"wall": 0}, [0, 0.2]),
        ({"default": 0.3}, [0.1, 0.3]),
        (UserDict({"wall": 0.5}), [0.5, 0.2]),
        ({"wall": np.float64(0.5), "speed": np.int64(1)}, [0.5, 1]),
        ({"obstacle": 9.0}, [0.1, 0.2]),
    ],
)
def test_a_table_of_margins_is_taken_over_that_of_the_settings(asked: Any, epsilon: list[float]) -> None:
    margins = Margins({"wall": 0.1, "default": 0.2})
    for _ in range(2):  # the second time it is known
        assert margins.of(stack("wall", "speed"), asked) == (epsilon, max(epsilon))
    assert margins.of(stack("wall", "speed"), {"wall": 0.7})[0] == [0.7, 0.2]
    assert margins.of(stack("speed"), {})[0] == [0.2]


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        (None, "no table by kind of barrier, but NoneType"),
        (0.1, "no table by kind of barrier, but float"),
        ([("wall", 0.1)], "no table by kind of barrier, but list"),
        ({"wal": 0.1}, "for 'wal', which no barrier is: "),
        ({1: 0.1}, "for '1', which no barrier is: known: "),
        ({"wall": True}, "is not a finite number >= 0: "),
        ({"wall": "0.1"}, "is not a finite number >= 0: "),
        ({"wall": None}, "is not a finite number >= 0: "),
        ({"wall": 1j}, "is not a finite number >= 0: "),
        ({"wall": -1e-9}, "is not a finite number >= 0: "),
        ({"wall": math.nan}, "is not a finite number >= 0: "),
        ({"wall": math.inf}, "is not a finite number >= 0: "),
        ({"default": math.inf}, "is not a finite number >= 0: "),
        ({"default": -1.0}, "is not a finite number >= 0: "),
    ],
)
def test_what_is_no_margin_is_refused_and_what_was_asked_before_forgotten(asked: Any, said: str) -> None:
    margins = Margins({"wall": 0.1})
    assert margins.of(stack("wall", "speed"), {"wall": 0.5})[0] == [0.5, 0.0]
    for _ in range(2):
        with pytest.raises(DecisionError, match=f"^margin epsilon (is )?{said}"):
            margins.of(stack("wall", "speed"), asked)
    assert margins.of(stack("wall", "speed"), {"wall": 0.5})[0] == [0.5, 0.0]


NUMBERS: tuple[tuple[Any, Any], ...] = (
    (1.5, 1.5),
    (np.float64(1.5), 1.5),
    (2, 2.0),
    (np.int8(2), 2.0),
    (np.uint16(2), 2.0),
    (np.float32(0.5), 0.5),
    ([1, 2.5], [1.0, 2.5]),
    ((1, (2,))[1], [2.0]),
    ([[1.0], [2.0]], [[1.0], [2.0]]),
    ([], []),
    (np.arange(3), [0.0, 1.0, 2.0]),
    ([np.float64(1.0), np.array(2.0)], [1.0, 2.0]),
)


@pytest.mark.parametrize(("value", "numbers"), NUMBERS, ids=repr)
def test_real_numbers_are_believed_and_copied(value: Any, numbers: Any) -> None:
    found = numbers_returned("h", value)
    assert found.dtype == np.float64
    assert found.tolist() == numbers
    assert not np.shares_memory(found, value)


@pytest.mark.parametrize(
    "value",
    [
        True, np.True_, [True], [1.0, True], [[1.0], [False]], (1.0, np.False_), "1", ["1"], b"1", None, [None],
        1j, [1.0, 2j], [[1.0], [1.0, 2.0]], {"a": 1.0}, {1.0}, np.array([True]), np.array(["1"]),
        pytest.param(object(), id="an object"),
        np.array([1.0, None]), np.ma.masked_array([1.0, 2.0], [False, True]), np.array(["2026"], dtype="datetime64"),
        [np.ma.masked_array(1.0, True), 1.0],
    ],
    ids=repr,
)  # fmt: skip
def test_what_numpy_would_take_for_numbers_and_is_none_is_refused(value: Any) -> None:
    with pytest.raises(InputError, match=r"^h: got .*, wanted (real|plain )?\s?numbers"):
        numbers_returned("h", value)


def step(state: Any, action: Any) -> Any:
    return state + action


@pytest.mark.parametrize("count", [0, -1, True, 1.0, "1", None])
def test_one_action_at_least_is_pending(count: Any) -> None:
    with pytest.raises(InputError, match=r"^count: got .*, wanted a whole number of pending actions, 1 or more"):
        PendingActions(step, count, (0.0,))


@pytest.mark.parametrize("resting", [(), 0.0, [[0.0]], [math.nan], [0.0, math.inf]])
def test_what_rests_is_an_action(resting: Any) -> None:
    with pytest.raises(InputError, match=r"^resting: got .*, wanted \(actions,\) finite numbers"):
        PendingActions(step, 1, resting)


@pytest.mark.parametrize("count", [1, 2, np.int64(3)])
def test_a_state_with_its_pending_actions_comes_apart_again(count: Any) -> None:
    late = PendingActions(step, count, (0.5,))
    xi = late.state([1.0])
    assert xi.tolist() == [1.0] + [0.5] * count
    assert [part.tolist() for part in late.split(xi)] == [[1.0], [[0.5]] * count]
    assert late.next_state(xi, [0.25], [2.0]).tolist() == [2.0] + [0.5] * (count - 1) + [0.25]
    for short in (xi[1:], xi[:0], xi.reshape(1, -1), 1.0):
        with pytest.raises(InputError, match=r"^state: got shape .*, wanted x and . pending actions of 1 after it"):
            late.split(short)
    for state, pending in (
        ([[1.0]], None),
        (1.0, None),
        ([1.0], np.zeros((count + 1, 1))),
        ([1.0], np.zeros((count, 2))),
    ):
        with pytest.raises(InputError, match=r"^pending: got state .*, wanted \(states,\) and "):
            late.state(state, pending)


def ask(orders: Orders, robot: str, do: str, who: str = "me") -> tuple[bool, str]:
    answer = orders.answer(robot, Request(do=do, who=who))
    return answer.ok, answer.sentence


@pytest.mark.parametrize("do", ["accept", "", "Stop", "switch"])
def test_other_orders_than_to_stop_and_to_go_are_none(do: str) -> None:
    orders = Orders()
    with pytest.raises(InputError, match=f"^order '{do}': wanted stop, go or status"):
        orders.answer("r", Request(do=do))
    assert orders.kept == {}


def test_who_is_stopped_by_an_order_stands_until_the_one_who_was_stopped_may_go(tmp_path: Path) -> None:
    orders = Orders(tmp_path / "orders.json")
    assert ask(orders, "a", "go") == (False, "refused: robot 'a' is not stopped by an order")
    assert ask(orders, "a", "stop") == (True, "robot 'a' stops, ordered by me; held until 'go'")
    assert (orders.reason("a"), orders.reason("b")) == ("ordered by me", "")
    assert ask(orders, "b", "go") == (False, "refused: robot 'b' is not stopped by an order; still stopped: a")
    assert ask(orders, "-", "go") == (False, "refused: the whole fleet is not stopped by an order; still stopped: a")
    assert ask(orders, "-", "stop", "")[0]
    assert orders.reason("b") == "ordered by somebody who gave no name"
    refused = "refused: the whole fleet is stopped, ordered by somebody who gave no name"
    assert ask(orders, "a", "go") == (False, refused)
    assert ask(orders, "b", "go") == (False, refused)
    assert Orders(tmp_path / "orders.json").kept == orders.kept == {"a": "ordered by me", "-": orders.reason("b")}
    assert ask(orders, "-", "go") == (True, "the whole fleet may drive; still stopped: a")
    assert ask(orders, "a", "status") == (True, "robot 'a' stands, ordered by me")
    assert ask(orders, "a", "go") == (True, "robot 'a' may drive")
    assert Orders(tmp_path / "orders.json").kept == {}
    assert ask(orders, "a", "status") == (True, "robot 'a' may drive")


def test_the_end_stops_everybody_and_is_never_kept(tmp_path: Path) -> None:
    orders = Orders(tmp_path / "orders.json")
    orders.end("the filter ends")
    assert orders.reason("a") == "the filter ends"
    assert Orders(tmp_path / "orders.json").reason("a") == ""


GIVEN: dict[str, Any] = {"transitions": 10, "date": "2026-11-27", "fingerprint": "new"}
IN_FORCE = MarginCalibration({"wall": 0.1, "speed": 0.2}, 0.9, **{**GIVEN, "fingerprint": "old"})


@pytest.mark.parametrize(
    ("epsilon", "coverage", "said"),
    [
        ({"wall": 0.3, "speed": 0.4}, 0.9, ""),
        ({"wall": 0.3, "speed": 0.4, "more": 0.1}, 0.95, ""),
        ({"wall": 0.3, "speed": 0.4}, 0.89, "margin: covers 0.89 of the steps, the one in force 0.9; calibrate it"),
        ({"wall": 0.3}, 0.9, "margin: none for speed, the one in force has it; calibrate it too"),
        ({"more": 0.3}, 0.9, "margin: none for speed, wall, the one in force has it; calibrate it too"),
        (None, 0.9, "margin: got none, the one in force was calibrated; calibrate one for the offered model too"),
    ],
)
def test_a_margin_that_promises_less_than_the_one_in_force_is_refused(
    epsilon: dict[str, float] | None, coverage: float, said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    sent = None if epsilon is None else MarginCalibration(epsilon, coverage, **GIVEN)
    monkeypatch.setattr(held_model, "offered_model", lambda offer, _: offer)
    monkeypatch.setattr(held_model, "margin_for", lambda _: sent)
    monkeypatch.setattr(held_model, "check_margins", lambda *_: None)
    offer: Any = SimpleNamespace(fingerprint="new", margin="")
    current: Any = HeldModel(offer, "old", IN_FORCE)
    if said:
        with pytest.raises(InputError, match=f"^{said}"):
            held_offer(offer, current, FilterSettings())
    else:
        assert held_offer(offer, current, FilterSettings()).calibration == sent


def test_where_nothing_was_calibrated_no_margin_is_missed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(held_model, "offered_model", lambda offer, _: offer)
    monkeypatch.setattr(held_model, "margin_for", lambda _: None)
    settings = FilterSettings()
    offer: Any = SimpleNamespace(fingerprint="new", margin="")
    current: Any = HeldModel(offer, "old", held_model.uncalibrated(settings, "old"))
    assert held_offer(offer, current, settings).fingerprint == "new"


def test_a_margin_belongs_to_the_model_that_it_was_calibrated_for() -> None:
    one = MarginCalibration({"obstacle": 0.1}, 0.9, **GIVEN)
    assert checked_calibration(one, "new", FilterSettings(margin="conformal")) == one
    with pytest.raises(InputError, match=r"^margin: calibrated for model new, the filter has old; calibrate it anew"):
        checked_calibration(one, "old", FilterSettings())
