"""Telling the safety filter to stop robots or to let them drive: shared by ``stop`` and ``go``."""

from __future__ import annotations

import getpass
import json
from typing import TYPE_CHECKING, Any, Literal

import click

from safedpa.errors import SafedpaError
from safedpa_services.command_line.bus_options import bus_of, request_answer
from safedpa_services.lines import print_plain

if TYPE_CHECKING:
    from safedpa.bus import Answer
    from safedpa.bus.monitor import FleetOverview, RobotOverview

__all__ = ["give_order"]

_LONGEST_BRAKING_SECONDS = 6.0
_LOOK_SECONDS = 0.1
_IS_STATIONARY = 0.02


def give_order(do: Literal["stop", "go"], robot: str, options: dict[str, Any]) -> None:
    """Asks the filter, waits until the order is seen in its verdicts, and tells what came of it.

    An empty ``robot`` means the whole fleet. Raises InputError when the order is refused, SafedpaError when no filter
    answers or a robot that drives does not obey.
    """
    from safedpa.bus import Request
    from safedpa.bus.messages.requests import ORDER
    from safedpa.bus.monitor import FleetOverview
    from safedpa.bus.service.service_loop import NO_ROBOT

    with bus_of(options) as bus:
        fleet = FleetOverview(bus, robot or "*")
        request = Request(do=do, who=options["who"] or getpass.getuser())
        no_answer = "no safety filter answers; wanted a running loop, whose endpoint is named with --connect"
        no_answer += ". Robots without a filter brake by themselves"
        answer = request_answer(bus, robot or NO_ROBOT, request, ORDER, no_answer)
        reported = _obeyed(fleet, do)
    _report(answer, reported, as_json=options["as_json"])
    slow = [name for name, sentence in reported.items() if sentence.startswith("still ")]
    if slow:
        raise SafedpaError(f"the order is in force, but {', '.join(slow)} did not obey within the time")


def _obeyed(fleet: FleetOverview, do: str) -> dict[str, str]:
    """By robot that is heard: what it does, once all do what was ordered or the time is over."""
    end = fleet.clock() + _LONGEST_BRAKING_SECONDS
    while fleet.clock() < end:
        fleet.listen(_LOOK_SECONDS)
        reported = {name: _does(known, do) for name, known in sorted(fleet.robots.items()) if known.state is not None}
        heard_long = fleet.clock() - fleet.since > 5.0 * _LOOK_SECONDS
        if heard_long and not any(sentence.startswith("still ") for sentence in reported.values()):
            break
    return reported


def _does(robot: RobotOverview, do: str) -> str:
    state, verdict = robot.state, robot.verdict
    assert state is not None
    stopped = verdict is not None and verdict.status == "stopped"
    if do == "go":
        return "stopped by an order of its own" if stopped else "may drive"
    if state.corridor:
        return "keeps its corridor without the policy; it has no stand" if stopped else "still obeys the policy"
    speed = state.values[3] if len(state.values) == 4 else 0.0
    if not stopped and abs(speed) > _IS_STATIONARY:
        return f"still drives, {speed:+.2f} m/s"
    return "stands" if abs(speed) <= _IS_STATIONARY else f"still brakes, {speed:+.2f} m/s"


def _report(answer: Answer, reported: dict[str, str], *, as_json: bool) -> None:
    if as_json:
        click.echo(json.dumps({"sentence": answer.sentence, "robots": reported}))
        return
    print_plain(answer.sentence)
    for name, sentence in reported.items():
        print_plain(f"{name}: {sentence}")
