"""Simulated robots whose measured state is wrong, in ways that users of robots report again and again.

``FaultyState`` stands between a simulated robot and the bus: the simulation goes on with the truth, and the messages
have what a failed sensor, driver or clock would send. ``TRUTHS`` makes the five robots in healthy worlds.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from math import cos, isnan, nan, sin
from typing import Any, Final, final

import numpy as np

from safedpa.adaptation import AdaptationNode
from safedpa.bus import (
    ACTION,
    LATENT,
    NOMINAL,
    VERDICT,
    AbstractNode,
    ActionMessage,
    LatentMessage,
    NominalMessage,
    ScanMessage,
    Stale,
    StateMessage,
    Topic,
    VerdictMessage,
)
from safedpa.dynamics import load_model
from safedpa.policy import PolicyNode
from safedpa.runtime.node import SafetyFilterNode
from safedpa.safety.defaults import margin_for, settings_named
from safedpa.safety.session.state_limits import StateLimits
from safedpa.systems import System
from safedpa.systems.robots import robot_named
from safedpa_lab.experiments.common.drives import LOADS, PERIOD
from safedpa_sim.closed_loop import Tick
from safedpa_sim.differential_drive.stand_in import WORLDS
from safedpa_sim.robots.car.parameters import THROTTLE_CAR
from safedpa_sim.robots.car.robot import CarRobot, DelayedCommands
from safedpa_sim.robots.car.scene import Scene
from safedpa_sim.robots.pendulum.robot import PendulumRobot, task_named
from safedpa_sim.robots.pendulum.world import wind_towards
from safedpa_sim.robots.robot import SimulatedRobot
from safedpa_sim.robots.stand_in_robot import StandInRobot

__all__ = ["FAULTS", "NOISE", "ROBOTS", "FaultyState", "StateFault", "TrueRobot", "drive_directly"]

Plain = tuple[float, ...]

NOISE: Final[Mapping[str, float]] = {"m": 0.01, "rad": 0.01, "m/s": 0.02, "rad/s": 0.02}
"""Standard deviation of healthy noise, by unit."""


@final
@dataclass(frozen=True)
class StateFault:
    """A fault of the measured state from a moment on."""

    kind: str
    """``none``, ``jump``, ``restart``, ``frozen``, ``frozen at rest``, ``drift``, ``frame``, ``clock`` or ``lost``."""
    size: float = 0.0
    """Of a jump [m], a drift [m/s], a clock (its rate), or a loss [s]."""
    begin: float = 2.0
    """s; a state that is frozen at rest is so from the start."""

    @property
    def name(self) -> str:
        """With its size."""
        return f"{self.kind} {self.size:g}" if self.size else self.kind

    @property
    def reasons(self) -> tuple[str, ...]:
        """Parts of the reasons that are right for it."""
        return {
            "jump": ("jumped",),
            "restart": ("jumped",),
            "frozen": ("does not change", "its rates differ"),
            "frozen at rest": ("does not change", "its rates differ"),
            "drift": ("its rates differ",),
            "frame": ("jumped", "its rates differ"),
            "clock": ("stamps advance",),
        }.get(self.kind, ())


FAULTS: Final = (
    *(StateFault("jump", size) for size in (0.3, 0.5, 0.8, 2.0)),
    StateFault("restart"),
    StateFault("frozen"),
    StateFault("frozen at rest"),
    StateFault("drift", 0.05),
    StateFault("frame"),
    *(StateFault("clock", rate) for rate in (0.3, 3.0)),
)


@final
class FaultyState:
    """A simulated robot whose state messages have a fault, noise, and lost states."""

    def __init__(
        self,
        robot: SimulatedRobot,
        system: System,
        fault: StateFault,
        seed: int,
        noise: float = 1.0,
        lost_share: float = 0.0,
    ) -> None:
        self.robot, self._system, self._fault = robot, system, fault
        self._draw = np.random.default_rng([seed, 91])
        self._noise = noise * np.array([NOISE.get(each.unit, 0.0) for each in system.state])
        self._lost_share = lost_share
        self._angle = float(self._draw.uniform(-np.pi, np.pi))
        self._places = [index for index, each in enumerate(system.state) if each.unit == "m"] or [0]
        self._yaw = next((index for index, each in enumerate(system.state) if each.angle and index > 1), None)
        self._held: Plain = ()
        self._reference: Plain = ()

    def scans(self) -> Sequence[ScanMessage]:
        """The scans of the robot."""
        return self.robot.scans()

    def receive(self, message: ActionMessage) -> str | None:
        """Passes the action on."""
        return self.robot.receive(message)

    def advance(self) -> None:
        """Simulates one period of the truth."""
        self.robot.advance()

    def is_faulty_at(self, tick: int) -> bool:
        """Whether the fault has begun at this tick."""
        return self._fault.kind != "none" and tick * self.robot.period >= self._begin

    @property
    def _begin(self) -> float:
        return 0.0 if self._fault.kind == "frozen at rest" else self._fault.begin

    @property
    def _seconds(self) -> float:
        return self.robot.tick * self.robot.period

    def state_message(self) -> StateMessage:
        """The state of this tick as the failed source sends it."""
        truth = self.robot.state_message()
        noisy = tuple((np.array(truth.values) + self._noise * self._draw.normal(size=len(self._noise))).tolist())
        lost = self._draw.uniform() < self._lost_share
        values = self._measured(noisy) if self.is_faulty_at(self.robot.tick) else noisy
        changed: dict[str, Any] = {"values": (nan,) * len(values) if lost else values}
        if self._fault.kind == "clock":
            # A simulated clock that runs at another rate: its stamps are those of the ticks, the arrivals are not.
            changed |= {"lockstep": False, "publish_time": self.arrival()}
        return replace(truth, **changed)

    def arrival(self, ahead: int = 0) -> float:
        """When the state of this tick, or one ``ahead`` ticks later, arrives [s], by the clock of its receiver."""
        seconds = (self.robot.tick + ahead) * self.robot.period
        late = max(0.0, seconds - self._begin) if self._fault.kind == "clock" else 0.0
        return 1000.0 + seconds - late + (late / self._fault.size if late else 0.0)

    def _measured(self, values: Plain) -> Plain:
        kind, found = self._fault.kind, list(values)
        self._reference = self._reference or values
        late = self._seconds - self._begin
        if kind in ("frozen", "frozen at rest"):
            self._held = self._held or values
            return self._held
        if kind == "lost":
            return (nan,) * len(values) if late < self._fault.size else values
        if kind in ("jump", "drift"):
            size = self._fault.size * (1.0 if kind == "jump" else late)
            found[self._places[0]] += size * (cos(self._angle) if len(self._places) > 1 else 1.0)
            if len(self._places) > 1:
                found[self._places[1]] += size * sin(self._angle)
            return tuple(found)
        if kind in ("restart", "frame") and self._yaw is not None:
            turn = -self._reference[self._yaw] if kind == "restart" else 0.5 * np.pi
            origin = self._reference if kind == "restart" else (0.0, 0.0)
            x, y = values[0] - origin[0], values[1] - origin[1]
            found[0], found[1] = cos(turn) * x - sin(turn) * y, sin(turn) * x + cos(turn) * y
            # A restarted driver turns its whole frame; in a wrong frame the heading is still the compass's.
            found[self._yaw] += turn if kind == "restart" else 0.0
        elif kind in ("restart", "frame"):
            found[self._places[0]] -= self._reference[self._places[0]]
        return tuple(found)


@final
@dataclass(frozen=True)
class TrueRobot:
    """One kind of robot in the laboratory: how it is made, and the nodes that drive it."""

    name: str
    model: str
    settings: str
    worlds: tuple[str, ...]
    make: Callable[[str, int], SimulatedRobot]
    make_late: Callable[[str, int, float], SimulatedRobot] | None = None
    """The same with commands that act later by a time [s] that the filter does not know."""
    stops: bool = True
    """Whether its backup brings it to rest."""
    ros: str = ""
    """Its kind in a robot file of the ROS gateway; empty: it has no ROS interface."""

    def nodes(self, limits: StateLimits | str | None = None) -> list[AbstractNode]:
        """Adaptation, policy and filter as they ship, with these limits of a plausible state."""
        model = load_model(self.model)
        filtering = SafetyFilterNode(model, settings_named(self.settings), margin_for(model), limits=limits)
        return [AdaptationNode(model), PolicyNode(model), filtering]

    @property
    def system(self) -> System:
        """Names and units of its state."""
        return load_model(self.model).system


def _differential_drive(world: str, seed: int) -> SimulatedRobot:
    robot = robot_named("differential_drive")
    return StandInRobot(robot, load_model(str(robot.model)).period, seed, WORLDS[world])


def _point(world: str, seed: int) -> SimulatedRobot:
    from safedpa_sim.robots.point_robot import PointRobot, force_towards

    return PointRobot(force_towards(float(world), 37.0 * seed), seed)


def _throttle(world: str, seed: int, late: float = 0.0) -> SimulatedRobot:
    del world
    return CarRobot(Scene.random(seed), PERIOD, parameters=THROTTLE_CAR, late=DelayedCommands(late, late))


def _car(world: str, seed: int, late: float = 0.0) -> SimulatedRobot:
    return CarRobot(Scene.random(seed, world), PERIOD, late=DelayedCommands(late, late))


ROBOTS: Final[Mapping[str, TrueRobot]] = {
    each.name: each
    for each in (
        TrueRobot("car", "car", "car", LOADS, _car, _car, ros="car"),
        TrueRobot("car_throttle", "dart_car", "car_throttle", ("none",), _throttle, _throttle, ros="car"),
        TrueRobot(
            "differential_drive",
            "differential_drive",
            "differential_drive",
            tuple(WORLDS),
            _differential_drive,
            ros="differential_drive",
        ),
        TrueRobot("point", "point", "point", ("0", "0.01"), _point),
        TrueRobot(
            "pendulum",
            "pendulum",
            "pendulum",
            ("0", "3"),
            lambda wind, seed: PendulumRobot(task_named("balance"), wind_towards(float(wind), 53.0 * seed), seed),
            stops=False,
        ),
    )
}


def drive_directly(
    robot: FaultyState,
    nodes: Sequence[AbstractNode],
    ticks: int,
    is_missed: Callable[[int], bool] = lambda _: False,
    hear: Callable[[LatentMessage], None] = lambda _: None,
) -> Iterator[Tick]:
    """As ``drive``, without a bus, so that the filter's session gets lost states too (a bus carries none).

    Without a state, adaptation and policy repeat their last answers. In ticks that are missed no node gets the state,
    as on a busy machine or while a process is suspended, and the robot's watchdog brakes. ``hear`` gets each latent.
    """
    adaptation, policy, filtering = nodes
    latent: LatentMessage | None = None
    nominal: NominalMessage | None = None
    for tick in range(ticks):
        state = robot.state_message()
        if is_missed(tick):
            robot.advance()
            continue
        if not isnan(sum(state.values)):
            found = adaptation.step("r", state, {})[LATENT]
            assert isinstance(found, LatentMessage)
            latent = found
            hear(latent)
            asked = policy.step("r", state, {LATENT: latent})[NOMINAL]
            assert isinstance(asked, NominalMessage)
            nominal = asked
            adaptation.afterwards("r")
        stamp: dict[str, Any] = {"tick": state.tick, "robot_time": state.robot_time}
        inputs: dict[Topic, Any] = {
            LATENT: Stale(LATENT, None) if latent is None else replace(latent, **stamp),
            NOMINAL: Stale(NOMINAL, None) if nominal is None else replace(nominal, **stamp),
        }
        action = filtering.step("r", state, inputs)[ACTION]
        verdict = filtering.afterwards("r")[VERDICT]
        assert isinstance(action, ActionMessage)
        assert isinstance(verdict, VerdictMessage)
        refusal = robot.receive(action)
        robot.advance()
        yield Tick(state, verdict, refusal)
