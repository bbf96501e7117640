"""Links that lose, delay, are stationary or break, bent in the proxy between a process and the router."""

from __future__ import annotations

from safedpa_lab.faults.fault import Fault, Meanwhile, Work, meanwhile_of
from safedpa_lab.faults.proxy import CUT, HALF_OPEN, PASS, STALLED, Conduct
from safedpa_lab.faults.world import SERVICES

_PARTITION_SECONDS, _CUT_SECONDS, _BEND_SECONDS = 3.0, 1.0, 4.0
_LOSSY = Conduct(loss=0.3)
_LOST = "30% of all messages are lost"
_PAUSE = "0.3 s in every second, and then hands on what waited"


def disconnected() -> list[Fault]:
    """Every process without a network for three seconds; no one is informed, and what was sent meanwhile waits."""
    faults = [
        _bend(
            f"disconnect {name}",
            f"{name} has no network",
            STALLED,
            name,
            seconds=_PARTITION_SECONDS,
            small=name == "robot",
        )
        for name in (*SERVICES, "robot")
    ]
    return [*faults, _bend("disconnect all", "no one has a network", STALLED, seconds=_PARTITION_SECONDS)]


def cut() -> list[Fault]:
    """Connections reset and refused, and connections of which only one direction is dead."""
    return [
        *(
            _bend(f"cut {name}", f"connections of {name} are reset and refused", CUT, name, seconds=_CUT_SECONDS)
            for name in ("policy", "safety_filter", "robot")
        ),
        *(
            _bend(f"half-open {name}", f"{name} hears, and is not heard", HALF_OPEN, name, seconds=_PARTITION_SECONDS)
            for name in ("adaptation", "safety_filter", "robot")
        ),
    ]


def bent() -> list[Fault]:
    """Loss, delay and bursts, on every link or on one; a slow reader."""
    late = "every link delays by 20 ms each way: no action is in time"
    bursts = Conduct(pause=0.3, pause_every=1.0)
    return [
        _bend("loss all", f"{_LOST} on every link", _LOSSY, small=True),
        _bend("loss robot", f"{_LOST} on the robot's link", _LOSSY, "robot", meanwhile="drives"),
        _bend("delay all", "every link delays by 2 ms each way", Conduct(delay=0.002), meanwhile="drives"),
        _bend("late all", late, Conduct(delay=0.02)),
        _bend("late filter", "the filter's link delays by 100 ms", Conduct(delay=0.1), "safety_filter"),
        _bend("bursts robot", f"the robot's link pauses {_PAUSE}", bursts, "robot", meanwhile="drives"),
        _bend(
            "slow recorder", "the recorder reads 2000 bytes a second", Conduct(bytes_per_second_in=2000.0), "recorder"
        ),
    ]


def _bend(
    name: str,
    sentence: str,
    conduct: Conduct,
    *links: str,
    seconds: float = _BEND_SECONDS,
    meanwhile: Meanwhile | None = None,
    small: bool = False,
) -> Fault:
    def work(how: Conduct) -> Work:
        return lambda world: world.bend(how, *links)

    return Fault(
        name,
        f"{sentence}, for {seconds:.0f} s",
        work(conduct),
        repair=work(PASS),
        seconds=seconds,
        meanwhile=meanwhile or meanwhile_of(*links),
        small=small,
    )
