"""The history of a robot: bounded, and cut where ticks are missing or cannot be believed."""

import numpy as np
import pytest

from safedpa.dynamics import load_model
from safedpa.live.finding import DriveHistory

CAR = load_model("car")
STRAIGHT, STEERED = (0.0, 0.0, 0.0, 1.0), (1.0, 0.1)


def test_the_history_is_bounded_and_cut_where_ticks_are_missing(car, drive_of):
    history = DriveHistory(car.system, car.period, longest=5.0)
    rows = list(drive_of(200))
    for row in rows:
        if row[0] != 150:
            history.add(*row)
    run = history.excerpt(120, "r1")
    assert history.seconds_since(0) == pytest.approx(5.0)
    stretches = [(round(run.t[part.start] / 0.05), round(run.t[part.stop - 1] / 0.05)) for part in run.stretches]
    assert stretches == [(120, 148), (151, 198)]
    for t, states, actions in run.parts():
        for row, (time, state, action) in enumerate(zip(t, states, actions, strict=True)):
            tick = round(time / car.period)
            assert state == pytest.approx(rows[tick][1]), row
            assert action == pytest.approx(rows[tick + 1][2]), row


@pytest.mark.parametrize(("tick", "seconds"), [(0, 0.5), (3, 0.35), (9, 0.05), (10, 0.0)])
def test_seconds_since_a_tick_count_the_recorded_rows(tick, seconds):
    history = DriveHistory(CAR.system, 0.05)
    for number in range(10):
        history.add(number, np.zeros(4), np.zeros(2))
    assert history.seconds_since(tick) == pytest.approx(seconds)


@pytest.mark.parametrize(
    ("state", "applied", "recorded"),
    [
        (STRAIGHT, STEERED, True),
        ((0.0, np.nan, 0.0, 1.0), STEERED, False),
        ((0.0, 0.0, 0.0, 1.0e9), STEERED, False),
        (STRAIGHT, (1.0, np.inf), False),
        (STRAIGHT, (np.nan, 0.1), False),
    ],
)
def test_an_implausible_tick_is_a_gap(state, applied, recorded):
    history = DriveHistory(CAR.system, 0.5)
    for tick in range(9):
        odd = tick == 4
        history.add(tick, np.array(state if odd else STRAIGHT), np.array(applied if odd else STEERED))
    run = history.excerpt(0, "r1")
    assert [len(part) for part in run.stretches] == ([8] if recorded else [3, 3])
    assert run.t.tolist() == [0.5 * tick for tick in range(9) if recorded or tick != 4]


def test_the_last_seconds_are_those_of_the_newest_rows():
    history = DriveHistory(CAR.system, 0.05, longest=0.15)
    for tick in (7, 8, 9, 10):  # three rows at most: the oldest one goes
        history.add(tick, np.zeros(4), np.zeros(2))
    assert [[tick for tick, *_ in history.last(seconds)] for seconds in (10.0, 0.1, 0.0)] == [[8, 9, 10], [9, 10], [10]]
