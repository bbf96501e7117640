"""Processes that die, are paused, or hang."""

from __future__ import annotations

import signal
import time

from safedpa.bus import NO_ROBOT
from safedpa_lab.faults.fault import Fault, Look, Work, meanwhile_of, nothing_to_see
from safedpa_lab.faults.sabotaged import GO_ON, GRIP, GRIPPED_SECONDS, HANG
from safedpa_lab.faults.world import LOOP, ROBOT, SERVICES, Member, World

_EVERYONE = (*SERVICES, "robot", "router")
_PAUSE_SECONDS = 2.0
_START_SECONDS = 20.0
_INTO_THE_PERIOD_SECONDS = 0.02
"""Of 0.05 s; the action is there after a few milliseconds and acts after 0.045 s."""
_SILENT_SECONDS = 0.75
"""Three heartbeats."""


def killed() -> list[Fault]:
    """SIGKILL of each process, and at once a new one; of all three of the loop; of the filter again and again."""
    faults = [
        Fault(
            f"kill {name}",
            f"SIGKILL of {name}; a new one is started at once",
            strike=_restart(name),
            meanwhile=meanwhile_of(name),
            small=name == "safety_filter",
        )
        for name in _EVERYONE
    ]
    return [
        *faults,
        Fault(
            "kill loop", "SIGKILL of adaptation, policy and safety_filter together; new ones at once", _restart(*LOOP)
        ),
    ]


def paused() -> list[Fault]:
    """SIGSTOP of each process, SIGCONT two seconds later."""
    return [
        Fault(
            f"stop {name}",
            f"SIGSTOP of {name} for {_PAUSE_SECONDS:.0f} s",
            strike=_stop_with_an_action if name == "robot" else _send(name, signal.SIGSTOP),
            repair=_send(name, signal.SIGCONT),
            seconds=_PAUSE_SECONDS,
            look=nothing_to_see if name == "router" else _shows(name, alive=False),
            meanwhile=meanwhile_of(name),
            small=name == "robot",
        )
        for name in _EVERYONE
    ]


def twins() -> list[Fault]:
    """A service that was taken for dead and replaced wakes up: two of them speak."""
    return [_twin(name) for name in LOOP]


def _twin(name: str) -> Fault:
    twins: list[Member] = []

    def strike(world: World) -> None:
        world.members[name].send(signal.SIGSTOP)
        twins.append(world.twin_of(name))
        twins[-1].start()
        world.until(lambda: world.observer.health[name][0].pid == twins[-1].pid, _START_SECONDS)
        world.members[name].send(signal.SIGCONT)

    def repair(_world: World) -> None:
        twins.pop().kill()

    sentence = f"{name} is paused and replaced, wakes up, and both serve the robot for {_PAUSE_SECONDS:.0f} s"
    return Fault(f"twin {name}", sentence, strike, repair=repair, seconds=_PAUSE_SECONDS)


def hung() -> list[Fault]:
    """Loops that make no progress while their process lives: only the heartbeat shows it."""
    faults = [
        Fault(
            f"hang {name}",
            f"the loop of {name} hangs for {_PAUSE_SECONDS:.0f} s, its network threads live on",
            strike=_send(name, HANG),
            repair=_send(name, GO_ON),
            seconds=_PAUSE_SECONDS,
            look=_shows(name, alive=True),
            meanwhile=meanwhile_of(name),
            small=name == "safety_filter",
        )
        for name in SERVICES
    ]
    faults += [
        Fault(
            f"grip {name}",
            f"a C call of {name} keeps the interpreter's lock for {GRIPPED_SECONDS} s",
            strike=_send(name, GRIP),
            seconds=float(GRIPPED_SECONDS),
            meanwhile=meanwhile_of(name),
        )
        for name in ("policy", "safety_filter", "recorder")
    ]
    return faults


def _restart(*names: str) -> Work:
    def restart(world: World) -> None:
        for name in names:
            world.members[name].kill()
        for name in names:
            world.members[name].start()

    return restart


def _send(name: str, number: signal.Signals) -> Work:
    return lambda world: world.members[name].send(number)


def _stop_with_an_action(world: World) -> None:
    """In the middle of a period, when the robot holds the action of this tick and has not begun to act on it."""
    before = world.observer.newest
    world.until(lambda: world.observer.newest != before, _START_SECONDS)
    world.listen(_INTO_THE_PERIOD_SECONDS)
    world.members["robot"].send(signal.SIGSTOP)


def _shows(name: str, *, alive: bool) -> Look:
    """At the height of the fault: no heartbeat, and a sign of life only where the network threads live on."""

    def look(world: World) -> str:
        silence = world.observer.silent_for(name, time.monotonic())
        if silence < _SILENT_SECONDS:
            return f"{name} reported its health {silence:.1f} s ago"
        robot = ROBOT if name == "robot" else NO_ROBOT
        if world.observer.lives(robot, name) != alive:
            return f"{name} {'shows no sign of life' if alive else 'still shows a sign of life'}"
        return ""

    return look
