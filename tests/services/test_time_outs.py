"""Timeouts of commands and services, with a clock that the tests set."""

import json
import sys
import threading
from argparse import Namespace
from contextlib import contextmanager, nullcontext
from itertools import pairwise
from math import inf
from types import SimpleNamespace
from typing import Any

import pytest
from tests.messages import state_of, verdict_of

from safedpa.bus import NO_ROBOT, STATE, VERDICT, Answer, Bus, MemoryBroker, MemoryTransport, Request
from safedpa.bus.messages.requests import ORDER
from safedpa.bus.monitor import FleetOverview
from safedpa.errors import BusError, InputError, SafedpaError
from safedpa_services import service_main
from safedpa_services.command_line import change_requests, stop_orders
from safedpa_services.command_line.bus_options import request_answer
from safedpa_services.router.router import LoopWatchdog, Router

OPTIONS = {"who": "ann", "as_json": True, "certificates": None, "connect": (), "fleet": "f"}


# a command that asks for a change of the model

BEFORE = Answer(ok=True, sentence="watching", fingerprint="a" * 8, finding=1, change=3)
BEGUN = Answer(ok=True, sentence="change 4 begins", fingerprint="a" * 8, change=4, pending="take")
TAKEN = Answer(ok=True, sentence="change 4 is in force", fingerprint="b" * 8, change=4)


@pytest.fixture
def ask(clock, monkeypatch):
    """ask(answers_until, over_at, answer): asks a diagnosis to accept an effect; ends when the command does.

    With ``lossy`` every second answer after the change has begun is lost.
    """

    def run(answers_until, over_at, end=TAKEN, do="accept", *, lossy=False):
        asked, before = list[Request](), [clock.now]

        def request(_robot, request, patience, *_kind):
            assert 1.0 <= patience <= 4.0
            asked.append(request)
            assert clock.now - before[0] <= 0.25, "a person waits"
            before[0] = clock.now
            if clock.now > answers_until or (lossy and len(asked) > 2 and len(asked) % 2):
                clock.now += patience
                before[0] = clock.now
                return None
            if len(asked) == 1:
                return BEFORE
            return end if clock.now >= over_at else BEGUN

        @contextmanager
        def bus_of(_):
            yield SimpleNamespace(request=request, fleet="f")

        monkeypatch.setattr(change_requests, "bus_of", bus_of)
        change_requests.ask_for_change(do, "r1", "drag", OPTIONS)
        return asked

    return run


@pytest.mark.parametrize(
    ("answers_until", "over_at", "complaint", "ends_at"),
    [
        (inf, 3.0, None, 3.0),
        (1.0, inf, "no diagnosis answers", 11.0),
        (-1.0, inf, "no diagnosis answers", 2.0),
        (inf, inf, "change 4 is not over after 180 s", 180.0),
    ],
)
def test_a_change_is_waited_for_three_minutes_and_a_silent_diagnosis_for_ten_seconds(
    ask, clock, answers_until, over_at, complaint, ends_at, capsys
):
    if complaint is None:
        first, second, *_ = ask(answers_until, over_at)
        assert first.do == "status"
        assert (second.do, second.effect, second.model, second.finding) == ("accept", "drag", "a" * 8, 1)
        assert second.who == "ann"
        end = {"robot": "r1", "change": 4, "model": "b" * 8, "sentence": TAKEN.sentence}
        assert json.loads(capsys.readouterr().out) == end
    else:
        with pytest.raises(SafedpaError, match=complaint):
            ask(answers_until, over_at)
    assert clock.now == pytest.approx(ends_at, abs=2.2)


def test_an_answer_that_is_lost_does_not_end_the_waiting(ask, clock):
    ask(inf, 15.0, lossy=True)
    assert clock.now == pytest.approx(15.0, abs=3.0)


def test_a_dropped_change_is_an_error_and_a_refused_one_a_bad_input(ask):
    with pytest.raises(SafedpaError, match="dropped: the filter"):
        ask(inf, 2.0, Answer(ok=True, sentence="dropped: the filter cannot", fingerprint="a" * 8, change=4))
    with pytest.raises(InputError, match="no candidate"):
        ask(inf, 0.0, Answer(ok=False, sentence="refused: no candidate"))
    assert len(ask(inf, inf, do="reject")) == 2, "a rejection is over with its answer"
    later = Answer(ok=True, sentence="change 5 begins", fingerprint="b" * 8, change=5, pending="offer")
    assert ask(inf, 5.0, later), "another change has begun, so this one is over"


# orders to stop


def test_an_order_is_answered_within_seconds_or_fails():
    waited: list[float] = []

    def order(answer):
        def request(_robot, _request, seconds, kind):
            assert kind == ORDER
            waited.append(seconds)
            return answer

        bus: Any = SimpleNamespace(request=request, fleet="f")
        return request_answer(bus, "r1", Request(do="stop", who="ann"), ORDER, "no safety filter answers")

    assert order(TAKEN) is TAKEN
    with pytest.raises(InputError, match="refused by name"):
        order(Answer(ok=False, sentence="refused by name"))
    with pytest.raises(SafedpaError, match="fleet 'f': no safety filter answers"):
        order(None)
    assert all(1.0 <= seconds <= 4.0 for seconds in waited)


@pytest.mark.parametrize(
    ("robot", "status", "is_stationary_at", "speed", "does", "ends_at"),
    [
        ("r1", "stopped", 2.0, 0.5, "is stationary", 2.0),
        ("", "stopped", 0.0, 0.5, "is stationary", 1.2),
        ("r1", "stopped", inf, 0.01, "is stationary", 1.2),
        ("r1", "passed", inf, 0.01, "is stationary", 1.2),
        ("r1", "stopped", inf, 0.5, "still brakes, +0.50 m/s", 6.0),
        ("", "stopped", inf, -0.1, "still brakes, -0.10 m/s", 6.0),
        ("r1", "passed", inf, 0.5, "still drives, +0.50 m/s", 6.0),
    ],
)
def test_a_stopped_robot_or_fleet_is_waited_for_six_seconds(
    clock, robot, status, is_stationary_at, speed, does, ends_at, monkeypatch, capsys
):
    broker, asked = MemoryBroker(), []
    loop = Bus(MemoryTransport(broker), "f")

    def answer(name, request):
        asked.append((name, request.do, request.who))
        return Answer(ok=True, sentence="so be it")

    class Overview(FleetOverview):
        def listen(self, wait):
            tick, now = round(20.0 * clock.now), 0.0 if clock.now >= is_stationary_at else speed
            loop.publish(STATE, "r1", state_of(0.0, 0.0, 0.0, now, tick=tick))
            loop.publish(VERDICT, "r1", verdict_of(status, tick=tick))
            super().listen(wait)

    loop.answer_requests(answer, kinds=(ORDER,))
    monkeypatch.setattr("safedpa.bus.monitor.FleetOverview", lambda bus, name: Overview(bus, name, clock))
    monkeypatch.setattr(stop_orders, "bus_of", lambda _: Bus(MemoryTransport(broker), "f"))
    obeys = does == "is stationary"
    with nullcontext() if obeys else pytest.raises(SafedpaError, match="r1 did not obey within the time"):
        stop_orders.give_order("stop", robot, OPTIONS)
    assert json.loads(capsys.readouterr().out) == {"sentence": "so be it", "robots": {"r1": does}}
    assert asked == [(robot or NO_ROBOT, "stop", "ann")]
    assert clock.now == pytest.approx(ends_at, abs=0.25)


# what is still there


@pytest.fixture
def waits(clock, monkeypatch):
    """Waiting for an event that is never set advances the tests' clock."""

    class Event(threading.Event):
        def wait(self, timeout=None):
            if timeout is None:
                return super().wait()
            clock.now += timeout
            return self.is_set()

    monkeypatch.setattr(threading, "Event", Event)


def test_a_router_beats_several_times_a_second(clock, waits):
    """After 1.5 s of silence it counts as gone."""
    beats: list[float] = []
    refusals: Any = SimpleNamespace(newest="", total=0)
    watchdog: Any = SimpleNamespace(beat=lambda: beats.append(clock.now), end=lambda: beats.append(inf))
    Router(Bus(MemoryTransport(MemoryBroker()), "f"), refusals).run(lambda: clock.now > 5.0, watchdog)
    assert beats.pop() == inf, "the pulse ends with the router"
    assert all(0.1 <= later - earlier <= 0.5 for earlier, later in pairwise(beats))


def test_a_hanging_router_is_ended_after_seconds(clock, waits):
    ended: list[float] = []
    gone = threading.Event()

    def stationary_for():
        ended.append(clock.now)
        gone.set()

    LoopWatchdog(stationary_for)
    gone.wait()
    assert 3.0 <= ended[0] <= 10.0


def test_a_service_yields_to_the_network_thread_within_a_millisecond(monkeypatch):
    """The network thread stamps arrivals; Python's default of 5 ms would delay it."""

    def joins(_):
        raise BusError("the tests have no network")

    before = sys.getswitchinterval()
    monkeypatch.setattr(service_main, "ZenohTransport", joins)
    monkeypatch.setattr(service_main, "transport_settings_from_options", lambda _: None)
    try:
        with pytest.raises(BusError):
            service_main.serve([], Namespace(), lambda: True)
        assert sys.getswitchinterval() <= 0.001
    finally:
        sys.setswitchinterval(before)
