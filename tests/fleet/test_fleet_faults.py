"""Containers die, be stationary and lose the network: no robot collides, and all drive again by themselves."""

import subprocess
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import pytest
from fleet_containers import ROUTER, Fleet, Watch

pytestmark = pytest.mark.fleet

FAULT_SECONDS = 3.0
LONGEST_RECOVERY = 40.0
SOLID_TICKS = 10
"""Periods in a row that make a run: half a second of being driven."""
LOOP = ("router", "safety_filter", "adaptation", "policy", "robot-1")
REST = ("diagnosis", "recorder")

Reported = dict[str, Any]


@dataclass(frozen=True)
class Recovery:
    """s after the fault's end; ``drives``: the robot that came last; ``beats``: the service itself."""

    drives: float
    beats: float


def recovery(watch: Watch, fleet: Fleet, service: str, ended: float) -> Recovery | None:
    """Waits until every robot is driven and the service's heart beats; None when that does not come about."""
    drives: dict[str, float] = {}
    beats: list[float] = []
    heart = f"robot/{service}" if service in fleet.robots else service

    def back(reported: Reported) -> bool:
        for name, robot in reported["robots"].items():
            since, at = robot["run_since"], robot["at"]
            if name not in drives and robot["run_ticks"] >= SOLID_TICKS and at >= ended + 0.5:
                drives[name] = max(0.0, since - ended)
        health = reported["services"].get(heart)
        if not beats and health and health["at"] > ended + 0.05 and health["state"] in ("running", "ready"):
            beats.append(health["at"] - ended)
        return len(drives) == len(fleet.robots) and bool(beats)

    if watch.until(back, LONGEST_RECOVERY) is None:
        return None
    return Recovery(max(drives.values()), beats[0])


def felt(before: Reported, after: Reported) -> str:
    """How many periods the robots braked by themselves and how many verdicts fell back, all together."""

    def total(reported: Reported, what: str, name: str) -> int:
        return sum(robot[what].get(name, 0) for robot in reported["robots"].values())

    braked = total(after, "applied", "watchdog") - total(before, "applied", "watchdog")
    fallbacks = total(after, "verdicts", "fallback") - total(before, "verdicts", "fallback")
    return f"robots braked {braked:>3} periods, {fallbacks:>3} fallbacks seen"


@dataclass(frozen=True)
class Fault:
    """Something done to one container."""

    name: str
    service: str
    bring_about: Callable[[Fleet, str], None]

    def __str__(self) -> str:
        return f"{self.name} {self.service}"


def _pause(fleet: Fleet, service: str) -> None:
    fleet.pause(service, FAULT_SECONDS)


def _cut_off(fleet: Fleet, service: str) -> None:
    fleet.cut_off(service, FAULT_SECONDS)


FAULTS = [
    *(Fault("kill -9", service, Fleet.kill) for service in (*LOOP, *REST, "dashboard")),
    *(Fault("pause 3 s", service, _pause) for service in (*LOOP, *REST)),
    *(Fault("no network 3 s", service, _cut_off) for service in (*LOOP, *REST)),
    *(Fault("restart", service, Fleet.restart) for service in (*LOOP, *REST)),
]


@pytest.mark.parametrize("fault", FAULTS, ids=str)
def test_the_fleet_outlives(fault: Fault, fleet: Fleet, watch: Watch, rows: list[tuple[str, ...]]) -> None:
    before = watch.now()
    crashes = fleet.restarts(fault.service)
    fault.bring_about(fleet, fault.service)
    back = recovery(watch, fleet, fault.service, time.time())
    after = watch.now()
    collisions = {name: robot["collisions"] for name, robot in after["robots"].items()}
    assert set(collisions.values()) == {0}, f"{fault}: {collisions}"
    assert {robot["foreign"] for robot in after["robots"].values()} == {0}
    assert back is not None, f"{fault}: not all drive again within {LONGEST_RECOVERY:.0f} s: {after}"
    times = f"driving again after {back.drives:5.2f} s, {fault.service} after {back.beats:5.2f} s"
    rows.append((str(fault), times, felt(before, after), "no collision"))
    if fault.name == "kill -9":
        assert fleet.restarts(fault.service) == crashes + 1


def test_nothing_is_felt_of_a_killed_authority(fleet: Fleet, watch: Watch, rows: list[tuple[str, ...]]) -> None:
    starts = {name: robot["starts"] for name, robot in watch.now()["robots"].items()}
    began = time.time()
    fleet.kill("authority")
    issued = None
    while issued is None and time.time() < began + LONGEST_RECOVERY:
        state = fleet.inspect("authority")["State"]
        issued = state if state["Running"] and fleet.restarts("authority") else None
        reported = watch.now()
    assert issued is not None
    assert {name: robot["starts"] for name, robot in reported["robots"].items()} == starts
    rows.append(("kill -9 authority", f"back after {time.time() - began:.2f} s", "robots felt nothing", "no collision"))


def test_a_full_disk_stops_the_recording_and_not_the_robots(fleet: Fleet, watch: Watch, rows: list[tuple[str, ...]]):
    fleet.compose("stop", "recorder")
    volumes = [("recorder-key", "/certificates")]
    phrase = ["docker", "run", "--rm", "--init", "--network", fleet.network(), "--read-only", "--cap-drop", "ALL"]
    phrase += [word for name, place in volumes for word in ("--volume", f"{fleet.volume(name)}:{place}:ro")]
    phrase += ["--tmpfs", "/tmp", "--tmpfs", "/recordings:size=256k,uid=10001", fleet.image("recorder")]
    phrase += ["--out", "/recordings/recording.mcap", "--connect", ROUTER]
    phrase += ["--certificates", "/certificates", "--role", "recorder"]
    began = time.time()
    before = watch.now()
    tiny = subprocess.Popen(phrase, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    try:

        def full(reported: Reported) -> bool:
            health = reported["services"]["recorder"]
            return health["state"] == "failing" and health["at"] > began

        reported = watch.until(full, 60.0)
        assert reported is not None, "the recorder with a full disk does not say so"
        detail, took = reported["services"]["recorder"]["detail"], reported["at"] - began
        assert "space" in detail or "full" in detail, detail
        full_at = reported["robots"]

        def drive_on(reported: Reported) -> bool:
            """Every robot is driven, and together they get on: one alone may stand before a gap that is too narrow."""
            robots = reported["robots"]
            driven = all(robot["run_ticks"] >= SOLID_TICKS for robot in robots.values())
            way = sum(robot["travelled"] - full_at[name]["travelled"] for name, robot in robots.items())
            return driven and way > 4.0

        later = watch.until(drive_on, LONGEST_RECOVERY)
    finally:
        tiny.terminate()
        tiny.communicate(timeout=20)
    assert later is not None, f"not all drove on within {LONGEST_RECOVERY:.0f} s"
    assert {robot["collisions"] for robot in later["robots"].values()} == {0}
    fleet.compose("start", "recorder")
    back = recovery(watch, fleet, "recorder", time.time())
    assert back is not None
    rows.append(("full disk of the recorder", f"reported after {took:.1f} s", felt(before, later), "no collision"))
