"""A service loop over a bus in memory, with a clock that the test moves; the test speaks as the robots."""

from collections.abc import Callable, Iterable
from typing import Any

from safedpa.bus import (
    HEALTH,
    LATENT,
    NOMINAL,
    STATE,
    AbstractNode,
    Bus,
    HealthMessage,
    Inbox,
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
)
from safedpa.errors import MessageError

EPOCH = 8731
StateAt = Callable[..., StateMessage]


def stamp(tick: int = 0, epoch: int = EPOCH) -> dict[str, Any]:
    """The fields that every message has."""
    return {"epoch": epoch, "tick": tick, "robot_time": 0.0, "publish_time": 0.0}


def latent_of(tick: int, epoch: int = EPOCH) -> LatentMessage:
    """A latent of that tick."""
    return LatentMessage(**stamp(tick, epoch), model="m", values=(0.1,), deviations=(0.1,))


class Clock:
    """Time in seconds; a test sets ``now``."""

    def __init__(self, now: float = 100.0) -> None:
        self.now = now

    def __call__(self) -> float:
        return self.now


class Heard:
    """What a subscription delivered."""

    def __init__(self) -> None:
        self.samples: list[tuple[str, bytes]] = []

    def __call__(self, key: str, payload: bytes) -> None:
        self.samples.append((key, payload))

    @property
    def payloads(self) -> list[bytes]:
        return [payload for _, payload in self.samples]


class FixedPolicy(AbstractNode):
    """Its action names the tick; it records the calls that it gets."""

    name = "policy"
    inputs = (LATENT,)
    outputs = (NOMINAL,)
    share = 0.2

    def __init__(self) -> None:
        self.steps: list[tuple[str, int, Message | Stale]] = []
        self.forgotten: list[str] = []
        self.refuse = ""

    def step(self, robot: str, state: StateMessage, inputs: Inputs) -> Outputs:
        if robot == self.refuse:
            raise MessageError("goal: got 3 numbers, wanted 2")
        self.steps.append((robot, state.tick, inputs[LATENT]))
        return {
            NOMINAL: NominalMessage(
                **stamp(state.tick, state.epoch), values=(float(state.tick), 0.0), controller="test"
            )
        }

    def forget(self, robot: str) -> None:
        self.forgotten.append(robot)


class Fleet:
    """A node in its loop, and the robots' end of the bus."""

    def __init__(
        self, state_at: StateAt, *, lockstep: bool, node: Any = None, clock: Clock | None = None, **of_the_loop: Any
    ) -> None:
        self.broker = broker = MemoryBroker()
        self.clock: Clock = clock or Clock()
        self.node: Any = node or FixedPolicy()
        self.transport = MemoryTransport(broker)
        self.bus = Bus(self.transport, "test")
        self.released: list[str] = []
        inside = MemoryTransport(broker)
        inside.release = self.released.append  # type: ignore[method-assign]
        self.loop = ServiceLoop(self.node, Bus(inside, "test"), clock=self.clock, **of_the_loop)
        self.nominal_actions: Inbox = self.bus.inbox((NOMINAL,), keep_all=True)
        self.healths: Inbox = self.bus.inbox((HEALTH,), keep_all=True)
        self.state_at, self.lockstep = state_at, lockstep

    def state(self, tick: int, robot: str = "r", epoch: int = EPOCH, period: float = 0.05) -> None:
        """A robot publishes its state, and the loop turns once."""
        self.bus.publish(STATE, robot, self.state_at(tick, epoch=epoch, lockstep=self.lockstep, period=period))
        self.loop.turn(0.0)

    def latent(self, tick: int, robot: str = "r", epoch: int = EPOCH) -> None:
        """The adaptation publishes a latent, and the loop turns once."""
        self.bus.publish(LATENT, robot, latent_of(tick, epoch))
        self.loop.turn(0.0)

    def at_one_moment(self, robots: Iterable[str], tick: int = 0, period: float = 0.5) -> None:
        """States and latents of several robots, without a turn of the loop."""
        for robot in robots:
            self.bus.publish(STATE, robot, self.state_at(tick, epoch=EPOCH, lockstep=self.lockstep, period=period))
            self.bus.publish(LATENT, robot, latent_of(tick))

    def wait(self, seconds: float) -> None:
        """Time passes, and the loop turns once."""
        self.clock.now += seconds
        self.loop.turn(0.0)

    def nominal_ticks(self) -> list[tuple[str, int]]:
        """Robot and tick of every action since the last call."""
        return [
            (item.robot, item.message.tick)
            for item in self.nominal_actions.take(0.0)
            if isinstance(item, ReceivedMessage)
        ]

    def health(self) -> dict[str, HealthMessage]:
        """The next heartbeat, by robot."""
        self.healths.take(0.0)
        self.wait(0.26)
        items = [item for item in self.healths.take(0.0) if isinstance(item, ReceivedMessage)]
        return {item.robot: item.message for item in items if isinstance(item.message, HealthMessage)}
