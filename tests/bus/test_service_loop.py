"""The loop of every service, with a clock that the test moves."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from safedpa.bus import (
    HEALTH,
    LATENT,
    SETUP,
    STATE,
    WISH,
    AbstractNode,
    Bus,
    HealthMessage,
    Inbox,
    Inputs,
    LatentMessage,
    MemoryBroker,
    MemoryTransport,
    Message,
    Outputs,
    Received,
    ServiceLoop,
    Stale,
    StateMessage,
    WishMessage,
    encode,
)
from safedpa.bus.loop.slot import Slot
from safedpa.bus.wire.setup import setup_message
from safedpa.errors import MessageError

EPOCH = 8731


class Clock:
    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


class Wisher(AbstractNode):
    """Wishes for the tick as target speed, and remembers what it was asked."""

    name = "policy"
    inputs = (LATENT,)
    outputs = (WISH,)
    share = 0.2

    def __init__(self) -> None:
        self.steps: list[tuple[str, int, Message | Stale]] = []
        self.forgotten: list[str] = []
        self.refuse = ""

    def step(self, robot: str, state: StateMessage, inputs: Inputs) -> Outputs:
        if robot == self.refuse:
            raise MessageError("goal: got 3 numbers, wanted 2")
        self.steps.append((robot, state.tick, inputs[LATENT]))
        stamp = {"epoch": state.epoch, "tick": state.tick, "robot_time": 0.0, "publish_time": 0.0}
        return {WISH: WishMessage(**stamp, values=(float(state.tick), 0.0), controller="test")}

    def forget(self, robot: str) -> None:
        self.forgotten.append(robot)


class Fleet:
    """A node in its loop, and a robot's end of the bus."""

    def __init__(self, state_at: Callable[..., StateMessage], lockstep: bool) -> None:
        broker = MemoryBroker()
        self.clock, self.node = Clock(), Wisher()
        self.transport = MemoryTransport(broker)
        self.bus = Bus(self.transport, "test")
        self.loop = ServiceLoop(self.node, Bus(MemoryTransport(broker), "test"), clock=self.clock)
        self.wishes: Inbox = self.bus.inbox((WISH,), keep_all=True)
        self.healths: Inbox = self.bus.inbox((HEALTH,), keep_all=True)
        self._state_at, self._lockstep = state_at, lockstep

    def state(self, tick: int, robot: str = "r", epoch: int = EPOCH, period: float = 0.05) -> None:
        message = self._state_at(tick, epoch=epoch, lockstep=self._lockstep, period=period)
        self.bus.publish(STATE, robot, message)
        self.loop.turn(0.0)

    def latent(self, tick: int, robot: str = "r", epoch: int = EPOCH) -> None:
        stamp = {"epoch": epoch, "tick": tick, "robot_time": 0.0, "publish_time": 0.0}
        self.bus.publish(LATENT, robot, LatentMessage(**stamp, model="m", values=(0.1,), deviations=(0.1,)))
        self.loop.turn(0.0)

    def wait(self, seconds: float) -> None:
        self.clock.now += seconds
        self.loop.turn(0.0)

    def wished(self) -> list[tuple[str, int]]:
        return [(item.robot, item.message.tick) for item in self.wishes.take(0.0) if isinstance(item, Received)]

    def health(self) -> dict[str, HealthMessage]:
        """The next heartbeat, by robot."""
        self.healths.take(0.0)
        self.wait(0.26)
        items = [item for item in self.healths.take(0.0) if isinstance(item, Received)]
        return {item.robot: item.message for item in items if isinstance(item.message, HealthMessage)}


@pytest.fixture
def lockstep(state_at: Callable[..., StateMessage]) -> Fleet:
    return Fleet(state_at, lockstep=True)


@pytest.fixture
def real_time(state_at: Callable[..., StateMessage]) -> Fleet:
    return Fleet(state_at, lockstep=False)


def test_in_lockstep_it_waits_for_its_inputs_however_long_it_takes(lockstep: Fleet) -> None:
    lockstep.state(0)
    for _ in range(20):
        lockstep.wait(10.0)
        lockstep.state(0)  # the robot repeats its state while it waits
    assert lockstep.wished() == []
    assert lockstep.node.forgotten == ["r"], "forgotten before its first tick, and not while it waits"
    lockstep.latent(0)
    assert lockstep.wished() == [("r", 0)]


def test_a_repeated_tick_is_answered_again_by_the_same_output(lockstep: Fleet) -> None:
    lockstep.state(0)
    lockstep.latent(0)
    first = [item.payload for item in lockstep.wishes.take(0.0) if isinstance(item, Received)]
    lockstep.state(0)
    lockstep.state(0)
    again = [item.payload for item in lockstep.wishes.take(0.0) if isinstance(item, Received)]
    assert again == first * 2
    assert len(lockstep.node.steps) == 1


def test_an_input_may_come_before_its_state(lockstep: Fleet) -> None:
    lockstep.state(0)
    lockstep.latent(0)
    lockstep.latent(1)
    assert lockstep.wished() == [("r", 0)]
    lockstep.state(1)
    assert lockstep.wished() == [("r", 1)]


def test_in_real_time_it_steps_as_soon_as_its_inputs_are_there(real_time: Fleet) -> None:
    real_time.state(0)
    assert real_time.wished() == []
    real_time.latent(0)
    assert real_time.wished() == [("r", 0)]
    assert isinstance(real_time.node.steps[0][2], LatentMessage)


def test_in_real_time_a_missing_input_is_stale_when_the_share_is_over(real_time: Fleet) -> None:
    real_time.state(0)
    real_time.wait(0.0099)
    assert real_time.wished() == []
    real_time.wait(0.0002)
    assert real_time.wished() == [("r", 0)]
    assert real_time.node.steps[0][2] == Stale(LATENT, None)


@pytest.mark.parametrize("age", [1, 2, 40])
def test_a_stale_input_tells_its_age(real_time: Fleet, age: int) -> None:
    real_time.state(5)
    real_time.latent(5)
    real_time.state(5 + age)
    real_time.wait(0.02)
    assert real_time.node.steps[-1] == ("r", 5 + age, Stale(LATENT, age))
    assert real_time.health()["r"].stale == 1


@pytest.mark.parametrize("age", [1, 2])
def test_in_real_time_a_node_with_slack_takes_the_input_of_the_tick_before(
    real_time: Fleet, monkeypatch: pytest.MonkeyPatch, age: int
) -> None:
    monkeypatch.setattr(Wisher, "slack", {LATENT: 1})
    real_time.state(5)
    real_time.latent(5)
    real_time.state(5 + age)
    assert real_time.wished() == [("r", 5), *([("r", 6)] if age == 1 else [])]
    real_time.wait(0.02)
    robot, tick, latent = real_time.node.steps[-1]
    assert (robot, tick) == ("r", 5 + age)
    assert latent == Stale(LATENT, 2) if age == 2 else isinstance(latent, LatentMessage)


def test_slack_is_for_the_topics_that_are_named(state_at: Callable[..., StateMessage]) -> None:
    stamp = {"epoch": EPOCH, "robot_time": 0.0, "publish_time": 0.0}
    slot = Slot(state_at(6, epoch=EPOCH, lockstep=False), 0.0, 0.0, 0.0)
    slot.keep(LATENT, LatentMessage(**stamp, tick=5, model="m", values=(0.1,), deviations=(0.1,)))
    slot.keep(WISH, WishMessage(**stamp, tick=5, values=(0.0, 0.0), controller="test"))
    assert not slot.is_complete((LATENT, WISH), {LATENT: 1})
    slot.keep(WISH, WishMessage(**stamp, tick=6, values=(0.0, 0.0), controller="test"))
    assert slot.is_complete((LATENT, WISH), {LATENT: 1})
    assert not slot.is_complete((LATENT, WISH), {})


def test_in_lockstep_nobody_has_slack(lockstep: Fleet, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Wisher, "slack", {LATENT: 1})
    lockstep.state(0)
    lockstep.latent(0)
    lockstep.state(1)
    assert lockstep.wished() == [("r", 0)]
    lockstep.latent(1)
    assert lockstep.wished() == [("r", 1)]


def test_repetitions_do_not_push_the_deadline(real_time: Fleet) -> None:
    real_time.state(0)
    for _ in range(5):
        real_time.clock.now += 0.003
        real_time.state(0)
    assert real_time.wished()[0] == ("r", 0)


def test_an_input_of_a_later_tick_is_none_of_this_one(real_time: Fleet) -> None:
    real_time.state(0)
    real_time.latent(3)
    real_time.wait(0.02)
    assert real_time.node.steps == [("r", 0, Stale(LATENT, 0))]


def test_late_and_foreign_inputs_change_nothing(real_time: Fleet) -> None:
    real_time.state(7)
    real_time.latent(6)
    real_time.latent(7, epoch=EPOCH + 1)
    real_time.latent(7, robot="other")
    assert real_time.wished() == []
    real_time.latent(7)
    real_time.latent(6)
    assert real_time.wished() == [("r", 7)]


def test_an_old_state_is_refused(real_time: Fleet) -> None:
    real_time.state(7)
    real_time.latent(7)
    real_time.state(6)
    assert real_time.wished() == [("r", 7)]
    assert real_time.health()["r"].refused == 1


def test_a_second_robot_of_the_same_name_is_refused(lockstep: Fleet) -> None:
    lockstep.state(3)
    lockstep.latent(3)
    lockstep.state(0, epoch=EPOCH + 1)
    lockstep.latent(0, epoch=EPOCH + 1)
    health = lockstep.health()["r"]
    assert (health.refused, health.epoch, health.tick) == (1, EPOCH, 3)
    assert "second robot" in health.detail
    assert lockstep.wished() == [("r", 3)]


def test_a_robot_that_waits_is_not_replaced(lockstep: Fleet) -> None:
    """It repeats its state because an input is missing: it speaks, so nobody takes its name, however long it waits."""
    lockstep.state(0)
    for _ in range(10):
        lockstep.clock.now += 0.1
        lockstep.state(0)
    lockstep.state(0, epoch=EPOCH + 1)
    assert lockstep.health()["r"].epoch == EPOCH


def test_a_robot_that_starts_anew_after_silence_is_served_anew(lockstep: Fleet) -> None:
    lockstep.state(900)
    lockstep.latent(900)
    lockstep.wait(0.31)
    lockstep.state(0, epoch=EPOCH + 1)
    lockstep.latent(0, epoch=EPOCH + 1)
    assert lockstep.wished() == [("r", 900), ("r", 0)]
    assert lockstep.node.forgotten == ["r", "r"]


def test_silence_is_measured_in_periods_of_slow_robots(lockstep: Fleet) -> None:
    lockstep.state(0, period=1.0)
    lockstep.wait(2.0)
    lockstep.state(0, epoch=EPOCH + 1)
    assert lockstep.health()["r"].epoch == EPOCH
    lockstep.wait(1.0)
    lockstep.state(0, epoch=EPOCH + 1)
    assert lockstep.health()["r"].epoch == EPOCH + 1


def test_garbage_is_counted_and_does_no_harm(lockstep: Fleet) -> None:
    lockstep.state(0)
    for key in ("safedpa/test/r/state", "safedpa/test/r/latent", "safedpa/test/x/state"):
        lockstep.transport.put(key, b"\xff garbage", never_drop=False)
        lockstep.loop.turn(0.0)
    lockstep.latent(0)
    assert lockstep.wished() == [("r", 0)]
    health = lockstep.health()
    assert health["r"].refused == 3
    assert set(health) == {"r"}


def test_whoever_speaks_for_every_robot_is_refused(lockstep: Fleet, state_at: Callable[..., StateMessage]) -> None:
    lockstep.state(0)
    payload = encode(state_at(99))
    for key in ("safedpa/test/*/state", "safedpa/*/r/state"):
        for subscriber in (entry[2] for entry in tuple(lockstep.transport._broker.subscribers)):
            subscriber(key, payload)  # as Zenoh delivers what was put under a wildcard
    lockstep.loop.turn(0.0)
    health = lockstep.health()
    assert set(health) == {"r"}
    assert health["r"].tick == 0
    assert health["r"].refused == 2


def test_several_robots_are_served_side_by_side(lockstep: Fleet) -> None:
    for robot in ("a", "b", "c"):
        lockstep.state(4, robot)
    lockstep.latent(4, "b")
    assert lockstep.wished() == [("b", 4)]
    lockstep.latent(4, "a")
    lockstep.latent(4, "c")
    assert lockstep.wished() == [("a", 4), ("c", 4)]
    assert set(lockstep.health()) == {"a", "b", "c"}


def test_what_one_robot_gets_wrong_does_not_end_the_service_of_the_others(lockstep: Fleet) -> None:
    lockstep.node.refuse = "bad"
    for robot in ("bad", "good"):
        lockstep.state(0, robot)
        lockstep.latent(0, robot)
    lockstep.state(0, "bad")
    assert lockstep.wished() == [("good", 0)]
    health = lockstep.health()["good"]
    assert (health.steps, health.refused) == (1, 0), "what another robot says is counted there"
    lockstep.state(1, "bad")
    lockstep.latent(1, "bad")
    failing = lockstep.health()["bad"]
    assert (failing.steps, failing.refused) == (0, 2)
    assert failing.state == "failing"
    assert "wanted 2" in failing.detail


def test_a_silent_robot_is_forgotten(lockstep: Fleet) -> None:
    lockstep.state(0)
    lockstep.wait(29.0)
    assert set(lockstep.health()) == {"r"}
    lockstep.wait(1.0)
    assert lockstep.node.forgotten == ["r", "r"]
    health = lockstep.health()
    assert set(health) == {"-"}
    assert health["-"].state == "ready"


def test_the_heart_beats_four_times_a_second(lockstep: Fleet) -> None:
    lockstep.loop.turn(0.0)
    lockstep.healths.take(0.0)
    for _ in range(100):
        lockstep.wait(0.01)
    assert 3 <= len(lockstep.healths.take(0.0)) <= 4


def test_run_ends_when_told() -> None:
    stops = iter([False, False, True])
    loop = ServiceLoop(Wisher(), Bus(MemoryTransport(MemoryBroker()), "test"), clock=Clock())
    loop.run(lambda: next(stops))
    assert list(stops) == []


class Lingering(Wisher):
    """Says when it does what nobody waits for, and that it did."""

    def __init__(self, clock: Clock) -> None:
        super().__init__()
        self.clock, self.after = clock, list[float]()

    def afterwards(self, robot: str) -> Outputs:
        self.after.append(self.clock.now)
        return {}


@pytest.mark.parametrize(("waiting", "at"), [(0, 0.005), (3, 0.025)])
@pytest.mark.parametrize("period", [0.05, 0.02])
def test_what_nobody_waits_for_comes_after_a_tenth_of_the_period_and_gives_way_until_half_of_it(
    state_at: Callable[..., StateMessage], monkeypatch: pytest.MonkeyPatch, waiting: int, at: float, period: float
) -> None:
    """The action is then on its way; what others wait for comes first, and not for ever."""
    fleet = Fleet(state_at, lockstep=False)
    node = fleet.loop._node = Lingering(fleet.clock)
    monkeypatch.setattr(Inbox, "waiting", property(lambda _: waiting))
    fleet.state(0, period=period)
    fleet.latent(0)
    assert fleet.wished() == [("r", 0)]
    assert node.after == []
    while fleet.clock.now < 100.0 + period:
        fleet.wait(0.0001)
    assert node.after == [pytest.approx(100.0 + at * period / 0.05, abs=1.5e-4)]


def test_what_nobody_waits_for_is_done_before_the_next_tick_however_busy_it_is(
    state_at: Callable[..., StateMessage], monkeypatch: pytest.MonkeyPatch
) -> None:
    fleet = Fleet(state_at, lockstep=False)
    node = fleet.loop._node = Lingering(fleet.clock)
    monkeypatch.setattr(Inbox, "waiting", property(lambda _: 9))
    for tick in range(3):
        fleet.state(tick)
        fleet.latent(tick)
        fleet.clock.now += 0.02
    assert node.after == pytest.approx([100.02, 100.04])


def test_whatever_is_said_in_a_turn_is_on_the_bus_when_it_ends(state_at: Callable[..., StateMessage]) -> None:
    """While batches are made, what travels together waits for the others of this turn, and for nothing else."""
    fleet = Fleet(state_at, lockstep=False)
    names = [f"r{number}" for number in range(9)]
    for tick in range(3):
        fleet.loop.quantum = 0.005
        fleet.clock.now += 0.3
        for name in names:
            fleet.bus.publish(STATE, name, state_at(tick, epoch=EPOCH, lockstep=False, period=0.05))
            stamp = {"epoch": EPOCH, "tick": tick, "robot_time": 0.0, "publish_time": 0.0}
            fleet.bus.publish(LATENT, name, LatentMessage(**stamp, model="m", values=(0.1,), deviations=(0.1,)))
        fleet.loop.serve(0.0)
        assert sorted(fleet.wished()) == [(name, tick) for name in names]
        heard = {item.robot for item in fleet.healths.take(0.0) if isinstance(item, Received)}
        assert heard == set(names)


@pytest.mark.parametrize("known", [False, True])
def test_the_setup_is_told_at_once_and_every_five_seconds_by_whoever_has_one(known: bool) -> None:
    broker, clock = MemoryBroker(), Clock()
    heard = Bus(MemoryTransport(broker), "test").inbox((SETUP,), keep_all=True)
    setup = setup_message("policy", {}) if known else None
    loop = ServiceLoop(Wisher(), Bus(MemoryTransport(broker), "test"), clock=clock, setup=setup)
    told = list[float]()
    for quarter in range(48):
        clock.now = 100.0 + 0.25 * quarter
        loop.turn(0.0)
        told += [clock.now - 100.0 for item in heard.take(0.0) if isinstance(item, Received)]
    assert told == ([0.0, 5.0, 10.0] if known else [])
