"""The loop of every service, with a clock that the test moves."""

import dataclasses
import time
from collections.abc import Callable
from typing import ClassVar

import pytest
from tests.bus.fleet import EPOCH, Clock, FixedPolicy, Fleet, StateAt, latent_of, stamp

from safedpa.bus import (
    ACTION,
    FINDING,
    LATENT,
    SETUP,
    STATE,
    SURROUNDINGS,
    VERDICT,
    ActionMessage,
    Bus,
    Inputs,
    LatentMessage,
    MemoryBroker,
    MemoryTransport,
    Message,
    NominalMessage,
    Outputs,
    ReceivedMessage,
    ServiceLoop,
    Stale,
    StateMessage,
    Topic,
    encode,
)
from safedpa.bus.messages.service_info import setup_message
from safedpa.bus.service.service_log import ServiceLog


@pytest.fixture
def lockstep(state_at: StateAt) -> Fleet:
    return Fleet(state_at, lockstep=True)


@pytest.fixture
def real_time(state_at: StateAt) -> Fleet:
    return Fleet(state_at, lockstep=False)


def test_in_lockstep_it_waits_for_its_inputs_however_long_it_takes(lockstep: Fleet) -> None:
    lockstep.state(0)
    for _ in range(20):
        lockstep.wait(10.0)
        lockstep.state(0)  # the robot repeats its state while it waits
    assert lockstep.nominal_ticks() == []
    assert lockstep.node.forgotten == ["r"], "forgotten before its first tick, and not while it waits"
    lockstep.latent(0)
    assert lockstep.nominal_ticks() == [("r", 0)]


def test_a_repeated_tick_is_answered_again_by_the_same_output(lockstep: Fleet) -> None:
    lockstep.state(0)
    lockstep.latent(0)
    first = [item.payload for item in lockstep.nominal_actions.take(0.0) if isinstance(item, ReceivedMessage)]
    lockstep.state(0)
    lockstep.state(0)
    again = [item.payload for item in lockstep.nominal_actions.take(0.0) if isinstance(item, ReceivedMessage)]
    assert again == first * 2
    assert len(lockstep.node.steps) == 1


def test_a_repeated_tick_is_answered_with_the_outputs_of_the_step_and_of_the_work_after_it(state_at, samples):
    class Explaining(FixedPolicy):
        defers_afterwards: ClassVar = False

        def afterwards(self, robot: str) -> Outputs:
            return {VERDICT: samples["verdict"]}

    fleet = Fleet(state_at, lockstep=True, node=Explaining())
    verdicts = fleet.bus.inbox((VERDICT,))
    fleet.state(0)
    fleet.latent(0)
    for times in (1, 1):
        assert (len(fleet.nominal_ticks()), len(verdicts.take(0.0))) == (times, times)
        fleet.state(0)


def test_an_input_may_come_before_its_state(lockstep: Fleet) -> None:
    lockstep.state(0)
    lockstep.latent(0)
    lockstep.latent(1)
    assert lockstep.nominal_ticks() == [("r", 0)]
    lockstep.state(1)
    assert lockstep.nominal_ticks() == [("r", 1)]


def test_in_real_time_a_missing_input_is_stale_when_the_share_is_over(real_time: Fleet) -> None:
    real_time.state(0)
    real_time.wait(0.0099)
    assert real_time.nominal_ticks() == []
    real_time.wait(0.0002)
    assert real_time.nominal_ticks() == [("r", 0)]
    assert real_time.node.steps[0][2] == Stale(LATENT, None)


@pytest.mark.parametrize("every_tick", [True, False])
def test_a_loop_without_processor_time_catches_up_with_every_tick_only_for_a_node_that_asks_for_it(
    state_at: StateAt, every_tick: bool
) -> None:
    class Observer(FixedPolicy):
        pass

    Observer.every_tick = every_tick
    fleet = Fleet(state_at, lockstep=False, node=Observer())
    for tick in range(10):
        fleet.at_one_moment(["r"], tick, period=0.05)
        fleet.clock.now += 0.05
    for _ in range(4):
        fleet.wait(0.0)
    assert [step[1] for step in fleet.node.steps] == (list(range(10)) if every_tick else [9])
    assert not any(isinstance(step[2], Stale) for step in fleet.node.steps)
    fleet.clock.now += 5.0
    for tick in range(10, 50):  # delivered at one moment
        fleet.at_one_moment(["r"], tick, period=0.05)
    for _ in range(20):
        fleet.wait(0.0)
    assert len(fleet.node.steps) == (50 if every_tick else 2)


@pytest.mark.parametrize("age", [1, 2, 40])
def test_a_stale_input_has_its_age(real_time: Fleet, age: int) -> None:
    real_time.state(5)
    real_time.latent(5)
    real_time.state(5 + age)
    real_time.wait(0.02)
    assert real_time.node.steps[-1] == ("r", 5 + age, Stale(LATENT, age))
    health = real_time.health()["r"]
    assert (health.stale, health.detail) == (1, f"the latent is {age} ticks old")


def test_a_heartbeat_counts_a_step_without_several_inputs_once_and_says_how_long_it_took(state_at: StateAt) -> None:
    class Slow(FixedPolicy):
        inputs: ClassVar = (LATENT, SURROUNDINGS)

        def step(self, robot: str, state: StateMessage, inputs: Inputs) -> Outputs:
            time.sleep(0.002)
            return super().step(robot, state, inputs)

    fleet = Fleet(state_at, lockstep=False, node=Slow())
    fleet.state(0)
    fleet.wait(0.02)
    health = fleet.health()["r"]
    assert (health.steps, health.stale) == (1, 1)
    assert health.detail == "no latent has arrived; no surroundings has arrived"
    assert 2_000.0 <= health.step_microseconds < 1_000_000.0


@pytest.mark.parametrize(("lockstep", "age", "stepped"), [(False, 1, True), (False, 2, False), (True, 1, False)])
def test_only_in_real_time_a_node_with_slack_takes_the_input_of_the_tick_before(lockstep, age, stepped, state_at):
    class Patient(FixedPolicy):
        slack: ClassVar = {LATENT: 1}

    fleet = Fleet(state_at, lockstep=lockstep, node=Patient())
    fleet.state(5)
    fleet.latent(5)
    fleet.state(5 + age)
    assert fleet.nominal_ticks() == [("r", 5), *([("r", 5 + age)] if stepped else [])]
    if stepped:
        assert isinstance(fleet.node.steps[-1][2], LatentMessage)
    elif not lockstep:
        fleet.wait(0.02)
        assert fleet.node.steps[-1] == ("r", 5 + age, Stale(LATENT, age))


def test_repetitions_do_not_push_the_deadline(real_time: Fleet) -> None:
    real_time.state(0)
    for _ in range(5):
        real_time.clock.now += 0.003
        real_time.state(0)
    assert real_time.nominal_ticks()[0] == ("r", 0)


def test_late_and_foreign_inputs_change_nothing(real_time: Fleet) -> None:
    real_time.state(7)
    real_time.latent(6)
    real_time.latent(7, epoch=EPOCH + 1)
    real_time.latent(7, robot="other")
    assert real_time.nominal_ticks() == []
    real_time.latent(7)
    real_time.latent(6)
    assert real_time.nominal_ticks() == [("r", 7)]


@pytest.mark.parametrize(("epoch", "tick"), [(EPOCH, 4), (EPOCH + 1, 9), (EPOCH - 1, 9)])
def test_neither_an_older_state_nor_one_of_a_second_robot_replaces_the_newest(epoch: int, tick: int, lockstep: Fleet):
    lockstep.state(5)
    lockstep.state(tick, epoch=epoch)
    lockstep.latent(tick, epoch=epoch)
    lockstep.latent(5)
    assert lockstep.nominal_ticks() == [("r", 5)]
    health = lockstep.health()["r"]
    assert (health.refused, health.epoch, health.tick) == (1, EPOCH, 5)


def test_a_robot_that_waits_is_not_replaced(lockstep: Fleet) -> None:
    """It repeats its state because an input is missing: it speaks, so its name stays taken, however long it waits."""
    lockstep.state(0)
    for _ in range(10):
        lockstep.clock.now += 0.1
        lockstep.state(0)
    lockstep.state(0, epoch=EPOCH + 1)
    assert lockstep.health()["r"].epoch == EPOCH


@pytest.mark.parametrize(
    ("period", "silence", "again"),
    [(0.05, 0.3, False), (0.05, 0.31, True), (0.5, 1.5, False), (0.5, 1.51, True), (0.1, 0.29, False)],
)
def test_a_robot_may_restart_under_its_name_after_a_silence_of_a_third_of_a_second_or_three_periods(
    period: float, silence: float, again: bool, lockstep: Fleet
) -> None:
    lockstep.state(900, period=period)
    lockstep.latent(900)
    lockstep.clock.now = 100.0 + silence
    lockstep.state(0, epoch=EPOCH + 1, period=period)
    lockstep.latent(0, epoch=EPOCH + 1)
    assert lockstep.nominal_ticks() == [("r", 900), *([("r", 0)] if again else [])]
    assert lockstep.node.forgotten == ["r"] * (2 if again else 1)
    health = lockstep.health()["r"]
    assert health.refused == (0 if again else 1)
    assert ("a second robot uses the name 'r'" in health.detail) is not again


def test_garbage_is_counted_and_does_no_harm(lockstep: Fleet) -> None:
    lockstep.transport.put("safedpa/test/x/state", b"\xff garbage", never_drop=False)
    ready = lockstep.health()["-"]
    assert (ready.state, ready.refused) == ("ready", 1)
    assert ready.detail.startswith("refused: StateMessage")
    lockstep.state(0)
    for key in ("safedpa/test/r/state", "safedpa/test/r/latent", "safedpa/test/x/state"):
        lockstep.transport.put(key, b"\xff garbage", never_drop=False)
        lockstep.loop.turn(0.0)
    lockstep.latent(0)
    assert lockstep.nominal_ticks() == [("r", 0)]
    health = lockstep.health()
    assert set(health) == {"r"}
    assert (health["r"].state, health["r"].refused) == ("running", 4), "its own and those of robots not served"


def test_a_message_for_every_robot_is_refused(lockstep: Fleet) -> None:
    lockstep.state(0)
    payload = encode(lockstep.state_at(99))
    for key in ("safedpa/test/*/state", "safedpa/*/r/state"):
        for _, _, receive in tuple(lockstep.broker.subscribers):
            receive(key, payload)  # as Zenoh delivers what was put under a wildcard
    lockstep.loop.turn(0.0)
    health = lockstep.health()
    assert set(health) == {"r"}
    assert (health["r"].tick, health["r"].refused) == (0, 2)


def test_an_error_about_one_robot_does_not_end_the_service_of_the_others(lockstep: Fleet) -> None:
    lockstep.node.refuse = "bad"
    for robot in ("bad", "good"):
        lockstep.state(0, robot)
        lockstep.latent(0, robot)
    lockstep.state(0, "bad")
    assert lockstep.nominal_ticks() == [("good", 0)]
    health = lockstep.health()["good"]
    assert (health.steps, health.refused) == (1, 0), "what another robot says is counted there"
    lockstep.state(1, "bad")
    lockstep.latent(1, "bad")
    failing = lockstep.health()["bad"]
    assert (failing.steps, failing.refused) == (0, 2)
    assert failing.state == "failing"
    assert "wanted 2" in failing.detail


@pytest.mark.parametrize(("silence", "known"), [(29.7, True), (30.5, False)])
def test_a_robot_that_is_silent_for_thirty_seconds_is_forgotten(silence: float, known: bool, lockstep: Fleet) -> None:
    lockstep.state(0)
    lockstep.wait(silence)
    assert lockstep.node.forgotten == ["r"] * (1 if known else 2)
    assert set(lockstep.health()) == ({"r"} if known else {"-"})
    assert lockstep.released == ([] if known else ["safedpa/test/r/"]), "what sending about it holds"


def test_a_service_that_is_far_behind_forgets_no_robot_whose_states_it_has_not_read(state_at: StateAt) -> None:
    node = FixedPolicy()
    node.every_tick = True
    behind = Fleet(state_at, lockstep=False, node=node)
    behind.state(0)
    for tick in range(1, 13):
        behind.bus.publish(STATE, "r", state_at(tick, epoch=EPOCH, lockstep=False, period=0.05))
    for _ in range(3):  # a turn reads four states
        behind.wait(29.0)
    assert node.forgotten == ["r"]
    behind.wait(31.0)
    assert node.forgotten == ["r"] * 2


def test_a_deadline_of_a_robot_that_has_left_starts_no_step(real_time: Fleet) -> None:
    """Its period is so long that its share would end after it is forgotten."""
    real_time.state(0, period=200.0)
    real_time.wait(31.0)
    assert set(real_time.health()) == {"-"}
    assert 0.0 < real_time.loop.wait_time(60.0) <= 0.25
    real_time.wait(20.0)
    assert real_time.nominal_ticks() == []


def test_a_thousand_robots_are_served_and_further_names_are_refused(lockstep: Fleet) -> None:
    """A name of which only a latent was heard has its room, too."""
    lockstep.latent(0, "spoken of")
    names = [f"r{number}" for number in range(999)]
    lockstep.at_one_moment(names, period=0.05)
    lockstep.loop.turn(0.0)
    assert len(lockstep.nominal_ticks()) == 999
    lockstep.state(0, "too many")
    lockstep.latent(0, "too many")
    assert lockstep.nominal_ticks() == []
    health = lockstep.health()
    assert set(health) == {*names}
    assert health["r0"].refused == 2
    lockstep.state(1, "r0")
    lockstep.latent(1, "r0")
    lockstep.state(0, "spoken of")
    lockstep.latent(0, "spoken of")
    assert lockstep.nominal_ticks() == [("r0", 1), ("spoken of", 0)]


def test_the_heart_beats_four_times_a_second(lockstep: Fleet) -> None:
    lockstep.loop.turn(0.0)
    lockstep.healths.take(0.0)
    for _ in range(100):
        lockstep.wait(0.01)
    assert 3 <= len(lockstep.healths.take(0.0)) <= 4


def test_it_runs_until_it_is_stopped() -> None:
    stops = iter([False, False, True])
    loop = ServiceLoop(FixedPolicy(), Bus(MemoryTransport(MemoryBroker()), "test"), clock=Clock())
    loop.run(lambda: next(stops))
    assert list(stops) == []


@pytest.mark.parametrize(("rests", "silence", "needed"), [(False, 0.3, True), (False, 0.31, False), (True, 0.0, False)])
def test_at_the_end_a_loop_is_needed_for_robots_that_speak_and_are_not_at_rest(rests, silence, needed, state_at):
    class Driving(FixedPolicy):
        def at_rest(self, robot: str) -> bool:
            return rests

    fleet = Fleet(state_at, lockstep=True, node=Driving())
    assert not fleet.loop.is_needed
    fleet.state(5)
    fleet.clock.now = 100.0 + silence
    assert fleet.loop.is_needed is needed


class Lingering(FixedPolicy):
    """Records when it does the work that can wait, and how many actions were on the bus by then."""

    def __init__(self, clock: Clock) -> None:
        super().__init__()
        self.clock, self.after = clock, list[float]()

    def afterwards(self, robot: str) -> Outputs:
        self.after.append(self.clock.now)
        return {}


class Listening(Lingering):
    """Also listens to findings, of which a few are taken in each turn."""

    listens: ClassVar = (FINDING,)


@pytest.mark.parametrize(("waiting", "at"), [(0, 0.005), (1000, 0.025)])
@pytest.mark.parametrize("period", [0.05, 0.02])
def test_work_that_can_wait_comes_after_a_tenth_of_the_period_and_gives_way_until_half_of_it(
    state_at: StateAt, samples: dict[str, Message], waiting: int, at: float, period: float
) -> None:
    """The action is on the bus then; messages that arrive come first, but not for ever."""
    clock = Clock()
    node = Listening(clock)
    fleet = Fleet(state_at, lockstep=False, node=node, clock=clock)
    fleet.state(0, period=period)
    for _ in range(waiting):
        fleet.bus.publish(FINDING, "r", samples["finding"])
    fleet.latent(0)
    assert fleet.nominal_ticks() == [("r", 0)]
    assert node.after == []
    while clock.now < 100.0 + period:
        fleet.wait(0.0005)
    assert node.after == [pytest.approx(100.0 + at * period / 0.05, abs=6e-4)]


def test_work_that_can_wait_is_done_before_the_next_tick_however_busy_the_bus_is(state_at, samples):
    clock = Clock()
    node = Listening(clock)
    fleet = Fleet(state_at, lockstep=False, node=node, clock=clock)
    for _ in range(200):
        fleet.bus.publish(FINDING, "r", samples["finding"])
    for tick in range(3):
        fleet.state(tick)
        fleet.latent(tick)
        clock.now += 0.02
    assert node.after == pytest.approx([100.02, 100.04])


def test_work_that_can_wait_follows_its_step_and_comes_once(state_at: StateAt) -> None:
    class Prompt(Lingering):
        defers_afterwards: ClassVar = False

    clock = Clock()
    fleet = Fleet(state_at, lockstep=False, node=Prompt(clock), clock=clock)
    fleet.state(0)
    assert fleet.node.after == []
    fleet.latent(0)
    fleet.wait(0.02)
    assert fleet.node.after == [100.0]


def test_a_loop_sleeps_until_the_next_moment_at_which_it_has_work(state_at: StateAt) -> None:
    """At a period of 0.05 s it waits for a missing latent until 0.01 s; here it comes at once, and all is done."""
    clock = Clock()
    fleet = Fleet(state_at, lockstep=False, node=Lingering(clock), clock=clock)
    fleet.state(0)
    assert fleet.loop.wait_time(1.0) == pytest.approx(0.01)
    fleet.latent(0)
    assert fleet.loop.wait_time(1.0) == pytest.approx(0.005), "for the work that can wait"
    fleet.wait(0.006)
    assert fleet.node.after == [pytest.approx(100.006)]
    assert fleet.loop.wait_time(1.0) > 0.1, "until the next heartbeat"


class Taking(FixedPolicy):
    """Steps that take ``seconds`` each; records how many actions were on the bus when it began one, and afterwards."""

    defers_afterwards: ClassVar = False

    def __init__(self, seconds: float, clock: Clock) -> None:
        super().__init__()
        self.seconds, self.clock = seconds, clock
        self.nominal_ticks: Callable[[], list[tuple[str, int]]] = list
        self.out, self.before, self.after = 0, list[int](), list[int]()

    def on_the_bus(self) -> int:
        self.out += len(self.nominal_ticks())
        return self.out

    def step(self, robot: str, state: StateMessage, inputs: Inputs) -> Outputs:
        self.before.append(self.on_the_bus())
        self.clock.now += self.seconds
        return super().step(robot, state, inputs)

    def afterwards(self, robot: str) -> Outputs:
        self.after.append(self.on_the_bus())
        return {}


@pytest.mark.parametrize(("seconds", "together"), [(0.0, 6), (0.002, 3), (0.006, 1)])
def test_an_action_waits_for_those_of_other_robots_five_milliseconds_at_most(state_at, seconds, together):
    """Of six robots that speak at one moment; the work that can wait comes when all actions are on the bus."""
    clock = Clock()
    node = Taking(seconds, clock)
    fleet = Fleet(state_at, lockstep=False, node=node, clock=clock)
    node.nominal_ticks = fleet.nominal_ticks
    fleet.loop.quantum = 0.005
    fleet.at_one_moment(f"r{number}" for number in range(6))
    fleet.loop.serve(0.0)
    assert node.before == [together * (number // together) for number in range(6)]
    clock.now += 0.06
    fleet.loop.serve(0.0)
    assert node.after == [6] * 6


def test_of_robots_that_speak_at_one_moment_those_that_do_not_wait_are_served_first(real_time: Fleet) -> None:
    """A robot in lockstep waits for its action, the others drive on."""
    for robot, lockstep in (("a", True), ("b", False), ("c", True), ("d", False)):
        real_time.lockstep = lockstep
        real_time.at_one_moment([robot])
    real_time.loop.turn(0.0)
    assert [robot for robot, _ in real_time.nominal_ticks()] == ["b", "d", "a", "c"]


def test_everything_published_in_a_turn_is_on_the_bus_when_it_ends(real_time: Fleet) -> None:
    """While batches are made, messages wait for the others of this turn, and for nothing else."""
    names = [f"r{number}" for number in range(9)]
    for tick in range(3):
        real_time.loop.quantum = 0.005
        real_time.clock.now += 0.3
        real_time.at_one_moment(names, tick, period=0.05)
        real_time.loop.serve(0.0)
        assert sorted(real_time.nominal_ticks()) == [(name, tick) for name in names]
        assert {item.robot for item in real_time.healths.take(0.0)} == set(names)
    real_time.clock.now += 0.3  # they fall silent
    real_time.loop.turn(0.0)
    real_time.healths.take(0.0)
    real_time.clock.now += 0.3
    real_time.loop.turn(0.0)
    assert {item.robot for item in real_time.healths.take(0.0)} == set(names)


@pytest.mark.parametrize(("bundled", "keys"), [(False, {"r1", "r2"}), (True, {"+"})])
def test_an_action_travels_alone_unless_the_state_came_in_a_bundle(bundled, keys, state_at, samples):
    """A robot that may not read what is sent to others never gets a bundle; who shows verdicts may."""

    class Deciding(FixedPolicy):
        inputs: ClassVar[tuple[Topic, ...]] = ()
        outputs: ClassVar = (ACTION, VERDICT)

        def step(self, robot: str, state: StateMessage, inputs: Inputs) -> Outputs:
            action = ActionMessage(**stamp(state.tick, state.epoch), values=(0.0, 0.0))
            return {ACTION: action, VERDICT: samples["verdict"]}

    fleet = Fleet(state_at, lockstep=False, node=Deciding())
    seen: dict[str, set[str]] = {"action": set(), "verdict": set()}
    for topic, robots in seen.items():
        fleet.transport.subscribe(f"safedpa/test/*/{topic}", lambda key, _, into=robots: into.add(key.split("/")[2]))
    fleet.loop.quantum = 0.005
    if bundled:
        fleet.bus.hold()
    for robot in ("r1", "r2"):
        fleet.bus.publish(STATE, robot, state_at(0, epoch=EPOCH, lockstep=False, period=0.05))
    fleet.bus.flush()
    fleet.loop.serve(0.0)
    assert seen == {"action": keys, "verdict": {"+"}}


@pytest.mark.parametrize(("apart", "lockstep", "all_taken"), [
    (0.05, False, True), (0.04, False, True), (0.005, False, False), (0.0, False, False), (0.0, True, True),
])  # fmt: skip
def test_states_that_come_far_faster_than_their_period_are_refused_except_in_lockstep(
    apart: float, lockstep: bool, all_taken: bool, state_at: StateAt
) -> None:
    """Sixty at a period of 0.05 s: of those that come ten times as fast a few are taken."""
    fleet = Fleet(state_at, lockstep=lockstep)
    for tick in range(60):
        fleet.clock.now += apart
        fleet.state(tick)
        fleet.latent(tick)
    steps, health = len(fleet.node.steps), fleet.health()["r"]
    assert health.refused == 60 - steps
    assert (steps == 60) is all_taken
    assert all_taken or 10 <= steps < 40
    assert all_taken or "much faster than their period" in health.detail


def test_an_output_says_which_step_it_is_of_and_what_was_consumed_and_skipped(lockstep: Fleet) -> None:
    """A state whose input never came is shown to the node; the next one that is stepped names its tick."""
    lockstep.state(5)
    lockstep.state(6)
    lockstep.latent(6)
    lockstep.latent(7)
    lockstep.state(7)
    nominal_actions = [item.message for item in lockstep.nominal_actions.take(0.0) if isinstance(item, ReceivedMessage)]
    assert all(isinstance(nominal, NominalMessage) for nominal in nominal_actions)
    assert [(nominal.step, nominal.skipped, nominal.consumed) for nominal in nominal_actions] == [
        (1, (5.0,), ((0.0, 0.0),)),
        (2, (), ((0.0, 0.0),)),
    ]


@pytest.mark.parametrize(
    ("heard", "tick", "consumed"), [(None, 5, (-1.0, 0.0)), (5, 5, (0.0, 7.5)), (4, 5, (1.0, 7.5)), (2, 5, (3.0, 0.0))]
)
def test_an_output_names_the_age_and_the_publish_time_of_its_inputs(heard, tick, consumed, state_at):
    """A stale input has its age alone, and one that never came the age -1."""

    class Patient(FixedPolicy):
        slack: ClassVar = {LATENT: 1}

    fleet = Fleet(state_at, lockstep=False, node=Patient())
    fleet.state(0)
    if heard is not None:
        fleet.bus.publish(LATENT, "r", dataclasses.replace(latent_of(heard), publish_time=7.5))
    fleet.state(tick)
    fleet.wait(0.02)
    (*_, nominal) = fleet.nominal_actions.take(0.0)
    assert isinstance(nominal, ReceivedMessage)
    assert (nominal.message.tick, nominal.message.consumed) == (tick, (consumed,))


def test_a_robot_that_claims_a_period_below_a_millisecond_is_served_as_one_of_a_millisecond(state_at: StateAt) -> None:
    fleet = Fleet(state_at, lockstep=False)
    for tick in range(100):
        fleet.clock.now += 0.0001
        fleet.at_one_moment(["r"], tick, period=1e-6)
        fleet.loop.turn(0.0)
    assert 25 <= len(fleet.node.steps) <= 35


def test_new_robots_and_rejected_messages_are_logged(state_at: StateAt) -> None:
    events = list[tuple[str, str]]()
    service_log = ServiceLog("policy", lambda kind, _, **about: events.append((kind, about["robot"])))
    fleet = Fleet(state_at, lockstep=True, service_log=service_log)
    fleet.state(5)
    fleet.state(4)
    fleet.state(0, epoch=EPOCH + 1)
    fleet.clock.now += 1.0
    fleet.state(0, epoch=EPOCH + 1)
    fleet.wait(31.0)
    assert events == [(kind, "r") for kind in (
        "robot.met", "message.refused", "robot.second_refused", "robot.restarted", "robot.forgotten",
    )]  # fmt: skip


@pytest.mark.parametrize("known", [False, True])
def test_the_setup_is_published_at_once_and_every_five_seconds(known: bool, state_at: StateAt) -> None:
    setup = setup_message("policy", {}) if known else None
    fleet = Fleet(state_at, lockstep=True, setup=setup)
    heard = fleet.bus.inbox((SETUP,), keep_all=True)
    published = list[float]()
    for quarter in range(48):
        fleet.clock.now = 100.0 + 0.25 * quarter
        fleet.loop.turn(0.0)
        published += [fleet.clock.now - 100.0 for item in heard.take(0.0) if isinstance(item, ReceivedMessage)]
    assert published == ([0.0, 5.0, 10.0] if known else [])
    fleet.state(0)
    fleet.wait(0.26)
    assert len(heard.take(0.0)) == int(known), "a recording of a new robot has it from the first seconds on"
