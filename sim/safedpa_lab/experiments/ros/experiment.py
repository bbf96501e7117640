"""A simulated ROS 2 car, driven by a policy of its own that looks at its goal alone, through the gateway and without.

The car is a process that imports the simulator alone and speaks by another implementation of the wire; router, gateway,
adaptation and filter are processes too. Everything in real time. Sense to act is measured by the car: from sending an
odometry to the arrival of the command that was made of it; next to it a bare chain of as many hops in the same run.
Then something fails: does it brake, how soon, and which node reports it?
"""

from __future__ import annotations

import signal
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Final

import numpy as np

from safedpa.errors import InputError, SafedpaError, did_you_mean
from safedpa_lab.benchmarks.latency import bare_times
from safedpa_lab.experiments.common.seeds import seeds_for
from safedpa_lab.experiments.common.statistics import wilson_interval
from safedpa_lab.experiments.record import Options, ReportProgress, Result, silent
from safedpa_lab.experiments.report import markdown_table
from safedpa_lab.ros.side import Loop, Node, Side, robot_file, services, side

_BEFORE, _AFTER, _LONGEST = 2.5, 4.0, 60.0
_STARTS = 15.0

Act = Callable[[Side, Loop, Node], None]


def _killed(name: str) -> Act:
    return lambda _robot, loop, _car: loop.children[name].send_signal(signal.SIGKILL)


def _message(word: str) -> Act:
    return lambda _robot, _loop, car: car.send(word)


def _speaks(robot: Side, _loop: Loop, _car: Node) -> None:
    robot.nodes[-1].send("go")


FAULTS: Final[Mapping[str, tuple[Act, str, str]]] = {
    "gateway killed": (_killed("ros_gateway"), "", "the driver's own timeout"),
    "filter killed": (_killed("safety_filter"), "", "gateway: the gateway brakes: no action of the filter"),
    "adaptation killed": (_killed("adaptation"), "", "safety filter"),
    "router of the services killed": (_killed("router"), "", "gateway: the gateway brakes: no action of the filter"),
    "router of the robot killed": (lambda robot, _loop, _car: robot.router.kill(), "", "the driver's own timeout"),
    "policy killed": (lambda robot, _loop, _car: robot.nodes[-1].kill(), "policy", "safety filter"),
    "odometry ends": (_message("freeze"), "", "gateway: the gateway brakes: the odometry is"),
    "clock jumps back by 1000 s": (_message("rewind"), "", ""),
    "another publisher on /drive": (_speaks, "named", "publishes on /drive too"),
    "another publisher, without a token": (_speaks, "quiet", "who shows no token"),
}
"""By name: the fault, an additional participant, and the node that must report it; empty: the car need not brake."""


def run_fault(name: str, seed: int) -> dict[str, Any]:
    """One drive in which it happens while the car drives. Raises InputError for a fault that is not known."""
    if name not in FAULTS:
        raise InputError(f"fault '{name}': {did_you_mean(name, FAULTS)}")
    act, alongside, teller = FAULTS[name]
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        robot = stack.enter_context(side(Path(folder)))
        loop = stack.enter_context(services(Path(folder), router=True))
        car = robot.car(_LONGEST, seed, *(("--no-policy",) if alongside == "policy" else ()))
        if alongside == "policy":
            robot.speaker("/drive_in").send("go")
        loop.start("ros_gateway", str(robot_file(Path(folder) / "robot.toml", robot.endpoint, seed)))
        loop.wait_for("ros_gateway", "robot is on the bus")
        car.send("go")
        loop.wait_for("ros_gateway", "the filter drives")
        if alongside == "named":
            robot.nodes.append(_Later(robot))
        elif alongside == "quiet":
            robot.speaker("/drive", "--without-token")
        time.sleep(_BEFORE)
        car.send("mark")
        act(robot, loop, car)
        time.sleep(_AFTER)
        car.send("end")
        found = car.reported(_STARTS)
    return _judged(name, seed, found, teller)


class _Later(Node):
    """A speaker that starts on command."""

    def __init__(self, robot: Side) -> None:
        self._robot = robot

    def send(self, word: str) -> None:
        """Starts it, and lets it speak."""
        self._robot.speaker("/drive").send(word)

    def kill(self) -> None:
        """Nothing needs to be stopped."""


def _judged(name: str, seed: int, found: Mapping[str, Any], teller: str) -> dict[str, Any]:
    mark = found.get("mark")
    if mark is None:
        raise SafedpaError(f"{name}: the car was not notified when it happened")
    notice = [one for one in mark["notice"] if teller in one] if teller else []
    own = teller.startswith("the driver's") and found["driver_brakes"] > 0
    return {
        "fault": name,
        "seed": seed,
        "speed_before": mark["speed"],
        "stood_after": mark["stood_after"],
        "stopping_way": mark["stopping_way"],
        "told_after": mark["told_after"],
        "reported": notice[0] if notice else (teller if own else ""),
        "periods_braked_by_the_driver": found["driver_brakes"],
        "collisions": found["collisions"],
        "held": not found["collisions"] and (not teller or bool((notice or own) and mark["stood_after"] is not None)),
    }


_TOGETHER = 3
"""Drives without a filter side by side: nothing of them is timed."""
_CHAIN_EVERY, _CHAIN_SECONDS, _RATE = 5, 2.0, 20.0
_MOST_TRIES = 3
"""Of a drive during which the whole machine was stationary."""
_STALLED = 1.0


def ros_experiment(
    seeds: Sequence[int],
    seconds: float,
    faults: Sequence[str] = tuple(FAULTS),
    report_progress: ReportProgress = silent,
) -> dict[str, Any]:
    """A drive with the filter and one without for each seed, the bare chain between them, then each fault once."""
    count = 2 * len(seeds) + len(faults)
    driven: list[dict[str, Any]] = []
    chain: list[float] = []
    with tempfile.TemporaryDirectory() as name, services(Path(name)) as loop:
        for index, seed in enumerate(seeds):
            if index % _CHAIN_EVERY == 0:
                chain += bare_times(_CHAIN_SECONDS, _RATE)
            driven.append(_undisturbed(loop, Path(name), seed, seconds))
            report_progress(len(driven), count)
    blind = unfiltered_drives(seeds, seconds, lambda done: report_progress(len(driven) + done, count))
    broken = []
    for position, fault in enumerate(faults):
        broken.append(run_fault(fault, seeds[position % len(seeds)]))
        report_progress(2 * len(seeds) + len(broken), count)
    return {
        "seeds": [seeds[0], seeds[-1]],
        "seconds": seconds,
        "date": time.strftime("%Y-%m-%d"),
        "with_filter": _row(driven, seconds),
        "without_filter": _row(blind, seconds),
        "sense_to_act_ms": _latency([pair for one in driven for pair in one["sense_to_act"]], chain),
        "faults": broken,
    }


def _undisturbed(loop: Loop, folder: Path, seed: int, seconds: float) -> dict[str, Any]:
    """A drive, repeated if the car's own clock shows that the machine was stopped meanwhile."""
    for _ in range(_MOST_TRIES):
        found = filtered_drive(loop, folder, seed, seconds)
        if found["stalled"] < _STALLED:
            return found
    raise SafedpaError(f"seed {seed}: the machine was stationary in {_MOST_TRIES} drives; run it on one that does not")


def filtered_drive(loop: Loop, folder: Path, seed: int, seconds: float) -> dict[str, Any]:
    """What the car says of its drive through gateway and filter."""
    with side(folder) as robot:
        car = robot.car(seconds, seed)
        loop.start("ros_gateway", str(robot_file(folder / "robot.toml", robot.endpoint, seed)))
        try:
            loop.wait_for("ros_gateway", "robot is on the bus")
            car.send("go")
            found = car.reported(seconds + 60.0)
        finally:
            loop.stop("ros_gateway")
    return {"seed": seed, **found}


def unfiltered_drives(
    seeds: Sequence[int], seconds: float, report_progress: Callable[[int], None] = lambda _done: None
) -> list[dict[str, Any]]:
    """The same policy straight on the driver's topic, a few cars at a time."""
    found: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as name:
        for first in range(0, len(seeds), _TOGETHER):
            with ExitStack() as stack:
                cars = []
                for seed in seeds[first : first + _TOGETHER]:
                    robot: Side = stack.enter_context(side(Path(name)))
                    cars.append((seed, robot.car(seconds, seed, "--straight")))
                for _, car in cars:
                    car.send("go")
                found += [{"seed": seed, **car.reported(seconds + 60.0)} for seed, car in cars]
            report_progress(len(found))
    return found


def _row(drives: Sequence[dict[str, Any]], seconds: float) -> dict[str, Any]:
    hit = [one for one in drives if one["collisions"]]
    return {
        "drives": len(drives),
        "drives_with_a_collision": len(hit),
        "share_95": wilson_interval(len(hit), len(drives)),
        "collisions": sum(one["collisions"] for one in drives),
        "which": [one["seed"] for one in hit],
        "goals": sum(one["reached"] for one in drives),
        "metres_a_minute": 60.0 * sum(one["moved"] for one in drives) / (seconds * len(drives)),
        "commands": sum(one["commands"] for one in drives),
        "periods_braked_by_the_gateway": sum(one["gateway_brakes"] for one in drives),
        "periods_braked_by_the_driver": sum(one["driver_brakes"] for one in drives),
    }


def _latency(pairs: Sequence[Sequence[float]], chain: Sequence[float]) -> dict[str, Any]:
    """Milliseconds. Turn: until the gateway's next period, which a chain without a period does not have."""
    if not pairs or not chain:
        raise SafedpaError("sense to act: got no command of the filter; look whether the car drives at all")
    whole = np.array([one[0] for one in pairs])
    turn = np.array([one[1] for one in pairs])
    rows = {
        "through_the_gateway": 1e3 * (whole - turn),
        "waiting_for_its_turn": 1e3 * turn,
        "both": 1e3 * whole,
        "bare_chain": 1e-3 * np.array(chain),
    }
    return {
        name: {
            "samples": len(values),
            **{f"p{share:g}": round(float(np.percentile(values, share)), 3) for share in (50, 99)},
        }
        for name, values in rows.items()
    }


def run(options: Options, report_progress: ReportProgress) -> Result:
    """Runs ``safedpa experiment ros``. Raises InputError for an unknown fault."""
    faults = tuple(one for one in options["faults"] or FAULTS if one != "none")
    for fault in faults:
        if fault not in FAULTS:
            raise InputError(f"--fault '{fault}': {did_you_mean(fault, FAULTS)}")
    seeds = seeds_for("evaluation", options["drives"], options["first_seed"])
    asked = f"safedpa experiment ros --drives {options['drives']} --seconds {options['seconds']:g}"
    asked += f" --first-seed {options['first_seed']}" if options["first_seed"] else ""
    found = ros_experiment(seeds, options["seconds"], faults, report_progress)
    return {"experiment": "ros", "command": asked, **found}


_NAMES = {
    "through_the_gateway": "odometry sent to command arrived, without waiting for its turn",
    "waiting_for_its_turn": "until the gateway's next period (20 Hz), which takes the newest odometry (50 Hz)",
    "both": "together",
    "bare_chain": "bare Zenoh chain: four hops through three processes, nothing computed",
}


def page_of(result: Mapping[str, Any]) -> str:
    """Markdown."""
    first, last = result["seeds"]
    with_filter, without = result["with_filter"], result["without_filter"]
    lines = [
        "# A ROS 2 car through the gateway, measured",
        "",
        f"`{result['command']}`, {result['date']}, scenes of the seeds {first} to {last}.",
        "Everything in real time, each part a process: the car (pymunk behind zenoh-ros2-sdk, another implementation",
        "of the wire; no ROS), its Zenoh router, a policy that heads for its goal at 1.5 m/s and looks at nothing,",
        "gateway, adaptation and filter.",
        "`rmw_zenoh_cpp` itself was not there: [what was not tried](../../guides/ros.md#limitations).",
        "",
    ]
    counted = (
        ("drives", f"drives of {result['seconds']:g} s"),
        ("drives_with_a_collision", "drives with a collision"),
        ("collisions", "collisions"),
        ("goals", "goals reached"),
        ("metres_a_minute", "m a minute"),
        ("periods_braked_by_the_gateway", "periods in which the gateway braked by itself (50 ms)"),
        ("periods_braked_by_the_driver", "periods in which the driver did, before the first command too (20 ms)"),
    )
    rows = (f"{name} | {_number(with_filter[key])} | {_number(without[key])}" for key, name in counted)
    lines.append(markdown_table("| with the filter | without", rows))
    share = 100.0 * with_filter["share_95"][1]
    lines += ["", f"At 95 %: at most {share:.1f} % of such drives collide with the filter.", "", "## Sense to act", ""]
    times = ((name, result["sense_to_act_ms"][key]) for key, name in _NAMES.items())
    rows = (f"{name} | {row['p50']:.1f} | {row['p99']:.1f} | {row['samples']}" for name, row in times)
    lines.append(markdown_table("| p50 | p99 | samples", rows, above="Measured by the car's own clock; in ms."))
    if result["faults"]:
        head = "fault | speed, m/s | stands after, s | m | reported | collisions"
        above = "Each in a drive of its own, while the car drives."
        lines += ["", "## Faults", "", markdown_table(head, map(_fault, result["faults"]), above=above)]
    return "\n".join(lines) + "\n"


def _number(value: float) -> str:
    return str(value) if isinstance(value, int) else f"{value:.0f}"


def _fault(one: Mapping[str, Any]) -> str:
    stood = "" if one["stood_after"] is None else f"{one['stood_after']:.2f}"
    way = "" if one["stopping_way"] is None else f"{one['stopping_way']:.2f}"
    reported = one["reported"] or "nothing; it drives on"
    return f"{one['fault']} | {one['speed_before']:.2f} | {stood} | {way} | {reported} | {one['collisions']}"
