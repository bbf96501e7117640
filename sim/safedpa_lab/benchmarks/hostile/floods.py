"""A robot of ``safedpa up --secure`` while someone with a stolen key floods the bus: how long it brakes, and when not.

One drive in real time, with rests between the floods; the robot writes down on its own disk what it did in each period.
"""

from __future__ import annotations

import json
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, final

from safedpa.bus import Bus, ReceivedMessage, VerdictMessage, ZenohTransport
from safedpa.bus.messages.topics import VERDICT
from safedpa.bus.transport.ports import free_port
from safedpa_lab.benchmarks.usage import load_average
from safedpa_services.supervisor.certificate_store import ephemeral_certificates
from safedpa_services.supervisor.child import Child
from safedpa_services.supervisor.plan import Plan
from safedpa_services.supervisor.run_monitor import RunMonitor
from safedpa_services.supervisor.supervisor import Supervisor
from safedpa_sim.robots.run_summary import TracedPeriod, read_trace

_FLEET, _ROBOT, _RATE = "fleet", "r1", 20.0
_MARGIN_SECONDS = 0.25
"""Five periods: an action and the state after it are in flight when a flood ends."""


@final
@dataclass(frozen=True)
class Flood:
    """Whose key was stolen, and what is sent with it."""

    role: str
    topic: str
    size: int
    """bytes of a message."""

    @property
    def name(self) -> str:
        """For a table."""
        return f"{self.role}'s key: {self.topic}, {self.size:,} bytes each"


FLOODS = (
    Flood("policy", "nominal", 100),
    Flood("adaptation", "latent", 60_000),
    Flood("diagnosis", "model", 4_000_000),
    Flood("metrics", "health", 100),
    Flood("metrics", "health", 60_000),
)
"""The first three are there already, and cut off as copies; no one of the last one's name is."""


@dataclass
class _Attack:
    """The floods, one after the other, as the drive goes on."""

    children: list[Child]
    rest: float
    since: float | None = None
    """When the robot began to drive, or the last flood ended."""
    at: int = 0
    fallbacks: set[int] = field(default_factory=set)
    """Ticks in which the filter braked."""

    def turn(self, drives: bool) -> None:
        """Begins the next flood when its rest is over."""
        now = time.monotonic()
        if self.since is None:
            self.since = now if drives else None
            return
        if self.at == len(self.children):
            return
        child = self.children[self.at]
        if child.pid == 0 and now - self.since >= self.rest:
            child.start()
        elif child.pid and child.exit_code is not None:
            self.at, self.since = self.at + 1, now

    @property
    def is_over(self) -> bool:
        """Whether the rest after the last one is over too."""
        return self.at == len(self.children) and self.since is not None and time.monotonic() - self.since > self.rest


def floods_benchmark(
    seconds: float = 5.0,
    rest: float = 5.0,
    floods: Sequence[Flood] = FLOODS,
    report_progress: Callable[[int, int], None] = lambda _done, _all: None,
) -> dict[str, Any]:
    """Floods of ``seconds`` each. Raises SafedpaError when the loop cannot be brought up."""
    with tempfile.TemporaryDirectory() as name, ephemeral_certificates(_FLEET, _ROBOT) as certificates:
        folder, load = Path(name), load_average()
        plan = Plan(
            robot="car", name=_ROBOT, load="none", seconds=0.0, seed=4, rate=_RATE, lockstep=False, filtered=True,
            dashboard=False, model="car", settings="car", margin="", controller="", fleet=_FLEET,
            endpoint=f"tls/127.0.0.1:{free_port()}", folder=folder, diagnosis=True, certificates=certificates,
            surroundings=("--trace", str(folder / "trace")),
        )  # fmt: skip
        children = [
            Child(
                f"flood {index}",
                "safedpa_lab.benchmarks.hostile.flooding",
                ("--fleet", _FLEET, "--connect", plan.endpoint, "--role", flood.role, "--topic", flood.topic,
                 "--bytes", str(flood.size), "--seconds", repr(seconds), "--account", str(folder / f"flood-{index}")),
                folder / f"flood-{index}.log",
                credentials=certificates.credentials[flood.role],
            )
            for index, flood in enumerate(floods)
        ]  # fmt: skip
        attack = _Attack(children, rest)
        code = _drive(plan, attack, lambda: report_progress(attack.at, len(children)))
        periods = list(read_trace(folder / "trace"))
        account = json.loads(plan.summary.read_text(encoding="utf-8"))
        rows = [
            {"flood": flood.name, **_row(json.loads((folder / f"flood-{index}").read_text()), periods, attack, rest)}
            for index, flood in enumerate(floods)
        ]
    return {
        "seconds": seconds,
        "rest": rest,
        "exit_code": code,
        "collisions": account["collisions"],
        "periods": len(periods),
        "rows": rows,
        "held": code == 0 and account["collisions"] == 0 and all(row["after_flood_seconds"] == 0.0 for row in rows),
        "load_average": [load, load_average()],
    }


def _drive(plan: Plan, attack: _Attack, report_progress: Callable[[], None]) -> int:
    services, robot = plan.services(), plan.robot_process()
    services[0].start()
    try:
        with Bus(ZenohTransport(plan.own_session()), plan.fleet) as bus:
            watch, verdicts = RunMonitor(bus, plan.name), bus.inbox((VERDICT,))

            def turn() -> None:
                attack.turn(watch.state is not None)
                for item in verdicts.take(0.0):
                    message = item.message if isinstance(item, ReceivedMessage) else None
                    if isinstance(message, VerdictMessage) and message.status == "fallback":
                        attack.fallbacks.add(message.tick)
                report_progress()

            return Supervisor(services, robot, watch, lambda: attack.is_over, turn).run()
    finally:
        for child in (*attack.children, *services):
            child.kill()


def _row(account: dict[str, Any], periods: Sequence[TracedPeriod], attack: _Attack, rest: float) -> dict[str, Any]:
    """What the robot did in the rest before a flood, in the flood, and in the rest after it."""
    began, ended = account["began"], account["ended"]
    braked = [p.applied_at for p in periods if p.applied_by == "watchdog" or p.tick in attack.fallbacks]
    within = [at for at in braked if began <= at <= ended]
    after = [at for at in braked if ended + _MARGIN_SECONDS < at <= ended + rest]
    before = [at for at in braked if began - rest <= at < began]
    return {
        "messages_a_second": round(account["sent"] / (ended - began)),
        "megabytes_a_second": round(account["bytes"] / (ended - began) / 1e6, 1),
        "flood_seconds": round(ended - began, 2),
        "braked_seconds": round(len(within) / _RATE, 2),
        "longest_seconds": _longest(within),
        "before_seconds": round(len(before) / _RATE, 2),
        "after_seconds": round(len(after) / _RATE, 2),
        "after_flood_seconds": round(max(after) - ended, 2) if len(after) > len(before) else 0.0,
    }


def _longest(moments: Sequence[float]) -> float:
    """s of the longest stretch in which no period was driven under the filter's action."""
    longest, begin, last = 0.0, None, 0.0
    for at in moments:
        if begin is None or at - last > 1.5 / _RATE:
            begin = at
        longest, last = max(longest, at - begin + 1.0 / _RATE), at
    return round(longest, 2)
