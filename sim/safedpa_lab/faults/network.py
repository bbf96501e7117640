"""Links that lose, delay, be stationary or break, bent in the proxy between a process and the router."""

from __future__ import annotations

from dataclasses import replace

from safedpa_lab.faults.conduct import CUT, HALF_OPEN, PASS, STALLED, Conduct, bursts, delayed, losing, slow
from safedpa_lab.faults.fault import Fault, Meanwhile, Work
from safedpa_lab.faults.world import SERVICES

__all__ = ["bent", "cut", "disconnected"]

_LINKS = (*SERVICES, "robot")
_ALONGSIDE = ("diagnosis", "recorder")
_PARTITION_SECONDS = 3.0
_CUT_SECONDS = 1.0
_LOSS = 0.3
_BEND_SECONDS = 4.0
_PAUSE = "0.3 s in every second, and then hands on what waited"


def disconnected() -> list[Fault]:
    """Every process without a network for three seconds; no one is informed, and what was sent meanwhile waits."""
    faults = [
        _bend(f"disconnect {name}", f"{name} has no network", STALLED, _PARTITION_SECONDS, _meanwhile(name), name)
        for name in _LINKS
    ]
    faults[-1] = _small(faults[-1])
    return [*faults, _bend("disconnect all", "no one has a network", STALLED, _PARTITION_SECONDS)]


def cut() -> list[Fault]:
    """Connections reset and refused, and connections of which only one direction is dead."""
    faults = [
        _bend(f"cut {name}", f"connections of {name} are reset and refused", CUT, _CUT_SECONDS, _meanwhile(name), name)
        for name in ("policy", "safety_filter", "robot")
    ]
    faults += [
        _bend(f"half-open {name}", f"{name} hears, and is not heard", HALF_OPEN, _PARTITION_SECONDS, "anything", name)
        for name in ("adaptation", "safety_filter", "robot")
    ]
    return faults


def bent() -> list[Fault]:
    """Loss, delay and bursts, on every link or on one; a slow reader."""
    lossy = f"{_LOSS:.0%} of all messages are lost"
    faults = [
        _bend("loss robot", f"{lossy} on the robot's link", losing(_LOSS), _BEND_SECONDS, "drives", "robot"),
        _bend("delay all", "every link delays by 2 ms each way", delayed(0.002), _BEND_SECONDS, "drives"),
        _bend("late all", "every link delays by 20 ms each way: no action is in time", delayed(0.02), _BEND_SECONDS),
        _late_filter(),
        _bend("bursts robot", f"the robot's link pauses {_PAUSE}", bursts(0.3, 1.0), _BEND_SECONDS, "drives", "robot"),
    ]
    slowly = _bend(
        "slow recorder",
        "the recorder reads 2000 bytes a second",
        slow(2000.0),
        _BEND_SECONDS,
        "undisturbed",
        "recorder",
    )
    return [_small(_bend("loss all", f"{lossy} on every link", losing(_LOSS), _BEND_SECONDS)), *faults, slowly]


def _late_filter() -> Fault:
    late = delayed(0.1)
    return _bend("late filter", "the filter's link delays by 100 ms", late, _BEND_SECONDS, "anything", "safety_filter")


def _meanwhile(name: str) -> Meanwhile:
    return "undisturbed" if name in _ALONGSIDE else "anything"


def _bend(
    name: str, sentence: str, conduct: Conduct, seconds: float, meanwhile: Meanwhile = "anything", *links: str
) -> Fault:
    def work(how: Conduct) -> Work:
        return lambda world: world.bend(how, *links)

    return Fault(
        name, f"{sentence}, for {seconds:.0f} s", work(conduct), repair=work(PASS), seconds=seconds, meanwhile=meanwhile
    )


def _small(fault: Fault) -> Fault:
    return replace(fault, small=True)
