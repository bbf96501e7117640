"""Over how many seconds is decided: the ladder, how many windows are enough, and how far a start's error may grow."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from safedpa.diagnosis.fit import evidence
from safedpa.diagnosis.fit.evidence import (
    Evidence,
    evidence_at,
    evidence_beside,
    evidence_seconds,
    shown_of,
    worth_recording,
)
from safedpa.errors import InputError, RunError
from safedpa.records.run import Run, Stretch
from safedpa.robots.car.system import CAR
from safedpa.robots.pendulum.system import PENDULUM

MODEL: Any = SimpleNamespace(system=PENDULUM)
SHARES = (1.0, 0.7, 0.5, 0.35, 0.25, 0.18, 0.12)


def rows_until(seconds: float, period: float, start: float = 100.0) -> Any:
    """Times of rows a period apart, the last one where it is said."""
    return start + np.append(np.arange(0.0, seconds - 1e-9, period), seconds)


def recording(*parts: Any, name: str = "one") -> Run:
    t = np.concatenate(parts)
    ends = np.cumsum([0, *(len(part) for part in parts)]).tolist()
    states = np.random.default_rng(len(t)).normal(size=(len(t), 2))
    stretches = tuple(Stretch(ends[index], ends[index + 1]) for index in range(len(parts)))
    return Run(name, PENDULUM, t, states, np.zeros((len(t), 1)), stretches)


def simulating(monkeypatch: pytest.MonkeyPatch, ends: Callable[[Any, Any], Any], scale: Sequence[float]) -> list[Any]:
    """``ends(windows, away)`` tells where windows end by how far starts (..., states) are from those measured."""
    asked: list[Any] = []

    def simulate(models: Any, windows: Any, rows: Any, starts: Any) -> Any:
        asked.append(windows)
        assert len(models) == len(starts) == 3
        assert all(model is MODEL for model in models)
        assert (windows.steps >= rows[-1]).all(), "beyond a window's end nothing is meant"
        found = np.full((len(windows), len(rows), 2, 3), np.nan)
        found[:, -1] = np.moveaxis(ends(windows, starts - windows.states[windows.start]), 0, -1)
        return found

    def change_scale(windows: Any, rows: Any) -> Any:
        assert rows.tolist() == windows.end.tolist()
        return np.array(scale)

    monkeypatch.setattr(evidence, "simulate", simulate)
    monkeypatch.setattr(evidence, "change_scale", change_scale)
    return asked


@pytest.fixture
def calm(monkeypatch: pytest.MonkeyPatch) -> None:
    """No error of a start grows."""
    simulating(monkeypatch, lambda _, away: away, (1.0, 1.0))


@pytest.mark.usefixtures("calm")
@pytest.mark.parametrize("step", range(7))
@pytest.mark.parametrize(("lacking", "enough"), [(0.0, True), (0.4, True), (0.6, False)])
def test_the_longest_step_of_which_twenty_windows_are_there_up_to_half_a_row(
    step: int, lacking: float, enough: bool
) -> None:
    run = recording(rows_until(20.0 * SHARES[step] - lacking / 64.0, 1.0 / 64.0))
    found = SHARES[step] if enough else SHARES[min(step + 1, 6)]
    assert evidence_seconds(MODEL, [run]) == found


@pytest.mark.usefixtures("calm")
def test_windows_of_all_stretches_of_all_runs_count_and_none_goes_from_one_to_the_next() -> None:
    part = rows_until(7.3, 1.0 / 64.0)
    runs = [recording(part, part + 50.0), recording(part, np.zeros(0), name="two")]
    assert evidence_seconds(MODEL, runs) == 1.0, "seven and seven and seven"
    assert evidence_seconds(MODEL, runs[:1]) == 0.7, "ten and ten"


@pytest.mark.usefixtures("calm")
@pytest.mark.parametrize(
    ("period", "seconds", "found"),
    [
        (1.0 / 54.0, 1.5, 0.12), (1.0 / 48.0, 1.5, 0.18), (1.0 / 16.0, 25.0, 1.25), (1.0 / 16.0, 24.0, 0.875),
        (1.0 / 16.0, 5.0, 0.438), (0.25, 100.0, 5.0), (0.25, 99.0, 3.5), (0.25, 40.0, 1.75), (0.25, 30.0, 1.75),
        (0.25, 2.0, 1.75), (0.03125, 20.0, 1.0), (0.03125, 1.0, 0.25),
    ],
)  # fmt: skip
def test_a_second_or_twenty_rows_are_the_longest_and_six_rows_the_shortest(
    period: float, seconds: float, found: float
) -> None:
    assert evidence_seconds(MODEL, [recording(rows_until(seconds, period))]) == found


@pytest.mark.usefixtures("calm")
def test_of_runs_at_several_rates_the_middle_one_counts() -> None:
    runs = [recording(rows_until(90.0, period), name=str(period)) for period in (0.25, 0.125, 1.0 / 64.0)]
    assert evidence_seconds(MODEL, runs) == 2.5


STIFF = 5.0
"""Where a window ends without any shift."""


@pytest.mark.parametrize(
    ("of_rate", "of_angle", "found"),
    [(31.9, 0.0, 1.0), (32.1, 0.0, 0.5), (0.0, 1.99, 1.0), (0.0, 2.01, 0.5), (31.9, 1.99, 1.0), (-31.9, 1.99, 1.0),
     (-32.1, 1.9, 0.5), (1e300, 0.0, 0.5), (float("nan"), 0.0, 0.5), (0.0, float("inf"), 0.5)],
)  # fmt: skip
def test_an_error_of_the_start_may_grow_eightfold_in_units_of_each_states_change(
    monkeypatch: pytest.MonkeyPatch, of_rate: float, of_angle: float, found: float
) -> None:
    """Changes of 2 and 0.5: the angle takes a quarter of the first number, the rate four times the second.

    What bends does not count: the shift is small.
    """

    def ends(windows: Any, away: Any) -> Any:
        if windows.horizon < 0.6:
            return STIFF + 0.0 * away
        angle, rate = away[..., 0], away[..., 1]
        with np.errstate(all="ignore"):
            return STIFF + np.stack([of_rate * rate + 100.0 * rate**2, of_angle * angle + 10.0 * angle**2], axis=-1)

    simulating(monkeypatch, ends, (2.0, 0.5))
    assert evidence_seconds(MODEL, [recording(rows_until(25.0, 1.0 / 64.0))]) == found


def test_of_a_state_that_never_changes_nothing_counts_but_what_becomes_of_it(monkeypatch: pytest.MonkeyPatch) -> None:
    for gain, found in ((7.9e-9, 1.0), (8.1e-9, 0.5)):

        def ends(windows: Any, away: Any, gain: float = gain) -> Any:
            grown = np.zeros_like(away)
            grown[..., 1] = gain * away[..., 0] if windows.horizon > 0.6 else 0.0
            return grown

        simulating(monkeypatch, ends, (1.0, 0.0))
        assert evidence_seconds(MODEL, [recording(rows_until(25.0, 1.0 / 64.0))]) == found


@pytest.mark.parametrize(("wild", "found"), [((0, 20), 1.0), ((0, 10, 20), 0.7), ((1, 2, 3, 4), 0.7), ((), 1.0)])
def test_it_may_grow_more_in_a_tenth_of_the_windows(
    monkeypatch: pytest.MonkeyPatch, wild: tuple[int, ...], found: float
) -> None:
    """Of twenty-one windows in two; the first and the last are among them."""

    def ends(windows: Any, away: Any) -> Any:
        growing = windows.start if windows.horizon == 1.0 else np.full(len(windows), -1)
        return away * np.where(np.isin(growing, 64 * np.array(wild, dtype=int)), 20.0, 1.0)[:, None]

    simulating(monkeypatch, ends, (1.0, 1.0))
    assert evidence_seconds(MODEL, [recording(rows_until(21.0, 1.0 / 64.0))]) == found


def test_of_many_windows_a_hundred_and_twenty_are_looked_at(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = simulating(monkeypatch, lambda _, away: away, (1.0, 1.0))
    evidence_seconds(MODEL, [recording(rows_until(300.0, 0.03125))])
    (windows,) = asked
    assert len(windows) == 120
    assert windows.start[[0, -1]].tolist() == [0, 299 * 32]
    assert set(np.diff(windows.start).tolist()) == {64, 96}


def test_windows_of_fewer_rows_than_others_are_followed_to_their_own_end(monkeypatch: pytest.MonkeyPatch) -> None:
    seconds = [start + np.arange(0.0, 1.0, 1.0 / (32 if start % 3 == 0 else 64)) for start in range(40)]
    asked = simulating(monkeypatch, lambda _, away: away, (1.0, 1.0))
    assert evidence_seconds(MODEL, [recording(np.concatenate(seconds))]) == 1.0
    assert len(set(asked[0].steps.tolist())) > 1


def test_what_is_of_another_robot_or_no_recording_is_refused() -> None:
    run = recording(rows_until(5.0, 0.25))
    other: Any = SimpleNamespace(system=CAR)
    with pytest.raises(InputError, match="one: a run of robot 'pendulum'"):
        evidence_seconds(other, [run])
    with pytest.raises(RunError, match="got none"):
        evidence_seconds(MODEL, [])


@pytest.mark.parametrize(
    ("period", "lasts", "least", "record"),
    [(1.0 / 64.0, 0.09375, 0.12, "5 s, better a minute"), (0.25, 1.5, 1.75, "17.5 s, better a minute"),
     (1.0, 6.0, 7.0, "70 s, better 140 s")],
)  # fmt: skip
def test_stretches_too_short_for_any_window_are_told_how_long_they_are_and_what_to_record(
    period: float, lasts: float, least: float, record: str
) -> None:
    runs = [
        recording(rows_until(2.0 * period, period), np.zeros(0), rows_until(lasts, period, 500.0)),
        recording(rows_until(period, period), name="two"),
    ]
    with pytest.raises(RunError) as told:
        evidence_seconds(MODEL, runs)
    assert str(told.value) == (
        f"one: the longest stretch without a gap lasts {lasts:.4g} s, and effects are judged over {least:g} s at "
        f"least; record {record}"
    )


@pytest.mark.parametrize(
    ("seconds", "wanted"),
    [(0.12, "5 s, better a minute"), (0.5, "5 s, better a minute"), (0.7, "7 s, better a minute"),
     (3.0, "30 s, better a minute"), (3.1, "31 s, better 62 s"), (7.0, "70 s, better 140 s")],
)  # fmt: skip
def test_ten_windows_and_five_seconds_are_worth_recording_and_twice_as_much_or_a_minute_is_better(
    seconds: float, wanted: str
) -> None:
    assert worth_recording(seconds) == wanted


@pytest.fixture
def named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(evidence, "shooting_of", lambda runs, seconds: ("to fit", runs, seconds))
    monkeypatch.setattr(evidence, "heldout_of", lambda runs, seconds: ("to judge", runs, seconds))


@pytest.mark.usefixtures("named")
def test_windows_to_fit_and_to_judge_are_of_the_same_seconds() -> None:
    runs: Any = ["a run"]
    found = evidence_at(runs, 0.7)
    assert (found.seconds, found.shooting, found.heldout) == (0.7, ("to fit", runs, 0.7), ("to judge", runs, 0.7))


@pytest.mark.usefixtures("named")
@pytest.mark.parametrize(
    ("horizon", "same"), [(0.7, True), (0.7 + 5e-10, True), (0.7 - 5e-10, True), (0.7 + 2e-9, False), (0.6, False),
                          (1.4, False), (-0.7, False)]
)  # fmt: skip
def test_what_is_shown_at_the_same_horizon_is_what_was_judged(horizon: float, same: bool) -> None:
    judged: Any = Evidence(0.7, "fitted", "judged")  # type: ignore[arg-type]
    runs: Any = ["a run"]
    assert shown_of(runs, horizon, judged) == ("judged" if same else ("to judge", runs, horizon))


@pytest.mark.usefixtures("named")
@pytest.mark.parametrize(
    ("seconds", "lasts", "found"),
    [
        (2.0, 40.0, [1.0, 0.4, 4.0]), (2.0, 39.98, [1.0, 0.4, 4.0]), (2.0, 39.9, [1.0, 0.4]),
        (0.75, 40.0, [0.375, 1.5]),
        (0.7, 40.0, [1.4]), (1.75, 40.0, [0.875, 3.5]), (1.5, 7.5, [0.75]), (1.5, 7.0, []), (2.0, 4.0, [0.4]),
    ],
)  # fmt: skip
def test_beside_it_half_a_fifth_and_twice_as_much_are_asked_where_six_rows_and_ten_windows_are(
    seconds: float, lasts: float, found: list[float]
) -> None:
    runs = [recording(rows_until(lasts, 0.0625)), recording(rows_until(0.5, 0.25), name="slow"),
            recording(rows_until(0.25, 1.0 / 64.0), name="quick")]  # fmt: skip
    asked = list(evidence_beside(runs, seconds))
    assert [item.seconds for item in asked] == pytest.approx(found)
    assert all(item.shooting == ("to fit", runs, item.seconds) for item in asked)
