"""What a large fleet costs on the network, worked out from a recording of a small one.

    python deploy/fleet_budget.py RECORDING.mcap --robots 1000 --regions 20

From the recording come messages and bytes of each topic, per robot and second. Who reads a topic is in the table
of roles. A region's router takes every message of its robots once and hands it to each reader in the region; over the
link to the centre goes what the recorder and the dashboard there read, once for both of them; the centre's router hands
it to each. A message on the wire costs its payload and ``--overhead`` bytes: headers of Zenoh, TLS, TCP and IP.
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

from safedpa.bus import STATE, TOPICS, StateMessage
from safedpa.bus.messages.codec import decode
from safedpa.bus.security.access_control import ROLES, ROUTER
from safedpa.records.readers.mcap import read_payloads

REGION = ("robot", "adaptation", "policy", "safety_filter", "diagnosis")
"""Roles that stand next to the robots; recorder and dashboard stand in the centre."""
CENTRE = ("recorder", "dashboard")


@dataclass(frozen=True)
class Flow:
    """Messages and bytes per second."""

    messages: float = 0.0
    octets: float = 0.0

    def __add__(self, other: Flow) -> Flow:
        return Flow(self.messages + other.messages, self.octets + other.octets)

    def times(self, factor: float) -> Flow:
        """The same, so many times."""
        return Flow(self.messages * factor, self.octets * factor)


def flows_per_robot(path: Path) -> dict[str, Flow]:
    """By topic: what one robot and what serves it send; heartbeats of the fleet as a whole are shared out.

    A second is one of the robots' clocks, as many states as make one: a gap in the recording costs nothing.
    """
    count: Counter[str] = Counter()
    octets: Counter[str] = Counter()
    period = 0.0
    for _, _, topic, payload in read_payloads(path, []):
        count[topic.name] += 1
        octets[topic.name] += len(payload)
        if topic is STATE and period == 0.0:
            period = decode(StateMessage, payload).period
    seconds = count[STATE.name] * period
    if seconds < 1.0:
        sys.exit(f"{path}: got states of {seconds:.1f} s, wanted a recording of a driving fleet")
    return {name: Flow(count[name] / seconds, octets[name] / seconds) for name in TOPICS if count[name]}


def readers(topic: str, roles: tuple[str, ...]) -> int:
    """How many of the roles read a topic; a robot its own alone."""
    return sum(TOPICS[topic] in ROLES[role].reads for role in roles)


def total(flows: dict[str, Flow], copies: dict[str, int], overhead: float) -> Flow:
    """All topics, each so many times, on the wire."""
    payload = sum((flows[name].times(copies[name]) for name in flows), Flow())
    return Flow(payload.messages, payload.octets + overhead * payload.messages)


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(prog="fleet_budget", description="what a large fleet costs on the network")
    parser.add_argument("recording", type=Path)
    parser.add_argument("--robots", type=int, default=1000)
    parser.add_argument("--regions", type=int, default=20)
    parser.add_argument("--overhead", type=float, default=170.0, help="bytes of headers per message; measured: 170")
    options = parser.parse_args()
    flows = flows_per_robot(options.recording)
    once = dict.fromkeys(flows, 1)
    inside = {name: readers(name, REGION) for name in flows}
    centre = {name: readers(name, CENTRE) for name in flows}
    link = {name: min(1, centre[name]) for name in flows}
    each = options.robots / options.regions
    lines = ["one robot and what serves it, payload:"]
    for name, flow in flows.items():
        read_by = f"readers {inside[name]} next to it, {centre[name]} in the centre"
        lines.append(f"  {name:10} {flow.messages:7.1f} messages/s {flow.octets / 1e3:8.2f} kB/s, {read_by}")
    lines.append(f"{options.robots} robots in {options.regions} regions, on the wire:")
    for label, copies, robots in (
        (f"a region's {ROUTER} takes", once, each),
        (f"a region's {ROUTER} hands on inside", inside, each),
        ("a region's link to the centre", link, each),
        (f"the centre's {ROUTER} takes", link, options.robots),
        (f"the centre's {ROUTER} hands on", centre, options.robots),
    ):
        flow = total(flows, copies, options.overhead).times(robots)
        lines.append(f"  {label:34} {flow.messages:9.0f} messages/s {8e-6 * flow.octets:9.1f} Mbit/s")
    sys.stdout.write("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
