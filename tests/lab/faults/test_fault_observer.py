"""What the observer keeps, and how a mixture of models would be seen in it."""

from __future__ import annotations

from dataclasses import replace

import pytest

from safedpa.bus import (
    ACTION,
    HEALTH,
    LATENT,
    NO_ROBOT,
    STATE,
    TAKEOVER,
    VERDICT,
    ActionMessage,
    Bus,
    HealthMessage,
    LatentMessage,
    MemoryBroker,
    MemoryTransport,
    TakeoverMessage,
    VerdictMessage,
)
from safedpa_lab.faults.model_changes import mixed_in
from safedpa_lab.faults.observer import Observer
from safedpa_sim.robots import CarRobot, Scene


class Fleet:
    """Says whatever a test wants to be heard of the robot r1."""

    def __init__(self) -> None:
        broker = MemoryBroker()
        self.bus = Bus(MemoryTransport(broker), "test")
        self.observer = Observer(Bus(MemoryTransport(broker), "test"), "r1")

    def tick(
        self, tick: int, epoch: int = 5, model: str = "old", status: str = "passed", by: str | None = None
    ) -> None:
        stamp = {"epoch": epoch, "tick": tick, "robot_time": 0.0, "publish_time": 0.0}
        state = CarRobot(Scene.random(1), epoch=epoch).state_message()
        self.bus.publish(STATE, "r1", replace(state, tick=tick, applied_by="filter"))
        self.bus.publish(LATENT, "r1", LatentMessage(**stamp, model=model, values=(), deviations=()))
        verdict = VerdictMessage(
            **stamp, status=status, sentence="", action=(), wish=(), slack=0.0, active=(), h_now=0.0, h_next=0.0,
            margin=0.0, solver="", microseconds=0.0, model=model if by is None else by,
        )  # fmt: skip
        self.bus.publish(VERDICT, "r1", verdict)
        self.bus.publish(ACTION, "r1", ActionMessage(**stamp, values=(1.0, 0.0)))
        self.observer.listen(0.0)

    def taken(self, tick: int, model: str, epoch: int = 5) -> None:
        message = TakeoverMessage(
            epoch=epoch, tick=tick, robot_time=0.0, publish_time=0.0, service="safety_filter", change=1,
            fingerprint=model, state="taken",
        )  # fmt: skip
        self.bus.publish(TAKEOVER, "r1", message, "safety_filter")
        self.observer.listen(0.0)


@pytest.fixture
def fleet() -> Fleet:
    return Fleet()


def test_it_drives_after_enough_ticks_in_a_row_and_not_on_what_was_heard_before(fleet: Fleet) -> None:
    for tick in range(6):
        fleet.tick(tick)
    assert fleet.observer.drives(5)
    assert not fleet.observer.drives(6), "the first tick was driven by nobody"
    assert not fleet.observer.drives(3, since=fleet.observer.heard[5, 4])
    fleet.tick(6, status="fallback")
    fleet.tick(7)
    assert not fleet.observer.drives(2)


def test_a_gap_in_the_ticks_is_no_driving(fleet: Fleet) -> None:
    for tick in (0, 1, 2, 4, 5):
        fleet.tick(tick)
    assert fleet.observer.drives(1)
    assert not fleet.observer.drives(3)


def test_periods_that_came_too_late_are_no_steady_driving(fleet: Fleet) -> None:
    for tick in range(6):
        fleet.tick(tick)
    fleet.observer.heard.update({(5, tick): 10.0 + 0.05 * tick for tick in range(6)})
    assert fleet.observer.drives(5, within=0.21)
    fleet.observer.heard[5, 5] += 0.1
    assert not fleet.observer.drives(5, within=0.21)
    assert fleet.observer.drives(5)


def test_models_are_mixed_only_where_the_filter_decided_by_another_one_than_the_latents(fleet: Fleet) -> None:
    for tick in range(3):
        fleet.tick(tick, model="old")
    fleet.tick(3, model="old", by="new", status="fallback")
    fleet.tick(4, model="new")
    fleet.tick(1, epoch=2, model="new")  # the robot starts anew, with an epoch that is no larger
    assert mixed_in(fleet.observer) == []
    fleet.tick(5, model="old", by="new")  # with the latent of tick 4
    assert mixed_in(fleet.observer) == []
    fleet.tick(6, model="old", by="new")
    assert mixed_in(fleet.observer) == [(5, 6)]
    fleet.tick(2, epoch=2, model="new", by="old")
    assert mixed_in(fleet.observer) == [(5, 6), (2, 2)]


def test_heartbeats_report_services_and_acknowledged_messages(fleet: Fleet) -> None:
    message = HealthMessage(
        epoch=0, tick=0, robot_time=0.0, publish_time=0.0, service="recorder", pid=7, state="running", acknowledged=40
    )
    fleet.bus.publish(HEALTH, NO_ROBOT, message, "recorder")
    fleet.observer.listen(0.0)
    heard = fleet.observer.health["recorder"][1]
    assert fleet.observer.acknowledged == {7: 40}
    assert fleet.observer.silent_for("recorder", heard + 2.0) == pytest.approx(2.0)
    assert fleet.observer.silent_for("policy", heard) == float("inf")
