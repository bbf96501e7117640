"""``safedpa status``: shows the health of a fleet's robots and processes, as observed on the bus."""

from __future__ import annotations

import io
import json
import re
import time
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from safedpa.errors import InputError, SafedpaError
from safedpa_services.command_line.bus_options import bus_of, listening_options
from safedpa_services.command_line.options import PATH

if TYPE_CHECKING:
    from rich.console import Console

    from safedpa.bus.monitor import Alert, FleetOverview, Member, RobotOverview, ServiceOverview


_REDRAW_SECONDS = 0.5
_REPEAT_SECONDS = 5.0
"""s from table to table in a file."""
_FEWEST_COLUMNS = 80


@click.command()
@listening_options
@click.option("--robot", default="*", help="only this robot")
@click.option("--seconds", type=float, default=3.0, show_default=True, help="how long to listen before reporting")
@click.option("--watch", is_flag=True, help="show a live table until Ctrl-C")
@click.option("--picture", type=PATH, metavar="FILE.svg", help="also write the table to an SVG file")
def command(robot: str, seconds: float, watch: bool, **options: Any) -> int:
    """Show the health of a fleet's robots and processes.

    Lists rates, ages, late ticks, verdicts, margin, diagnosis and recorder. Who should be there and is silent counts as
    trouble until it returns or 'safedpa dismiss' takes it off the roster.

    Exit code 0 if everything is healthy, 1 if something is not or no process is on the bus.
    """
    from safedpa.bus.monitor import FleetOverview

    if not 0.5 <= seconds <= 3600.0:
        raise InputError(f"--seconds: got {seconds:g}, wanted 0.5 to 3600 s")
    if options["picture"] is not None and (watch or options["picture"].suffix != ".svg"):
        raise InputError(f"--picture {options['picture']}: wanted a name ending in .svg, and no --watch")
    if watch and options["as_json"]:
        raise InputError("--watch, --json: got both, wanted one; a script can call --json repeatedly")
    with bus_of(options) as bus:
        fleet = FleetOverview(bus, robot)
        healthy = _watch(fleet) if watch else _show(fleet, seconds, options)
    return 0 if healthy else 1


def _show(fleet: FleetOverview, seconds: float, options: dict[str, Any]) -> bool:
    fleet.listen(seconds)
    document = document_of(fleet)
    if options["as_json"]:
        click.echo(json.dumps(document))
    elif fleet.is_empty:
        raise SafedpaError(_no_answer(fleet, seconds, options))
    else:
        _draw(document, options["picture"])
    return bool(document["healthy"])


def _no_answer(fleet: FleetOverview, seconds: float, options: dict[str, Any]) -> str:
    where = ", ".join(options["connect"]) or "this machine"
    return (
        f"fleet '{fleet.bus.fleet}': no process found on the bus within {seconds:g} s ({where}); start "
        "'safedpa up', and name its endpoint with --connect"
    )


def _draw(document: dict[str, Any], picture: Path | None) -> None:
    from safedpa_services.command_line.status_table import render_status_table
    from safedpa_services.terminal import terminal

    console = terminal(soft_wrap=False)
    if not console.is_terminal:
        console = terminal(width=max(_FEWEST_COLUMNS, console.width))
    console.print(render_status_table(document, console.width))
    if picture is not None:
        drawn = terminal(width=console.width, file=io.StringIO(), record=True, force_terminal=True)
        drawn.print(render_status_table(document, console.width))
        _write_svg(drawn, f"safedpa status --fleet {document['fleet']}", picture)


def _write_svg(drawn: Console, title: str, picture: Path) -> None:
    """Writes the picture without web fonts: nothing in the file refers to another host."""
    text = drawn.export_svg(title=title, unique_id="safedpa")
    text = re.sub(r"@font-face \{.*?\}", "", text, flags=re.DOTALL)
    text = re.sub(r"<!-- .*? -->", "", text)
    try:
        picture.write_text(text, encoding="utf-8")
    except OSError as error:
        raise InputError(f"--picture {picture}: cannot be written ({error.strerror})") from error


def _watch(fleet: FleetOverview) -> bool:
    """Draws until Ctrl-C, into a file one table after the other; returns whether everything was healthy at the end."""
    from rich.live import Live
    from rich.text import Text

    from safedpa.bus.service.process import StopSignal
    from safedpa_services.command_line.status_table import render_status_table
    from safedpa_services.terminal import SanitizedRenderable, terminal

    stop, console, healthy = StopSignal(), terminal(), False
    stop.listen_to_signals()
    drawn = console.is_terminal
    with (
        Live(console=console, auto_refresh=False, screen=True, vertical_overflow="crop")
        if drawn
        else nullcontext() as live
    ):
        while not stop():
            fleet.listen(_REDRAW_SECONDS if drawn else _REPEAT_SECONDS)
            document = document_of(fleet)
            healthy = document["healthy"]
            table: Any = Text(f"fleet '{fleet.bus.fleet}': no process found for {time.monotonic() - fleet.since:.0f} s")
            if not fleet.is_empty:
                height = console.height if drawn else 0
                table = SanitizedRenderable(render_status_table(document, console.width, height))
            if live is None:
                console.print(table)
            else:
                live.update(table, refresh=True)
    return healthy


def _is_known(fleet: FleetOverview) -> bool:
    """Whether anything was heard besides a roster: a fleet of which nothing was heard is not healthy."""
    return bool(fleet.robots or fleet.services)


_LEVELS = ("trouble", "attention", "well")


def document_of(fleet: FleetOverview) -> dict[str, Any]:
    """Returns robots and processes, the worst first, and all alerts; ``healthy``: no alert has the level trouble."""
    from safedpa.bus.monitor import fleet_alerts

    now = fleet.clock()
    concerns = fleet_alerts(fleet)
    robots = [
        _robot(robot, now, dismissed=fleet.roster.is_dismissed("robot", robot.name)) for robot in fleet.robots.values()
    ]
    robots.sort(key=lambda row: (_LEVELS.index(row["health"]), -row["late"], -row["fallback"], row["robot"]))
    services = [_service(known, concerns, now) for known in fleet.services.values() if not fleet.replaced(known)]
    services.sort(key=lambda row: (_LEVELS.index(row["health"]), row["service"], row["pid"]))
    return {
        "fleet": fleet.bus.fleet,
        "healthy": _is_known(fleet) and all(concern.level != "trouble" for concern in concerns),
        "listened": round(now - fleet.since, 3),
        "robots": robots,
        "services": services,
        "roster": [_member(member, now) for member in fleet.roster.members.values()],
        "incidents": [
            {
                "kind": each.kind,
                "name": each.name,
                "ago": round(now - each.ended, 1),
                "seconds": round(each.seconds, 1),
                "sentence": each.sentence,
            }
            for each in fleet.roster.incidents
        ],
        "concerns": [asdict(concern) | {"kind": concern.kind or concern.sentence} for concern in concerns],
        "unreadable": fleet.refused,
    }


def _member(member: Member, now: float) -> dict[str, Any]:
    last = member.last_at()
    return {
        "kind": member.kind,
        "name": member.label,
        "missing": member.is_missing(now),
        "age": None if last is None else round(now - last, 3),
        "restarts": member.restarts,
        "cause": member.cause,
        "given_up": member.given_up,
        "dismissed_by": member.dismissed_by,
    }


def _level(concerns: Sequence[Alert]) -> str:
    levels = {concern.level for concern in concerns}
    return next((level for level in _LEVELS if level in levels), "well")


def _robot(robot: RobotOverview, now: float, *, dismissed: bool) -> dict[str, Any]:
    from safedpa.bus.monitor import is_stale, robot_alerts

    state, verdict = robot.state, robot.verdict
    is_silent = state is None or is_stale(now - robot.state_at, state.period)
    p50, p99 = (None, None) if is_silent else (robot.latency(0.5), robot.latency(0.99))
    row: dict[str, Any] = {
        "robot": robot.name,
        "health": "attention" if dismissed else _level(robot_alerts(robot, now)),
        "verdict": verdict.status if verdict else "",
        "verdict_age": round(max(0.0, now - robot.verdict_at), 3) if verdict else None,
        "state_age": round(max(0.0, now - robot.state_at), 3) if state else None,
        "diagnosis_age": round(max(0.0, now - robot.finding_at), 3) if robot.finding else None,
        "h": verdict.h_now if verdict else None,
        "margin": verdict.margin if verdict else None,
        "coverage": verdict.coverage if verdict and verdict.coverage >= 0.0 else None,
        "promised": verdict.promised if verdict and verdict.promised >= 0.0 else None,
        "rate": round(robot.recent_ticks.rate(now), 2),
        "period": state.period if state else 0.0,
        "wanted_rate": round(1.0 / state.period, 2) if state else None,
        "lockstep": state.lockstep if state else None,
        "time": state.robot_time if state else None,
        "goals": state.goals_reached if state else None,
        "collisions": state.collisions if state else None,
        "age": round(robot.silent_for(now), 3),
        "late": robot.recent_ticks.share("watchdog", now),
        "sense_to_act_p50": p50,
        "sense_to_act_p99": p99,
        "sources": robot.sources(now),
        "diagnosis": robot.finding.stage if robot.finding else "",
        "models": {name: message.model for name, (message, _) in sorted(robot.health.items()) if message.model},
    }
    shares = robot.recent_verdicts.counts(now)
    total = shares.total() or 1
    named = ("passed", "corrected", "relaxed", "violated", "fallback", "stopped", "disabled")
    return {**row, **{status: shares[status] / total for status in named}}


def _service(service: ServiceOverview, concerns: Sequence[Alert], now: float) -> dict[str, Any]:
    health = service.health
    own = [concern for concern in concerns if concern.service == service.name and concern.robot in service.robots]
    own += [concern for concern in concerns if concern.service == service.name and not concern.robot]
    silent = service.age(now) > 1.5
    level = _level(own) if own or not silent else "attention"
    return {
        "service": service.name,
        "health": level,
        "state": "silent" if silent else service.state,
        "pid": service.pid,
        "robots": len(service.robots),
        "steps": service.steps,
        "steps_per_second": round(service.steps_per_second(), 2),
        "step_microseconds": health.step_microseconds,
        "stale": service.stale,
        "refused": service.refused,
        "age": round(service.age(now), 3),
        "software": health.software,
        "acknowledged": health.acknowledged,
        "free_bytes": health.free_bytes,
        "detail": service.detail,
    }
