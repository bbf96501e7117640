"""Repeats a recorded drive of a simulated robot in closed loop: same scene and seed, another model or margin."""

from __future__ import annotations

import argparse
from collections import Counter
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from safedpa.bus import AbstractNode, SetupMessage, VerdictMessage
from safedpa.bus.service.process import add_bus_options
from safedpa.errors import InputError
from safedpa.limits import readable
from safedpa.perception import PerceptionNode, parse_perception
from safedpa.replay.setups import REPLAYED, node_of
from safedpa.replay.tape import RobotTape, Stamp, options_of
from safedpa.replay.what_if import WhatIfChange
from safedpa.systems.robots import robot_named
from safedpa_sim.closed_loop import Tick, drive
from safedpa_sim.robots.__main__ import robot_parser
from safedpa_sim.robots.robot_factory import make_robot

_OF_THE_PROCESS = ("name", "seconds", "lockstep", "summary", "await_word", "trace")
"""Options of the robot process that are not taken from a recording, besides those of the bus; all others define the
simulated robot."""


def drive_again(tape: RobotTape, change: WhatIfChange, folders: tuple[Path, ...] = ()) -> dict[str, Any]:
    """Repeats the first epoch of the recording and returns recorded and new figures, ready for JSON.

    The robot runs in lockstep: if the recorded one ran in real time, actions that were late then are in time now.
    Raises InputError when the robot was not simulated, or its options were not recorded.
    """
    options = _robot_options(tape)
    epoch = next(iter(tape.states))[0]
    stamps = sorted(stamp for stamp in tape.states if stamp[0] == epoch)
    setups = [_setup(tape, service) for service in REPLAYED]
    nodes = [*_perception(tape, options), *(node_of(change.applied(setup), folders) for setup in setups)]
    driven = list(drive(make_robot(options), nodes, len(stamps)))
    return {
        "robot": " ".join(f"{name}={value}" for name, value in _reported(options).items()),
        "ticks": len(driven),
        "lockstep_then": next(iter(tape.states.values())).lockstep,
        "apart_from_tick": _apart(tape, stamps, driven),
        "compared": _compared(tape, stamps, driven),
    }


def _robot_options(tape: RobotTape) -> argparse.Namespace:
    setups = tape.setups.get("robot", [])
    options = options_of(setups[0][1]) if setups else {}
    if "seed" not in options:
        raise InputError(
            f"--closed-loop: the options of robot '{tape.robot}' are not in the recording; wanted a simulated robot "
            "that was started by 'safedpa up'"
        )
    found = _parsed({name: options[name] for name in _simulating() if name in options})
    rate = robot_named(found.robot).rate if found.rate is None else found.rate
    return argparse.Namespace(**{**vars(found), "rate": rate, "lockstep": True, "seconds": 0.0})


def _simulating() -> list[str]:
    """Returns the names of the options that define the simulated robot: all but those known not to."""
    bus = argparse.ArgumentParser()
    add_bus_options(bus)
    others = {*vars(bus.parse_args([])), *_OF_THE_PROCESS}
    return [name for name in vars(robot_parser().parse_args([])) if name not in others]


def _perception(tape: RobotTape, options: argparse.Namespace) -> list[AbstractNode]:
    """Returns the perception node, with its settings at the beginning of the drive, of a robot with a laser."""
    if not options.laser:
        return []
    setup = _setup(tape, PerceptionNode.name)
    return [PerceptionNode(parse_perception(setup.settings) if setup.settings else None)]


def _parsed(options: dict[str, Any]) -> argparse.Namespace:
    """Validates the recorded options with the robot's own parser, because a recording is untrusted input.

    Raises InputError naming the option.
    """
    parser = robot_parser()  # has defaults for options that are newer than the recording

    def refuse(message: str) -> NoReturn:
        raise InputError(f"--closed-loop: the robot's options in the recording: {readable(message, 200)}")

    parser.error = refuse  # type: ignore[method-assign]
    defaults = vars(parser.parse_args([]))
    phrase = []
    for name, value in options.items():
        for item in value if isinstance(value, list) else [value]:
            if item is not None and str(item) != str(defaults.get(name)):
                phrase.append(f"--{name.replace('_', '-')}" + ("" if item is True else f"={item}"))
    return parser.parse_args(phrase)


def _reported(options: argparse.Namespace) -> dict[str, Any]:
    """Returns robot, seed and the options that differ from their default."""
    defaults = vars(robot_parser().parse_args([]))
    named = {name: getattr(options, name) for name in ("robot", "seed")}
    return named | {name: value for name in _simulating() if (value := getattr(options, name)) != defaults[name]}


def _setup(tape: RobotTape, service: str) -> SetupMessage:
    setups = tape.setups.get(service, [])
    if not setups:
        raise InputError(f"--closed-loop: no setup of {service} in the recording; wanted adaptation, policy and filter")
    return setups[0][1]


def _apart(tape: RobotTape, stamps: list[Stamp], driven: list[Tick]) -> int | None:
    """Returns the first tick whose state differs from the recorded one in any bit; None if there is none."""
    for stamp, tick in zip(stamps, driven, strict=False):
        if tape.states[stamp].values != tick.state.values:
            return stamp[1]
    return None


def _compared(tape: RobotTape, stamps: list[Stamp], driven: list[Tick]) -> dict[str, tuple[Any, Any]]:
    """Returns the recorded and the new value of each figure."""
    states = [tape.states[stamp] for stamp in stamps]
    entries = [entry.message for entry in tape.computed["safety_filter"]]
    then = [entry for entry in entries if isinstance(entry, VerdictMessage) and entry.epoch == stamps[0][0]]
    now = [tick.verdict for tick in driven]
    last = driven[-1].state
    found: dict[str, tuple[Any, Any]] = {
        "collisions": (states[-1].collisions, last.collisions),
        "goals reached": (states[-1].goals_reached, last.goals_reached),
        "smallest h at a state": (_smallest(then), _smallest(now)),
    }
    before, after = (Counter(verdict.status for verdict in verdicts) for verdicts in (then, now))
    found |= {f"verdicts {status}": (before[status], after[status]) for status in sorted({*before, *after})}
    return found


def _smallest(verdicts: list[VerdictMessage]) -> float | None:
    known = [verdict.h_now for verdict in verdicts if (verdict.h_now, verdict.h_next) != (0.0, 0.0)]
    return round(float(np.min(known)), 4) if known else None
