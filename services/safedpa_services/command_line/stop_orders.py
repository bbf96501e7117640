"""``safedpa stop`` and ``safedpa go``: orders to the safety filter to stop robots or to let them drive."""

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
_POLL_SECONDS = 0.1
_STATIONARY_SPEED = 0.02


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
    slow = [name for name, sentence in robots.items() if sentence.startswith("still ")]
    if slow:
        raise SafedpaError(f"the order is in force, but {', '.join(slow)} did not obey within the time")


def _await_obedience(fleet: FleetOverview, do: str) -> dict[str, str]:
    """Returns what each robot does, once all obey or the time is over."""
    end = fleet.clock() + _LONGEST_BRAKING_SECONDS
    while fleet.clock() < end:
        fleet.listen(_POLL_SECONDS)
        robots = {name: _does(known, do) for name, known in sorted(fleet.robots.items()) if known.state is not None}
        listened_long = fleet.clock() - fleet.since > 5.0 * _POLL_SECONDS
        if listened_long and not any(sentence.startswith("still ") for sentence in robots.values()):
            break
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
