"""``safedpa stop`` and ``go``: orders to the safety filter; ``dismiss``: who is not expected any more."""

from __future__ import annotations

import getpass
import json
from typing import TYPE_CHECKING, Any, Literal

import click

from safedpa.errors import SafedpaError
from safedpa_services.command_line.bus_options import bus_of, listening_options, request_answer, who_option
from safedpa_services.plain_output import print_plain

if TYPE_CHECKING:
    from safedpa.bus import Answer
    from safedpa.bus.monitor import FleetOverview, RobotOverview


_LONGEST_BRAKING_SECONDS = 6.0
_LISTENING_SECONDS = 2.5
"""Long enough to hear who is silent for 1.5 s."""
_CONFIRMATION_SECONDS = 1.0
"""For the message to leave, and for the supervisor to take it into its roster."""
_POLL_SECONDS = 0.1
_STATIONARY_SPEED = 0.02
_ROSTER_SECONDS = 1.2
"""Time in which two rosters of a supervisor arrive, which names the robots that should answer."""
_UNKNOWN = "did not answer"


_robot_option = click.option("--robot", default="", help="only this robot; default: the whole fleet")


@click.command()
@listening_options
@_robot_option
@who_option
def stop(robot: str, **options: Any) -> None:
    """Stop a robot or the whole fleet.

    The safety filter ignores the policy and brakes. A car stays stationary, a pendulum is kept within its corridor. The
    order holds until 'safedpa go'. The answer says whether it also survives a restart of the filter.
    """
    give_order("stop", robot, options)


@click.command()
@listening_options
@_robot_option
@who_option
def go(robot: str, **options: Any) -> None:
    """Lift a stop order, so that robots drive again.

    Without --robot the order for the whole fleet is lifted; robots that were stopped individually stay stopped.
    """
    give_order("go", robot, options)


@click.command()
@click.argument("names", nargs=-1, required=True, metavar="NAME...")
@listening_options
@who_option
def dismiss(names: tuple[str, ...], **options: Any) -> None:
    """Declare that silent robots or services are not expected any more.

    They stop counting as trouble until they return. NAME: of a robot or service, or 'supervisor'. What is not silent
    cannot be dismissed. Exit code 1 if one of them is not missing.
    """
    import uuid

    from safedpa.bus import NO_ROBOT, ROSTER, RosterMessage
    from safedpa.bus.messages.messages import header
    from safedpa.bus.monitor import SILENT_SECONDS, FleetOverview, fleet_alerts

    who = options["who"] or getpass.getuser()
    with bus_of(options) as bus:
        fleet = FleetOverview(bus)
        fleet.listen(_LISTENING_SECONDS)
        silent = {alert.robot or alert.service for alert in fleet_alerts(fleet) if alert.level == "trouble"}
        silent |= {member.label for member in fleet.roster.missing(fleet.clock())}
        silent |= {known.name for known in fleet.services.values() if known.age(fleet.clock()) > SILENT_SECONDS}
        found = tuple(name for name in names if name in silent)
        if found:
            message = RosterMessage(**header(), source=uuid.uuid4().hex[:12], dismisses=found, who=who)
            bus.publish(ROSTER, NO_ROBOT, message)
            fleet.listen(_CONFIRMATION_SECONDS)
    if options["as_json"]:
        click.echo(json.dumps({"dismissed": list(found), "who": who}))
    else:
        for name in found:
            print_plain(f"{name}: dismissed by {who}, until it returns")
    if left := [name for name in names if name not in found]:
        raise SafedpaError(f"{', '.join(left)}: not missing; see 'safedpa status' for who is")


def give_order(do: Literal["stop", "go"], robot: str, options: dict[str, Any]) -> None:
    """Sends an order to the filter, waits until the robots obey, and prints the result.

    An empty ``robot`` means the whole fleet. Raises InputError if the order is refused, and SafedpaError if no filter
    answers or a driving robot does not obey.
    """
    from safedpa.bus import Request
    from safedpa.bus.messages.requests import ORDER
    from safedpa.bus.messages.topics import NO_ROBOT
    from safedpa.bus.monitor import FleetOverview

    with bus_of(options) as bus:
        fleet = FleetOverview(bus, robot or "*")
        request = Request(do=do, who=options["who"] or getpass.getuser())
        no_answer = "no safety filter answers; name the endpoint of a running loop with --connect"
        no_answer += ". Robots without a filter brake by themselves"
        answer = request_answer(bus, robot or NO_ROBOT, request, ORDER, no_answer)
        robots = _await_obedience(fleet, do)
    _report(answer, robots, as_json=options["as_json"])
    slow = [name for name, sentence in robots.items() if sentence.startswith(("still ", _UNKNOWN))]
    if slow:
        raise SafedpaError(f"the order is in force, but {', '.join(slow)} did not obey within the time")


def _await_obedience(fleet: FleetOverview, do: str) -> dict[str, str]:
    """Returns what each robot does, once all obey or the time is over."""
    end = fleet.clock() + _LONGEST_BRAKING_SECONDS
    while fleet.clock() < end:
        fleet.listen(_POLL_SECONDS)
        robots = _all_do(fleet, do)
        listened_long = fleet.clock() - fleet.since > _ROSTER_SECONDS
        if listened_long and not any(sentence.startswith(("still ", _UNKNOWN)) for sentence in robots.values()):
            break
    return robots


def _all_do(fleet: FleetOverview, do: str) -> dict[str, str]:
    """Returns what each robot does, also of those that should be there and send nothing."""
    from safedpa.bus.monitor import SILENT_SECONDS

    now = fleet.clock()
    expected = [name for name in fleet.roster.expected("robot") if fleet.robot in ("*", name)]
    robots = {}
    for name in sorted({*fleet.robots, *expected}):
        known = fleet.robots.get(name)
        if known is not None and known.ended_in_order:
            continue
        if known is None or known.state is None:
            robots[name] = f"{_UNKNOWN}: it sends no state"
        elif now - known.state_at > SILENT_SECONDS:
            robots[name] = f"{_UNKNOWN}: silent for {now - known.state_at:.0f} s"
        else:
            robots[name] = _does(known, do)
    return robots


def _does(robot: RobotOverview, do: str) -> str:
    state, verdict = robot.state, robot.verdict
    assert state is not None
    stopped = verdict is not None and verdict.status == "stopped"
    if do == "go":
        return "stopped by an order for this robot" if stopped else "may drive"
    if state.corridor:
        return "stays in its corridor without the policy; it cannot stop" if stopped else "still obeys the policy"
    speed = state.values[3] if len(state.values) == 4 else 0.0
    if not stopped and abs(speed) > _STATIONARY_SPEED:
        return f"still drives, {speed:+.2f} m/s"
    return "is stationary" if abs(speed) <= _STATIONARY_SPEED else f"still brakes, {speed:+.2f} m/s"


def _report(answer: Answer, robots: dict[str, str], *, as_json: bool) -> None:
    if as_json:
        click.echo(json.dumps({"sentence": answer.sentence, "robots": robots}))
        return
    print_plain(answer.sentence)
    for name, sentence in robots.items():
        print_plain(f"{name}: {sentence}")
