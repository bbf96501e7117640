"""Compares what was read from a spoilt log with the drive: wrong rows, lost rows, findings."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from safedpa.errors import InputError
from safedpa.records import Run, load_run
from safedpa.records.column_map.file import parse_column_map
from safedpa.robots.car.system import CAR
from safedpa_lab.log_faults.drive import PERIOD, Drive, Table, Topics, drive_of
from safedpa_lab.log_faults.faults import FORMS, TOPIC_FORMS, Case, Expected, Fault
from safedpa_lab.log_faults.write import topic_map, write_table, write_topics

__all__ = ["HARMLESS", "Score", "judge", "read_spoilt"]

HARMLESS: Final = ("stamps", "held", "irregular_sampling", "late_command", "late_measurement")
"""Findings that state a fact about an intact log, not a fault."""
_DAMAGE: Final = ("damaged", "cut_off")
_TOLERANCE: Final = 1e-4
_TIME_TOLERANCE: Final = 0.012
"""s: rows that are placed by their receipt are this inexact."""
_NEAR: Final = 1.0
"""s within which a finding names the time."""
_SALT: Final = 7919


@dataclass(frozen=True)
class Score:
    """What became of one log."""

    wrong: int = 0
    """Rows with a command, a state or a time of another row, except within a second of reported damage."""
    lost: float = 0.0
    """Share of the undamaged rows that were not read."""
    reported: bool = True
    """Whether every fault that must be reported was, by its kind, channel and time."""
    surplus: int = 0
    """Findings about an intact log."""
    refused: str = ""
    """The error, if the log was refused."""
    crashed: bool = False


def read_spoilt(fault: Fault | None, form: str, seed: int, folder: Path) -> Score:
    """Writes one log with a fault, or an intact one, reads it and judges what was read."""
    drive = drive_of(seed)
    number = FORMS.index(form)
    start = 0.0 if form not in TOPIC_FORMS else 100.0 if form == "ulg" else 1_700_000_000.0
    rng = np.random.default_rng([seed, number, _SALT])
    case = Case(drive, rng, form, Table.of(drive), Topics.of(drive, start), start)
    expected = fault.spoil(case) if fault and fault.spoil else Expected()
    path = folder / f"drive.{form}"
    if form in TOPIC_FORMS:
        write_topics(case.topics, drive, path)
        mapping = topic_map(case.topics, form)
    else:
        write_table(case.table, path)
        mapping = f'format = 1\nrobot = "car"\n{case.table.map}' if case.table.map else ""
    if fault and fault.harm:
        expected = fault.harm(case, path)
    try:
        run = load_run(path, CAR, parse_column_map(mapping) if mapping else None)
    except InputError as error:
        return Score(lost=0.0 if expected.refusable else 1.0, refused=str(error).replace(str(folder), ""))
    except Exception as error:  # noqa: BLE001  # whatever it is, it is a crash of the reader
        return Score(lost=1.0, refused=repr(error), crashed=True)
    score = judge(run, drive, expected)
    return score if fault else replace(score, surplus=sum(item.kind not in HARMLESS for item in run.findings))


def judge(run: Run, drive: Drive, expected: Expected) -> Score:
    """Compares the rows of a run with those of the drive."""
    truth = drive.values
    row, wrong = _nearest(run, drive)
    read = np.column_stack([run.states, run.actions])
    difference = np.abs(read - truth[row, 1:])
    turn = np.abs(np.angle(np.exp(1j * (read[:, 2] - truth[row, 3]))))
    difference[:, 2] = turn
    wrong |= (difference[:, :4] > _TOLERANCE).any(axis=1)
    # while commands are missing, a robot applies the last one, and so does the reader
    held = np.isin(row, list(expected.damaged)) & (expected.kinds == ("stale_topic",))
    wrong |= (difference[:, 4:] > _TOLERANCE).any(axis=1) & ~held
    blank = (read == 0.0).all(axis=1)
    for part in run.stretches:
        inside = slice(part.start, part.stop)
        late = np.abs(np.diff(run.t[inside]) - PERIOD * np.diff(row[inside])) > _TIME_TOLERANCE
        wrong[part.start + 1 : part.stop] |= late & ~blank[inside][:-1]
    wrong &= ~blank
    for item in run.findings:  # next to damage the last command that was read is held
        if item.kind in _DAMAGE and item.start_t is not None:
            wrong &= np.abs(run.t - item.start_t) > _NEAR
    reported = not expected.kinds or _is_reported(run, expected)
    good = set(range(len(drive))) - expected.damaged
    found = set(row[~wrong & ~blank].tolist())
    return Score(
        wrong=int(wrong.sum()),
        lost=len(good - found) / max(1, len(good)),
        reported=reported,
    )


def _nearest(run: Run, drive: Drive) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
    """The row of the drive whose position is nearest, for each row of a run; and whether none is near."""
    position = drive.values[:, 1:3]
    squares = ((run.states[:, None, :2] - position[None]) ** 2).sum(axis=2)
    row = squares.argmin(axis=1)
    return row, squares[np.arange(len(row)), row] > _TOLERANCE**2


def _is_reported(run: Run, expected: Expected) -> bool:
    for item in run.findings:
        near = not expected.times or (
            item.start_t is not None and any(abs(item.start_t - at) <= _NEAR for at in expected.times)
        )
        if item.kind in expected.kinds and expected.channel in item.message and near:
            return True
    return False
