"""Runs in a container on the bus with the recorder's certificate; prints what it received ten times a second as JSON.

``run`` is the time since when the filter drives a robot without interruption: the action of every period came from the
filter, and its verdict was no fallback. ``foreign`` counts actions that a robot applied and the filter never chose.
"""

import argparse
import json
import sys
import time
from collections import Counter
from typing import Any

from safedpa.bus import HEALTH, STATE, VERDICT, ReceivedMessage, StateMessage, VerdictMessage
from safedpa.bus.messages.messages import HealthMessage
from safedpa.bus.service.process import add_bus_options, bus_from_options

DRIVEN = ("passed", "corrected", "relaxed")
LONGEST_GAP = 0.5
"""s without a state after which a run is over."""
SAME = 1e-9


class RobotSeen:
    """What is known of one robot; counts go on over its restarts."""

    def __init__(self) -> None:
        self.state: StateMessage | None = None
        self.starts = self.goals = self.collisions = self.foreign = self.checked = 0
        self.travelled = 0.0
        self.applied: Counter[str] = Counter()
        self.verdicts: Counter[str] = Counter()
        self.chosen: dict[tuple[int, int], VerdictMessage] = {}
        self.at = self.run_since = 0.0
        self.run_ticks = 0
        self.gaps = 0

    def judged(self, verdict: VerdictMessage) -> None:
        self.verdicts[verdict.status] += 1
        self.chosen[verdict.epoch, verdict.tick] = verdict
        while len(self.chosen) > 100:
            del self.chosen[next(iter(self.chosen))]

    def moved(self, state: StateMessage, at: float) -> None:
        before = self.state
        if before is not None and before.epoch == state.epoch and state.tick <= before.tick:
            return  # repeated
        fresh = before is None or before.epoch != state.epoch
        if fresh:
            self.starts += 1
        self.goals += state.goals_reached - (0 if fresh or before is None else before.goals_reached)
        self.collisions += state.collisions - (0 if fresh or before is None else before.collisions)
        if before is not None and not fresh:
            x, y = state.values[0] - before.values[0], state.values[1] - before.values[1]
            self.travelled += (x * x + y * y) ** 0.5
        self.applied[state.applied_by] += 1
        self._judge(state, at, broken=fresh or at - self.at > LONGEST_GAP)
        self.state, self.at = state, at

    def _judge(self, state: StateMessage, at: float, broken: bool) -> None:
        verdict = self.chosen.get((state.epoch, state.tick - 1))
        driven = state.applied_by == "filter" and verdict is not None and verdict.status in DRIVEN
        if state.applied_by == "filter" and verdict is not None:
            self.checked += 1
            pairs = zip(state.applied, verdict.action, strict=True)
            self.foreign += any(abs(got - chosen) > SAME for got, chosen in pairs)
        if broken or not driven:
            self.run_ticks = 0
        if driven:
            self.run_since = at if self.run_ticks == 0 else self.run_since
            self.run_ticks += 1

    def reported(self) -> dict[str, Any]:
        state = self.state
        return {
            "at": self.at,
            "epoch": state.epoch if state else 0,
            "tick": state.tick if state else -1,
            "starts": self.starts,
            "goals": self.goals,
            "collisions": self.collisions,
            "travelled": round(self.travelled, 3),
            "applied": dict(self.applied),
            "verdicts": dict(self.verdicts),
            "foreign": self.foreign,
            "checked": self.checked,
            "run_since": self.run_since,
            "run_ticks": self.run_ticks,
        }


class Observer:
    """Everything seen so far."""

    def __init__(self) -> None:
        self.robots: dict[str, RobotSeen] = {}
        self.services: dict[str, dict[str, Any]] = {}

    def see(self, item: ReceivedMessage, at: float) -> None:
        message = item.message
        if isinstance(message, StateMessage):
            self.robots.setdefault(item.robot, RobotSeen()).moved(message, at)
        elif isinstance(message, VerdictMessage):
            self.robots.setdefault(item.robot, RobotSeen()).judged(message)
        elif isinstance(message, HealthMessage):
            name = f"robot/{item.robot}" if message.service == "robot" else message.service
            seen = self.services.setdefault(name, {"beats": 0, "refused": {}})
            seen["refused"][item.robot] = message.refused
            seen.update(at=at, beats=seen["beats"] + 1, state=message.state, detail=message.detail, steps=message.steps)


def main() -> None:
    parser = argparse.ArgumentParser(prog="fleet-observer")
    add_bus_options(parser)
    options = parser.parse_args()
    observer = Observer()
    with bus_from_options(options) as bus:
        inbox = bus.inbox((STATE, VERDICT, HEALTH), "*", keep_all=True)
        report_at = time.monotonic()
        while True:
            for item in inbox.take(0.05):
                if isinstance(item, ReceivedMessage):
                    observer.see(item, time.time() - (time.monotonic() - item.at))
            if time.monotonic() >= report_at:
                report_at = time.monotonic() + 0.1
                robots = {name: robot.reported() for name, robot in observer.robots.items()}
                line = json.dumps({"at": time.time(), "robots": robots, "services": observer.services})
                sys.stdout.write(line + "\n")
                sys.stdout.flush()


if __name__ == "__main__":
    main()
