"""Many robots at once through one process of each service, in real time over Zenoh."""

from __future__ import annotations

import json
import os
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, final

from safedpa.bus.transport.ports import free_port
from safedpa.errors import SafedpaError
from safedpa_lab.benchmarks.hostile.offers import account_of_offers
from safedpa_lab.benchmarks.usage import Usage, load_average, usage_of
from safedpa_services.supervisor.child import Child

LATE_SHARE = 0.001
"""Of all robot-ticks that may be late in a fleet that holds."""

_SERVICES = ("adaptation", "policy", "safety_filter")
_PATIENCE_SECONDS = 60.0
"""Beyond what a run takes, until it is given up."""
_LOOK_SECONDS = 0.1
_OFFERS = "offers.json"
_SMALLEST_STEP = 1.06
"""Ratio of two fleet sizes that can no longer be distinguished."""


@final
@dataclass(frozen=True)
class FleetTrial:
    """One fleet to be measured."""

    robots: int
    seconds: float
    rate: float = 20.0
    loads: str = "none,box,chair,large_chair"
    model: str = "car"
    controller: str = ""
    in_step: bool = False
    realtime: bool = False
    """Ask for real-time scheduling, as ``safedpa up`` does."""
    stacks: int = 0
    """So many processes that hold all three services each and share the robots; 0: one process of each service."""
    flood: bool = False
    """One more robot floods the bus with a thousand messages a second; it is not counted."""
    offers: float = 0.0
    """Someone with a diagnosis' key offers models that take long to read, in every other stretch of so many s."""


def fleet_benchmark(
    trial: FleetTrial, report_progress: Callable[[int, int], None] = lambda _done, _all: None
) -> dict[str, Any]:
    """Drives the fleet and reports late ticks, sense to act, and each process's processor time and memory.

    ``tell(seconds, of)`` hears how far it is.
    Raises SafedpaError when a process ends by itself, or the fleet does not come to its end in time.
    """
    with tempfile.TemporaryDirectory() as folder:
        begun, summary = Path(folder) / "begun.json", Path(folder) / "summary.json"
        children = _children(trial, Path(folder), begun, summary)
        load = load_average()
        with _running(children):
            _await(begun, children, _PATIENCE_SECONDS)
            before = _usages(children)
            began = time.monotonic()
            _await(
                summary,
                children,
                trial.seconds + _PATIENCE_SECONDS,
                lambda: report_progress(round(min(time.monotonic() - began, trial.seconds)), round(trial.seconds)),
            )
            after = _usages(children)
            account = json.loads(summary.read_text(encoding="utf-8"))
        moments = account.pop("moments")
        if trial.offers:
            fleet_rate = trial.rate * trial.robots
            files = [Path(folder) / _reference(core) for core in _cores()]
            account["offers"] = account_of_offers(Path(folder) / _OFFERS, moments, fleet_rate, files)
    ticks = max(account["robot_ticks"], 1)
    return {
        "rate_hz": trial.rate,
        "seconds": trial.seconds,
        "model": trial.model,
        "in_step": trial.in_step,
        "stacks": trial.stacks,
        "flood": trial.flood,
        **account,
        "late_share": account["late_ticks"] / ticks,
        "holds": account["late_ticks"] <= LATE_SHARE * ticks,
        "processes": {name: _process(before[name], after[name], trial.seconds, ticks) for name in before},
        "load_average": [load, load_average()],
    }


def largest_fleet(
    trial: FleetTrial, measured: Callable[[dict[str, Any]], None], measure: Callable[[FleetTrial], dict[str, Any]]
) -> int:
    """The largest number of robots that holds, from ``trial.robots`` on by doubling and bisection; 0: not even one.

    ``measure`` drives one fleet; every result is handed to ``measured``.
    """

    def holds(robots: int) -> bool:
        result = measure(replace(trial, robots=robots))
        measured(result)
        return bool(result["holds"])

    good, bad = 0, trial.robots
    while bad <= 1000 and holds(bad):
        good, bad = bad, 2 * bad
    while bad - good > 1 and bad > good * _SMALLEST_STEP:
        middle = (good + bad) // 2
        good, bad = (middle, bad) if holds(middle) else (good, middle)
    return good


def _children(trial: FleetTrial, folder: Path, begun: Path, summary: Path) -> list[Child]:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    scheduling = ("--realtime",) if trial.realtime else ()
    model = ("--model", trial.model, "--connect", endpoint, *scheduling)
    controller = ("--controller", trial.controller) if trial.controller else ()
    options = {"adaptation": model, "policy": (*model, *controller), "safety_filter": model}
    fleet = ("--robots", str(trial.robots), "--loads", trial.loads, "--rate", repr(trial.rate))
    files = ("--seconds", repr(trial.seconds), "--begun", str(begun), "--summary", str(summary))
    spread = ("--in-step",) if trial.in_step else ()
    robots = ("--listen", endpoint, *fleet, *files, *spread, *scheduling)
    children = [Child("robots", "safedpa_sim.robots.fleet", robots, folder / "robots.log")]
    for number in range(trial.stacks):
        share = (*options["policy"], "--share", f"{number + 1}/{trial.stacks}")
        name = f"stack_{number + 1}"
        children.append(Child(name, "safedpa_services.stack", share, folder / f"{name}.log"))
    for name in _SERVICES if trial.stacks == 0 else ():
        children.append(Child(name, f"safedpa_services.{name}", options[name], folder / f"{name}.log"))
    if trial.flood:
        module = "safedpa_lab.benchmarks.flood"
        children.append(Child("flood", module, ("--connect", endpoint), folder / "flood.log"))
    if trial.offers:
        module = "safedpa_lab.benchmarks.hostile.offering"
        account = ("--account", str(folder / _OFFERS), "--stretch", repr(trial.offers))
        attack = ("--connect", endpoint, "--robots", str(trial.robots), *account, *scheduling)
        children.append(Child("offers", module, attack, folder / "offers.log"))
        module = "safedpa_lab.benchmarks.reference"
        for core in _cores():
            about = ("--core", str(core), "--account", str(folder / _reference(core)), *scheduling)
            children.append(Child(f"reference_{core}", module, about, folder / f"reference-{core}.log"))
    return children


def _cores() -> list[int]:
    """Each has a reference loop next to the fleet, to tell what the machine does from what an attack does."""
    return sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else [0]


def _reference(core: int) -> str:
    return f"reference-{core}.json"


@contextmanager
def _running(children: list[Child]) -> Iterator[None]:
    try:
        for child in children:
            child.start()
        yield
    finally:
        for child in children:
            child.terminate()
        for child in children:
            child.end(2.0)


def _await(
    file: Path, children: list[Child], patience: float, report_progress: Callable[[], None] = lambda: None
) -> None:
    deadline = time.monotonic() + patience
    while not file.exists():
        report_progress()
        for child in children:
            if child.exit_code is not None:
                raise SafedpaError(f"{child.name} ended with exit code {child.exit_code}: {child.last_text()}")
        if time.monotonic() > deadline:
            raise SafedpaError(f"the fleet was not ready within {patience:.0f} s: {children[0].last_text()}")
        time.sleep(_LOOK_SECONDS)


def _usages(children: list[Child]) -> dict[str, Usage | None]:
    return {child.name: usage_of(child.pid) for child in children}


def _process(before: Usage | None, after: Usage | None, seconds: float, ticks: int) -> dict[str, float] | None:
    """Share of one core, processor time per robot-tick, memory and open files before and after."""
    if before is None or after is None:
        return None
    spent = after.cpu_seconds - before.cpu_seconds
    return {
        "cores": round(spent / seconds, 3),
        "us_per_robot_tick": round(1e6 * spent / ticks, 1),
        "mib_begin": round(before.resident_mib, 1),
        "mib_end": round(after.resident_mib, 1),
        "handles_begin": before.handles,
        "handles_end": after.handles,
    }
