"""The experiment with a ROS 2 car as a page."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

__all__ = ["page_of"]

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
        "`rmw_zenoh_cpp` itself was not there: [what was not tried](../ros.md#what-it-does-not-do).",
        "",
        "| | with the filter | without |",
        "|---|---|---|",
    ]
    for key, name in (
        ("drives", f"drives of {result['seconds']:g} s"),
        ("drives_with_a_collision", "drives with a collision"),
        ("collisions", "collisions"),
        ("goals", "goals reached"),
        ("metres_a_minute", "m a minute"),
        ("periods_braked_by_the_gateway", "periods in which the gateway braked by itself (50 ms)"),
        ("periods_braked_by_the_driver", "periods in which the driver did, before the first command too (20 ms)"),
    ):
        lines.append(f"| {name} | {_number(with_filter[key])} | {_number(without[key])} |")
    share = 100.0 * with_filter["share_95"][1]
    lines += ["", f"At 95 %: at most {share:.1f} % of such drives collide with the filter.", "", "## Sense to act", ""]
    lines += ["Measured by the car's own clock; in ms.", "", "| | p50 | p99 | samples |", "|---|---|---|---|"]
    for key, name in _NAMES.items():
        row = result["sense_to_act_ms"][key]
        lines.append(f"| {name} | {row['p50']:.1f} | {row['p99']:.1f} | {row['samples']} |")
    if result["faults"]:
        lines += ["", "## Faults", "", "Each in a drive of its own, while the car drives.", ""]
        lines += ["| fault | speed, m/s | stands after, s | m | told | collisions |", "|---|---|---|---|---|---|"]
        lines += [_fault(one) for one in result["faults"]]
    return "\n".join(lines) + "\n"


def _number(value: float) -> str:
    return str(value) if isinstance(value, int) else f"{value:.0f}"


def _fault(one: Mapping[str, Any]) -> str:
    stood = "" if one["stood_after"] is None else f"{one['stood_after']:.2f}"
    way = "" if one["stopping_way"] is None else f"{one['stopping_way']:.2f}"
    reported = one["reported"] or "nothing; it drives on"
    return f"| {one['fault']} | {one['speed_before']:.2f} | {stood} | {way} | {reported} | {one['collisions']} |"
