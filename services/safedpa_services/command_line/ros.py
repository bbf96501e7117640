"""``safedpa ros``: robots that speak ROS 2, without ROS."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import click

from safedpa.extras import needs
from safedpa_services.command_line.names import SuggestingChoice
from safedpa_services.command_line.options import as_json_option

__all__ = ["command"]


@click.group(name="ros")
def command() -> None:
    """Robots that speak ROS 2 over Zenoh: look what is there, and drive one through the filter. No ROS is needed."""


@command.command(name="discover")
@click.argument("endpoint")
@click.option("--domain", type=int, default=0, show_default=True, help="ROS_DOMAIN_ID of the robot")
@as_json_option
@needs("ros")
def _discover(endpoint: str, domain: int, as_json: bool) -> None:
    """List the topics behind ENDPOINT, such as tcp/robot:7447: their types, who publishes them, who listens."""
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
        click.echo(f"{endpoint}: no node of domain {domain} shows itself; is it another --domain, or a bridge to DDS?")
    for name, entry in topics.items():
        who = ", ".join(entry["publishers"]) or "none"
        heard = ", ".join(entry["subscribers"]) or "none"
        click.echo(f"{name}   {entry['type']}\n    from {who}; to {heard}; {entry['hash'][:15]}")


@command.command(name="run")
@click.argument("file", type=click.Path(path_type=Path), metavar="ROBOT.toml")
@click.option("--fleet", default="fleet", show_default=True, help="name of the fleet on the bus")
@click.option("--connect", multiple=True, metavar="ENDPOINT", help="where the services meet; default: on this machine")
@click.option("--mode", type=SuggestingChoice(["peer", "client"]), help="how to join the bus; default: peer")
@click.option("--certificates", type=click.Path(path_type=Path), metavar="DIR", help="prove by those who this is")
@needs("ros")
def _run(file: Path, fleet: str, connect: tuple[str, ...], mode: str | None, certificates: Path | None) -> None:
    """Drive the robot of ROBOT.toml through the services that run: odometry in, filtered commands out.

    Ends at Ctrl-C; the robot is braked first. 'safedpa serve' starts the services.
    """
    from safedpa.bus.service.process import StopSignal
    from safedpa_services.ros_gateway.__main__ import parser, work

    phrase = [part for endpoint in connect for part in ("--connect", endpoint)]
    phrase += ["--mode", mode] if mode else []
    phrase += ["--certificates", str(certificates)] if certificates is not None else []
    options = parser().parse_args([str(file), "--fleet", fleet, *phrase])
    stop = StopSignal()
    stop.listen_to_signals()
    sys.exit(work(options, stop))
