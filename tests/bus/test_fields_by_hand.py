"""Fields of messages just within and just beyond what they may hold, on both roads; keys and names likewise."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import msgpack
import pytest
from tests.operations.conftest import _STATE

from safedpa.bus import HealthMessage, StateMessage, decode
from safedpa.bus.wire.codec import LARGEST_NUMBER, decode_by_field
from safedpa.bus.wire.topics import HEALTH, LONGEST_NAME, STATE, key_of, topic_of
from safedpa.errors import InputError, MessageError

STAMP: dict[str, Any] = {"epoch": 7, "tick": 1, "robot_time": 0.05, "publish_time": 0.0}
WHOLE: dict[type[Any], dict[str, Any]] = {
    StateMessage: {**STAMP, **_STATE, "period": 0.05},
    HealthMessage: {**STAMP, "service": "s", "pid": 1, "state": "running"},
}
BEYOND = math.nextafter(LARGEST_NUMBER, math.inf)

NUMBERS = (math.nan, math.inf, -math.inf, BEYOND, -BEYOND, True, "1", None, b"1", [1.0])
WRONG: tuple[tuple[type[Any], str, tuple[Any, ...], str], ...] = (
    (StateMessage, "tick", (-1, 1.0, True, "1", None, [1]), "wanted a whole number from 0"),
    (HealthMessage, "pid", (-1, 1.0, True, "1", None), "wanted a whole number from 0"),
    (StateMessage, "robot_time", NUMBERS, "wanted (a finite number|at most 1e)"),
    (HealthMessage, "step_microseconds", NUMBERS, "wanted (a finite number|at most 1e)"),
    (StateMessage, "period", (0.0, -0.0, -1e-9, 0, *NUMBERS), "wanted (a number above 0|a finite number|at most 1e)"),
    (StateMessage, "lockstep", (0, 1, "true", None, 1.0), "wanted true or false"),
    (HealthMessage, "service", (1, None, b"s", True, ["s"]), "wanted text"),
    (StateMessage, "values", (1.0, None, "ab", {"a": 1.0}), "wanted a list"),
    (StateMessage, "values", tuple([0.5, number, 0.5] for number in NUMBERS), "wanted (a finite number|at most 1e)"),
    (StateMessage, "obstacles", (1.0, [1.0], [[1.0], 2.0], "a"), "wanted a list"),
    (StateMessage, "obstacles", tuple([[0.5], [number]] for number in NUMBERS), "wanted (a finite number|at most 1e)"),
)
CASES = [(kind, name, value, said) for kind, name, values, said in WRONG for value in values]


@pytest.mark.parametrize("road", [decode, decode_by_field])
@pytest.mark.parametrize(("kind", "name", "value", "said"), CASES, ids=lambda item: str(item)[:30])
def test_a_value_just_beyond_is_refused_by_the_name_of_its_field(
    kind: type[Any], name: str, value: Any, said: str, road: Callable[[type[Any], bytes], Any]
) -> None:
    with pytest.raises(MessageError, match=rf"^{kind.__name__}\.{name}: got .*, {said}"):
        road(kind, msgpack.packb({**WHOLE[kind], name: value}))


RIGHT: tuple[tuple[type[Any], str, tuple[Any, ...]], ...] = (
    (StateMessage, "tick", (0, 1, 2**40)),
    (StateMessage, "robot_time", (0.0, -5.0, LARGEST_NUMBER, -LARGEST_NUMBER, 3, 5e-324)),
    (StateMessage, "period", (5e-324, LARGEST_NUMBER, 1)),
    (StateMessage, "lockstep", (True, False)),
    (HealthMessage, "service", ("", "s", "\u00e4")),
    (StateMessage, "values", ([], [1.0], [LARGEST_NUMBER, -LARGEST_NUMBER], [1, 2.5])),
    (StateMessage, "obstacles", ([], [[]], [[1.0, 2.0], []], [[LARGEST_NUMBER], [LARGEST_NUMBER]])),
)


@pytest.mark.parametrize("road", [decode, decode_by_field])
@pytest.mark.parametrize(
    ("kind", "name", "value"),
    [(kind, name, value) for kind, name, values in RIGHT for value in values],
    ids=lambda item: str(item)[:30],
)
def test_a_value_just_within_is_taken(
    kind: type[Any], name: str, value: Any, road: Callable[[type[Any], bytes], Any]
) -> None:
    def plain(item: Any) -> Any:
        return tuple(map(plain, item)) if isinstance(item, (list, tuple)) else item

    found = getattr(road(kind, msgpack.packb({**WHOLE[kind], name: value})), name)
    assert found == plain(value)
    assert type(found) in (type(plain(value)), float)


@pytest.mark.parametrize("kind", WHOLE)
def test_what_is_no_map_is_refused_and_what_is_unknown_passed_over(kind: type[Any]) -> None:
    for wrong in ([1], 1.0, None, "text"):
        with pytest.raises(MessageError, match=rf"^{kind.__name__}: got \w+, wanted a map of fields"):
            decode_by_field(kind, msgpack.packb(wrong))
    with pytest.raises(MessageError, match=rf"^{kind.__name__}: no msgpack"):
        decode_by_field(kind, b"\xc1")
    for name in STAMP:
        rest = {key: value for key, value in WHOLE[kind].items() if key != name}
        with pytest.raises(MessageError, match=rf"^{kind.__name__}\.{name}: missing"):
            decode(kind, msgpack.packb(rest))
    assert decode(kind, msgpack.packb({**WHOLE[kind], "newer": [1]})) == kind(
        **{name: tuple(map(tuple, value)) if name == "obstacles" else tuple(value) if isinstance(value, (list, tuple))
           else value for name, value in WHOLE[kind].items()}
    )  # fmt: skip


@pytest.mark.parametrize(
    "key",
    [
        "safedpa/f/r/state/more",
        "safedpa/f/r/health",
        "safedpa/f/r",
        "other/f/r/state",
        "safedpa/f/r/stat",
        "safedpa/f/*/state",
        "safedpa/*/r/state",
        "safedpa/f/r/health/*",
        "safedpa/f/r/health/",
        "safedpa/f//state",
        "safedpa//r/state",
        "safedpa/f/@r/state",
        "safedpa/f/r$/state",
        "safedpa/f/r\n/state",
        f"safedpa/f/{'r' * (LONGEST_NAME + 1)}/state",
        f"safedpa/f/r/health/{'r' * (LONGEST_NAME + 1)}",
    ],
)
def test_a_key_that_names_no_single_sender_of_a_topic_is_refused(key: str) -> None:
    with pytest.raises(InputError):
        topic_of(key)


def test_a_key_names_a_fleet_a_robot_and_a_topic() -> None:
    longest = "r" * LONGEST_NAME
    assert topic_of(key_of("f", longest, STATE)) == ("f", longest, STATE)
    assert topic_of(key_of("f", "r", HEALTH, longest)) == ("f", "r", HEALTH)
    assert topic_of(key_of("f", "-", STATE, "ignored")) == ("f", "-", STATE)
    assert key_of("f", "*", HEALTH, "*") == "safedpa/f/*/health/*"
    for names in (("", "r", "s"), ("f", "", "s"), ("f", "r", ""), ("f/g", "r", "s"), ("f", "#", "s"), ("f", "r", "@s")):
        with pytest.raises(InputError, match=r"^name '"):
            key_of(names[0], names[1], HEALTH, names[2])
