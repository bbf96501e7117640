"""``safedpa ros``: connects robots that use ROS 2; no ROS installation is needed here."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import click

from safedpa.errors import InputError
from safedpa.extras import needs
from safedpa_services.command_line.names import SuggestingChoice
from safedpa_services.command_line.options import PATH, as_json_option


@click.group(name="ros")
def command() -> None:
    """Connect robots that use ROS 2 over Zenoh.

    Lists their topics, or drives one through the filter. No ROS installation is needed here.
    """


@command.command(name="discover")
@click.argument("endpoint")
@click.option("--domain", type=int, default=0, show_default=True, help="ROS_DOMAIN_ID of the robot")
@as_json_option
@needs("ros")
def _discover(endpoint: str, domain: int, as_json: bool) -> None:
    """List the ROS topics at ENDPOINT.

    Shows types, publishers and subscribers. ENDPOINT is for example tcp/robot:7447.
    """
    from safedpa.ros.link import RosLink

    with RosLink(endpoint, domain) as link:
        found = link.endpoints()
    topics: dict[str, dict[str, Any]] = {}
    for one in found:
        entry = topics.setdefault(one.topic, {"type": one.type, "hash": one.hash, "publishers": [], "subscribers": []})
        entry["publishers" if one.kind == "MP" else "subscribers"].append(one.node)
    if as_json:
        click.echo(json.dumps({"domain": domain, "topics": topics}))
        return
    if not topics:
        click.echo(
            f"{endpoint}: no node of domain {domain} found; try another --domain, or check whether it is a DDS bridge"
        )
    for name, entry in topics.items():
        who = ", ".join(entry["publishers"]) or "none"
        to = ", ".join(entry["subscribers"]) or "none"
        click.echo(f"{name}   {entry['type']}\n    from {who}; to {to}; {entry['hash'][:15]}")


@command.command(name="run")
@click.argument("file", type=PATH, metavar="ROBOT.toml")
@click.option("--fleet", default="fleet", show_default=True, help="name of the fleet on the bus")
@click.option(
    "--connect", multiple=True, metavar="ENDPOINT", help="endpoint of the services; default: discovered on this machine"
)
@click.option("--mode", type=SuggestingChoice(["peer", "client"]), help="how to join the bus; default: peer")
@click.option("--certificates", type=PATH, metavar="DIR", help="folder with the robot's certificate")
@needs("ros")
def _run(file: Path, fleet: str, connect: tuple[str, ...], mode: str | None, certificates: Path | None) -> None:
    """Drive the robot of ROBOT.toml through running services.

    Ends with Ctrl-C, after braking the robot. 'safedpa serve' starts the services.
    """
    from safedpa.bus.service.process import StopSignal
    from safedpa_services.ros_gateway.__main__ import parser, work

    arguments = [part for endpoint in connect for part in ("--connect", endpoint)]
    arguments += ["--mode", mode] if mode else []
    arguments += ["--certificates", str(certificates)] if certificates is not None else []
    options = parser().parse_args([str(file), "--fleet", fleet, *arguments])
    stop = StopSignal()
    stop.listen_to_signals()
    sys.exit(work(options, stop))


@command.command(name="from-collision-monitor")
@click.argument("file", type=PATH, metavar="FILE.yaml")
@click.option("--out", type=PATH, metavar="ROBOT.toml", help="write the robot file there; default: print it")
@click.option("--robot", default="differential_drive", show_default=True, help="kind of robot, or a name of your own")
@click.option("--endpoint", default="", metavar="ENDPOINT", help="the robot's Zenoh router, such as tcp/robot:7447")
@as_json_option
@needs("ros")
def _from_collision_monitor(file: Path, out: Path | None, robot: str, endpoint: str, as_json: bool) -> None:
    """Convert the parameters of Nav2's collision monitor to a robot file.

    FILE.yaml has them alone or among those of other nodes. What is different afterwards is listed.
    """
    from safedpa.disk import why_not_written
    from safedpa_services.ros_gateway.collision_monitor import convert_collision_monitor
    from safedpa_services.ros_gateway.robot_file import parse_robot_file

    found = convert_collision_monitor(file, robot, endpoint)
    try:
        parse_robot_file(found.text)
    except InputError as error:
        raise InputError(f"{file}: {error}") from error
    if out is not None:
        try:
            with out.open("x", encoding="utf-8") as written:
                written.write(found.text)
        except FileExistsError as error:
            raise InputError(f"{out}: exists already; name a new file") from error
        except OSError as error:
            raise InputError(f"{out}: cannot be written ({why_not_written(error)})") from error
    if as_json:
        click.echo(json.dumps({"robot_file": found.text, "differences": found.differences}))
        return
    click.echo(found.text if out is None else f"{out}: written")
    click.echo("Differences from Nav2:" if out is not None else "# Differences from Nav2:")
    for line in found.differences:
        click.echo(f"- {line}" if out is not None else f"# - {line}")


@command.command(name="sources")
@click.argument("file", type=PATH, metavar="ROBOT.toml")
@click.argument("bag", type=PATH)
@as_json_option
@needs("ros")
def _sources(file: Path, bag: Path, as_json: bool) -> None:
    """Read the sensors of ROBOT.toml from the rosbag2 BAG.

    Shows how many messages of each can be used, why others cannot, and the longest gap between two.
    """
    from safedpa_services.ros_gateway.bag_sources import summarize_sources
    from safedpa_services.ros_gateway.robot_file import load_robot_file

    robot_file = load_robot_file(file)
    found = summarize_sources(bag, robot_file)
    if as_json:
        rows = {
            name: {
                "messages": one.messages, "used": one.used, "measured": one.measured, "reasons": dict(one.reasons),
                "longest_gap": one.longest_gap if one.used else None,
            }
            for name, one in found.items()
        }  # fmt: skip
        click.echo(json.dumps(rows))
        return
    for topic in robot_file.sensors:
        one = found[topic.name]
        line = f"{topic.name}   {topic.type} on {topic.topic}: {one.used} of {one.messages} messages can be used"
        if one.used:
            line += f", longest gap {one.longest_gap:.2f} s (time-out {topic.time_out:g} s)"
            line += f", {100.0 * one.measured:.0f} % of the rays see something"
        click.echo(line)
        for reason, count in one.reasons.most_common(3):
            click.echo(f"    {count} refused: {reason}")
