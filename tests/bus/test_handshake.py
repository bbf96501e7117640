"""A service asks for a robot's model before it serves the robot, and does not wait long."""

import dataclasses
from collections.abc import Callable
from typing import Any, ClassVar

import pytest
from tests.bus.fleet import Clock, latent_of, stamp

from safedpa.bus import (
    HEALTH,
    LATENT,
    MODEL,
    NOMINAL,
    STATE,
    TAKEOVER,
    AbstractNode,
    Answer,
    Bus,
    Inbox,
    Inputs,
    LatentMessage,
    MemoryTransport,
    Message,
    ModelMessage,
    NominalMessage,
    Outputs,
    ReceivedMessage,
    Request,
    ServiceLoop,
    StateMessage,
    TakeoverMessage,
    Topic,
)
from safedpa.bus.service.handshake import ModelHandshake
from safedpa.bus.transport.inbox import RequestOutcome
from safedpa.errors import InputError


class Curious(AbstractNode):
    """Records the calls that it received, in order."""

    name = "policy"
    inputs = (LATENT,)
    outputs = (NOMINAL, TAKEOVER)
    listens: ClassVar[tuple[Topic, ...]] = (MODEL,)
    share = 0.2

    def __init__(self) -> None:
        self.reported: list[Any] = []

    def step(self, robot: str, state: StateMessage, inputs: Inputs) -> Outputs:
        self.reported.append((robot, state.tick, isinstance(inputs[LATENT], LatentMessage)))
        of_state = stamp(state.tick, state.epoch)
        takeover = TakeoverMessage(**of_state, service="policy", change=1, fingerprint="x", state="ready")
        return {NOMINAL: NominalMessage(**of_state, values=(0.0, 0.0), controller="test"), TAKEOVER: takeover}

    def hear(self, robot: str, message: Message) -> None:
        assert isinstance(message, ModelMessage)
        if message.change == 13:
            raise InputError("change 13: unlucky")
        self.reported.append((robot, message.step, message.change))

    def adopt_model(self, robot: str, status: Answer | None) -> None:
        self.reported.append((robot, None if status is None else status.fingerprint))

    def model_of(self, robot: str) -> str:
        return f"model of {robot}"


class Indifferent(Curious):
    listens = ()


class SlowBus(Bus):
    """Answers come when the test says so."""

    def ask_model(self, inbox: Any, robot: str, who: str, timeout: float) -> None:
        self.asked = (inbox, robot, who)


@pytest.fixture
def clock() -> Clock:
    return Clock(0.0)


@pytest.fixture
def service(memory_bus: Callable[[], Bus], clock: Clock) -> tuple[Curious, ServiceLoop, Bus]:
    node = Curious()
    return node, ServiceLoop(node, memory_bus(), clock=clock), memory_bus()


def spoken(robot: Bus, loop: ServiceLoop, state: StateMessage) -> None:
    """Its state and the latent of that tick, and a turn of the loop."""
    robot.publish(STATE, "r", state)
    robot.publish(LATENT, "r", latent_of(state.tick, state.epoch))
    loop.turn(0.0)


def test_it_asks_once_before_the_first_step(service: Any, memory_bus: Any, state_at: Any, samples: Any) -> None:
    node, loop, robot = service
    asked = []

    def answer(name: str, request: Request) -> Answer:
        asked.append((name, request))
        return Answer(ok=True, sentence="", fingerprint="agreed")

    memory_bus().answer_requests(answer)
    for tick in range(3):
        spoken(robot, loop, state_at(tick))
    assert asked == [("r", Request(do="status", who="policy"))]
    assert node.reported == [("r", "agreed"), ("r", 0, True), ("r", 1, True), ("r", 2, True)]


def test_without_a_diagnosis_other_services_report_the_agreed_model(service, memory_bus, state_at, samples):
    node, loop, robot = service
    memory_bus().answer_agreed(lambda name: None)
    memory_bus().answer_agreed(lambda name: Answer(ok=True, sentence="", fingerprint=f"of {name}"))
    memory_bus().answer_requests(lambda name, request: Answer(ok=False, sentence="refused: not known"))
    spoken(robot, loop, state_at(0))
    assert node.reported == [("r", "of r"), ("r", 0, True)]


def test_without_a_diagnosis_it_serves_at_once(service: Any, state_at: Any, samples: Any) -> None:
    node, loop, robot = service
    spoken(robot, loop, state_at(0))
    assert node.reported == [("r", None), ("r", 0, True)]


def test_messages_that_came_while_it_waited_are_not_lost(broker: Any, clock: Clock, state_at: Any, samples: Any):
    node, bus = Curious(), SlowBus(MemoryTransport(broker), "test")
    loop, robot = ServiceLoop(node, bus, clock=clock), Bus(MemoryTransport(broker), "test")
    for tick in range(2):
        spoken(robot, loop, state_at(tick))
    assert node.reported == [], "it is still waiting"
    inbox, *asked = bus.asked
    assert asked == ["r", "policy"]
    inbox.keep_answer(RequestOutcome("r", Answer(ok=True, sentence="", fingerprint="agreed")))
    loop.turn(0.0)
    assert node.reported == [("r", "agreed"), ("r", 1, True)], "the newest tick, with its input"


class Asked:
    """In place of a bus: the robots about which it was asked, and how long the answer may take."""

    def __init__(self) -> None:
        self.about: list[tuple[str, float]] = []

    def answer_agreed(self, _: object) -> None:
        pass

    def ask_model(self, _: Inbox, robot: str, __: str, timeout: float) -> None:
        self.about.append((robot, timeout))


def received(topic: Topic, message: Any, robot: str = "r") -> ReceivedMessage:
    return ReceivedMessage(topic, robot, message, b"", f"safedpa/f/{robot}/{topic.name}", 0.0)


@pytest.mark.parametrize(("answered_at", "served_at"), [(0.0, 0.0), (0.5, 0.5), (None, 0.9)])
def test_a_robot_waits_for_the_answer_or_for_nine_tenths_of_a_second(answered_at, served_at, state_at, samples, clock):
    """The newest message of each topic waits, the state first; later messages do not wait, until the robot leaves."""
    node, bus, inbox = Curious(), Asked(), Inbox()
    handshake_ = ModelHandshake(node, bus, inbox, clock, lambda *_: None)  # type: ignore[arg-type]
    latent = received(LATENT, latent_of(2, state_at(2).epoch))
    assert handshake_.deadline() == float("inf")
    assert not handshake_.holds(latent), "a robot is met by its state"
    older, newer, other = (received(STATE, state_at(tick), robot) for tick, robot in ((1, "r"), (2, "r"), (1, "q")))
    assert all(handshake_.holds(item) for item in (older, newer, latent, other))
    assert [robot for robot, _ in bus.about] == ["r", "q"]
    assert all(0.1 <= timeout <= 0.5 for _, timeout in bus.about)
    assert handshake_.deadline() == pytest.approx(0.9)
    served: list[ReceivedMessage] = []
    while not served and clock.now < 5.0:
        if answered_at is not None and clock.now >= answered_at:
            inbox.keep_answer(RequestOutcome("r", Answer(ok=True, sentence="", fingerprint="a")))
        served = handshake_.ready()
        clock.now += 0.0 if served else 0.05
    assert served == ([newer, latent] if answered_at is not None else [newer, latent, other])
    assert clock.now == pytest.approx(served_at, abs=0.051)
    assert node.reported[0] == ("r", None if answered_at is None else "a")
    assert not handshake_.holds(received(STATE, state_at(3)))
    assert not handshake_.holds(latent)
    assert handshake_.ready() == []
    assert handshake_.holds(other) is (answered_at is not None), "an answer about one robot is none about another"
    handshake_.forget("r")
    assert handshake_.holds(received(STATE, state_at(4)))
    assert [robot for robot, _ in bus.about] == ["r", "q", "r"]


def test_without_any_answer_the_loop_wakes_up_when_the_patience_ends(broker: Any, clock: Clock, state_at: Any) -> None:
    node = Curious()
    loop = ServiceLoop(node, SlowBus(MemoryTransport(broker), "test"), clock=clock)
    Bus(MemoryTransport(broker), "test").publish(STATE, "r", state_at(0, lockstep=False))
    loop.turn(0.0)
    clock.now = 0.8
    loop.turn(0.0)
    assert loop.wait_time(1.0) == pytest.approx(0.1)
    for clock.now in (0.91, 1.0):
        loop.turn(0.0)
    assert node.reported == [("r", None), ("r", 0, False)]


def test_a_robot_that_left_is_asked_for_again(service: Any, clock: Clock, state_at: Any, samples: Any) -> None:
    node, loop, robot = service
    for epoch in (1, 2):
        state = state_at(0, epoch=epoch)
        spoken(robot, loop, state)
        clock.now += 40.0
        loop.turn(0.0)
    assert node.reported == [("r", None), ("r", 0, True)] * 2


def test_a_node_that_holds_no_model_asks_for_none(broker: Any, clock: Clock, state_at: Any, samples: Any) -> None:
    node = Indifferent()
    loop = ServiceLoop(node, SlowBus(MemoryTransport(broker), "test"), clock=clock)
    robot = Bus(MemoryTransport(broker), "test")
    spoken(robot, loop, state_at(0))
    assert node.reported == [("r", 0, True)]


def test_changes_are_heard_in_order_of_any_tick_and_a_refused_one_is_counted(service, memory_bus, state_at, samples):
    node, loop, robot = service
    for change in (1, 13, 2):
        robot.publish(MODEL, "r", dataclasses.replace(samples["model"], change=change, tick=0))
    loop.turn(0.0)
    assert node.reported == [("r", "offer", 1), ("r", "offer", 2)]


def test_answers_go_out_under_the_service_s_name_and_health_names_the_model(
    service: Any, memory_bus: Any, clock: Clock, state_at: Any, samples: Any
) -> None:
    _, loop, robot = service
    inbox = memory_bus().inbox((TAKEOVER, HEALTH), keep_all=True)
    spoken(robot, loop, state_at(0))
    clock.now = 1.0
    loop.turn(0.0)
    received = {item.key: item.message for item in inbox.take(0.0)}
    assert received["safedpa/test/r/takeover/policy"].state == "ready"
    assert received["safedpa/test/r/health/policy"].model == "model of r"
