"""Whose messages wait until it is known which model a robot has, for how long, and in which order they are served."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from tests.bus.test_greeting import Clock, Curious, Indifferent

from safedpa.bus import LATENT, STATE, Answer, LatentMessage, Received, StateMessage
from safedpa.bus.loop.greeting import Greeting
from safedpa.bus.transport.inbox import Answered, Inbox

StateAt = Callable[..., StateMessage]


class Asked:
    """In place of a bus: about which robots it was asked, and for how long it may take."""

    def __init__(self) -> None:
        self.about: list[tuple[str, float]] = []

    def answer_agreed(self, _: object) -> None:
        pass

    def ask_model(self, _: Inbox, robot: str, __: str, timeout: float) -> None:
        self.about.append((robot, timeout))


def received(message: Any, robot: str = "r") -> Received:
    topic = STATE if isinstance(message, StateMessage) else LATENT
    return Received(topic, robot, message, b"", f"safedpa/f/{robot}/{topic.name}", 0.0)


def latent(tick: int) -> Received:
    stamp: dict[str, Any] = {"epoch": 1, "tick": tick, "robot_time": 0.0, "publish_time": 0.0}
    return received(LatentMessage(**stamp, model="m", values=(0.1,), deviations=(0.1,)))


def greeting_of(node: Curious) -> tuple[Greeting, Asked, Inbox, Clock]:
    bus, inbox, clock = Asked(), Inbox(), Clock()
    return Greeting(node, bus, inbox, clock, lambda *_: None), bus, inbox, clock  # type: ignore[arg-type]


@pytest.mark.parametrize(("answered_at", "served_at"), [(0.0, 0.0), (0.5, 0.5), (None, 0.9)])
def test_a_robot_waits_for_its_answer_or_for_nine_tenths_of_a_second_and_is_then_met(
    answered_at: float | None, served_at: float, state_at: StateAt
) -> None:
    """The newest of each topic waits, the state first; what is said later waits no more, until the robot left."""
    node = Curious()
    greeting, bus, inbox, clock = greeting_of(node)
    assert not greeting.holds(latent(0)), "a state is what a robot is met by"
    older, newer, beside = received(state_at(1)), received(state_at(2)), latent(2)
    assert [greeting.holds(item) for item in (older, newer, beside)] == [True] * 3
    assert len(bus.about) == 1
    assert bus.about[0][0] == "r"
    assert 0.1 <= bus.about[0][1] <= 0.5
    served: list[Received] = []
    while not served and clock.now < 5.0:
        if answered_at is not None and clock.now >= answered_at:
            inbox.keep_answer(Answered("r", Answer(ok=True, sentence="", fingerprint="a")))
        served = greeting.ready()
        clock.now += 0.0 if served else 0.05
    assert served == [newer, beside]
    assert clock.now == pytest.approx(served_at, abs=0.051)
    assert node.told == [("r", None if answered_at is None else "a")]
    assert [greeting.holds(item) for item in (received(state_at(3)), latent(3))] == [False] * 2
    assert greeting.ready() == []
    greeting.forget("r")
    assert greeting.holds(received(state_at(4)))
    assert len(bus.about) == 2


def test_an_answer_about_one_robot_lets_no_other_begin(state_at: StateAt) -> None:
    greeting, _, inbox, _ = greeting_of(Curious())
    one, other = received(state_at(1), "one"), received(state_at(1), "other")
    assert greeting.holds(one)
    assert greeting.holds(other)
    inbox.keep_answer(Answered("other", None))
    assert greeting.ready() == [other]
    assert greeting.holds(one)


def test_who_holds_no_model_asks_nobody_and_keeps_nothing_waiting(state_at: StateAt) -> None:
    greeting, bus, _, _ = greeting_of(Indifferent())
    assert not greeting.holds(received(state_at(1)))
    assert (bus.about, greeting.deadline()) == ([], float("inf"))
