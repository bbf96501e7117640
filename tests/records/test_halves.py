"""Faults of channels of a robot that nothing but its system describes: found with channel, time and size."""

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from safedpa.errors import RunError
from safedpa.records import Run
from safedpa.records.column_map.column_map import native_map
from safedpa.records.quality.quality import run_of_rows
from safedpa.records.run import RawRows
from safedpa.systems import System, Variable

WINCH = System(
    "winch",
    (Variable("height", "m", -50.0, 50.0), Variable("climb", "m/s", -9.0, 9.0)),
    (Variable("drive", "V", -6.0, 6.0), Variable("brake", "V", -6.0, 6.0)),
)
PERIOD, ROWS, HALF = 0.02, 2000, 1000


def winch_rows(seed: int = 0, held: slice = slice(0, 0)) -> RawRows:
    """A winch with drag and two drives, whose commands are steps; height and climb are measured with noise.

    In the rows ``held`` a brake holds it, and encoders then read the same.
    """
    random = np.random.default_rng(seed)
    commands = np.repeat(random.uniform(-4.0, 4.0, (ROWS // 50, 2)), 50, axis=0)
    commands[:, 1] = np.roll(commands[:, 1], 23)
    states, height, climb = np.empty((ROWS, 2)), 0.0, 0.0
    for row in range(ROWS):
        states[row] = height, climb
        height += PERIOD * climb
        driven = 1.5 * commands[row, 0] + 0.8 * commands[row, 1] - 0.9 * climb
        climb += PERIOD * (-8.0 * climb if held.start <= row < held.stop else driven)
    noisy = states + 0.005 * random.standard_normal(states.shape)
    still = slice(held.start + 60, held.stop)
    noisy[still] = (noisy[still][0, 0], 0.0) if held.stop else noisy[still]
    return RawRows(np.linspace(0.0, PERIOD * (ROWS - 1), ROWS), noisy, commands)


def judge(rows: RawRows, *keep: str) -> Run:
    return run_of_rows(Path("winch.csv"), WINCH, replace(native_map(WINCH), keep=keep), rows, ())


def reversed_drive(rows: RawRows) -> None:
    rows.actions[HALF:, 0] *= -1.0


def dead_brake(rows: RawRows) -> None:
    rows.actions[HALF:, 1] = 0.0


def late_height(rows: RawRows) -> None:
    rows.states[:, 0] = np.interp(rows.t - 0.25 * rows.t / rows.t[-1], rows.t, rows.states[:, 0])


def stale_commands(rows: RawRows) -> None:
    for row in range(40, ROWS, 60):
        rows.actions[row : row + 24] = rows.actions[row]


def recalibrated_climb(rows: RawRows) -> None:
    rows.states[HALF:, 1] += 0.4


def coarse_height(rows: RawRows) -> None:
    rows.states[HALF:, 0] = 2.0 * np.round(rows.states[HALF:, 0] / 2.0)


def millivolts(rows: RawRows) -> None:
    rows.actions[:, 0] *= 1000.0


FAULTS = [
    (reversed_drive, "changed_command", "drive", -1.0, HALF),
    (dead_brake, "dead_command", "brake", 0.0, HALF),
    (late_height, "clock_drift", "height", None, 0),
    (stale_commands, "stale_command", "drive", None, None),
    (recalibrated_climb, "offset", "climb", 0.4, HALF),
    (coarse_height, "quantised", "height", 2.0, HALF),
    (millivolts, "unit_mistake", "drive", 1000.0, None),
]


@pytest.mark.parametrize(
    ("spoil", "kind", "channel", "size", "row"), FAULTS, ids=lambda item: getattr(item, "__name__", "")
)
def test_a_fault_is_found_with_its_channel_time_and_size(
    spoil: Callable[[RawRows], None], kind: str, channel: str, size: float | None, row: int | None
) -> None:
    rows = winch_rows()
    spoil(rows)
    try:
        messages = {item.message: item.start_t for item in judge(rows).findings if item.kind == kind}
    except RunError as error:  # nothing is left of a log in another unit
        messages = {str(error): None}
    ((message, start),) = messages.items()
    assert channel in re.findall(r"\w+", message)
    numbers = [float(text) for text in re.findall(r"-?\d+\.?\d*", message)]
    assert size is None or any(number == pytest.approx(size, rel=0.2, abs=1e-6) for number in numbers)
    assert row is None or start == pytest.approx(PERIOD * row, abs=0.5)


def test_a_finding_is_kept_on_request_and_a_good_log_has_none() -> None:
    rows = winch_rows()
    assert judge(rows).findings == ()
    reversed_drive(rows)
    (kept,) = judge(rows, "changed_command").findings
    assert (kept.kind, kept.message.split("; ")[-1]) == ("kept_changed_command", "kept, as the map says")


@pytest.mark.parametrize(("sensor", "kinds"), [("stands", []), ("missed motion", ["frozen", "cut"])])
def test_a_robot_that_is_held_is_not_a_frozen_sensor(sensor: str, kinds: list[str]) -> None:
    """For 7 s height reads the same while the commands go on; a robot at its stop goes on from there."""
    span = slice(HALF, HALF + 350)
    rows = winch_rows(held=span if sensor == "stands" else slice(0, 0))
    if sensor != "stands":
        rows.states[span, 0] = rows.states[span.start, 0]
    assert [item.kind for item in judge(rows).findings if item.kind in ("frozen", "cut")] == kinds
