"""Whether recordings allow a verdict and over how many seconds; which part of each range was driven."""

import re
from collections.abc import Callable, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from safedpa.diagnosis.coverage import coverage_of, within_coverage
from safedpa.diagnosis.fit import data_checks
from safedpa.diagnosis.fit.data_checks import (
    HorizonData,
    check_data_sufficiency,
    data_at_horizon,
    data_at_other_horizons,
    displayed_windows,
    prepare_runs,
    recommended_recording,
    select_horizon,
)
from safedpa.diagnosis.report_schema import CoverageGap, CoveredRange
from safedpa.dynamics import load_model
from safedpa.errors import InputError, RunError
from safedpa.records.column_map.column_map import native_map
from safedpa.records.quality.quality import run_of_rows
from safedpa.records.run import Finding, RawRows, Run, Stretch
from safedpa.report.diagnosis_story import gaps_clause
from safedpa.robots.car.system import CAR
from safedpa.robots.pendulum.system import PENDULUM
from safedpa_lab.experiments.diagnosis.real_logs import targets_of

MODEL: Any = SimpleNamespace(system=PENDULUM)
SHARES = (1.0, 0.7, 0.5, 0.35, 0.25, 0.18, 0.12)
SEVERE = ("swapped_columns", "opposite_sign", "unit_mistake", "yaw_inconsistent", "steer_inconsistent", "time_offset")


def driving(name: str, rows: int, actions: Any = None, findings: tuple[Finding, ...] = ()) -> Run:
    """A car at 10 rows a second."""
    made = np.random.default_rng(1).normal(size=(rows, 2)) if actions is None else np.asarray(actions, dtype=float)
    states = np.random.default_rng(rows).normal(size=(rows, 4))
    return Run(name, CAR, 0.1 * np.arange(rows), states, made, (Stretch(0, rows),), findings)


def windows(count: int, horizon: float = 1.0) -> Any:
    return SimpleNamespace(windows=type("Windows", (), {"__len__": lambda _: count, "horizon": horizon})())


@pytest.mark.parametrize(
    ("count", "rows", "enough"), [(10, 51, True), (9, 51, False), (10, 50, False), (9, 50, False), (1000, 1000, True)]
)
def test_ten_windows_and_five_seconds_are_enough(count: int, rows: int, enough: bool) -> None:
    run = driving("one", rows)
    found = check_data_sufficiency(windows(count), [run], [run])
    assert (found.enough, found.wrong) == (enough, False)
    seconds = 0.1 * (rows - 1)
    assert found.why_not == ("" if enough else (
        f"{seconds:.1f} s in {count} independent windows of 1 s are too little to judge an effect; record at least "
        "10 s, better a minute"
    ))  # fmt: skip


def test_only_the_seconds_of_the_runs_that_are_used_count_together() -> None:
    runs = [driving("one", 26), driving("two", 26)]
    assert check_data_sufficiency(windows(10), runs, runs).enough
    assert not check_data_sufficiency(windows(10), runs[:1], runs).enough


@pytest.mark.parametrize(
    ("seconds", "wanted"),
    [(0.12, "5 s, better a minute"), (0.5, "5 s, better a minute"), (0.7, "7 s, better a minute"),
     (3.0, "30 s, better a minute"), (3.1, "31 s, better 62 s"), (7.0, "70 s, better 140 s")],
)  # fmt: skip
def test_ten_windows_and_five_seconds_are_worth_recording(seconds: float, wanted: str) -> None:
    assert recommended_recording(seconds) == wanted
    run = driving("one", 20)
    assert check_data_sufficiency(windows(3, seconds), [run], [run]).why_not.endswith(f"record at least {wanted}")


def stepping(*sizes: float) -> Any:
    actions = np.tile([1.0, 2.0], (60, 1))
    actions[30:] += sizes
    return actions


@pytest.mark.parametrize(
    ("actions", "enough"),
    [(stepping(0.0, 0.0), False), (stepping(0.0, 0.9e-9), False), (stepping(0.0, 1.1e-9), True),
     (np.repeat(np.linspace(0.0, 1.0, 60)[:, None], 2, axis=1), True)],
)  # fmt: skip
def test_data_in_which_no_input_changes_allow_no_verdict(actions: Any, enough: bool) -> None:
    run = driving("one", 60, actions)
    found = check_data_sufficiency(windows(10), [run], [run])
    assert found.enough is enough
    assert ("no input ever changes" in found.why_not) is not enough


@pytest.mark.parametrize("kind", [*SEVERE, "gap", "constant_input"])
def test_a_recording_with_wrong_columns_or_units_allows_no_verdict(kind: str) -> None:
    """Whether it is used or not, and however much data there is."""
    bad = driving("bad", 60, findings=(Finding("jump", "a jump"), Finding(kind, "this one"), Finding(kind, "next")))
    found = check_data_sufficiency(windows(10), [driving("good", 60)], [driving("good", 60), bad])
    assert (found.wrong, found.why_not) == ((True, "bad: this one") if kind in SEVERE else (False, ""))
    assert found.enough is (kind not in SEVERE)


@pytest.fixture
def preparing(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.setattr(data_checks, "select_horizon", lambda model, runs: 0.7)
    return lambda runs, *most: prepare_runs(load_model("car"), runs, *most)


def test_findings_are_listed_and_a_repeated_recording_counts_once(preparing: Any) -> None:
    one = driving("one", 60, findings=(Finding("gap", "a gap", 2, 0.5),))
    again = Run("again", one.system, one.t, one.states, one.actions, one.stretches)
    found = preparing([one, again])
    assert ([run.name for run in found.runs], found.seconds) == (["one"], 0.7)
    assert found.quality[0] == {"run": "one", "kind": "gap", "message": "a gap", "count": 2, "start_t": 0.5}
    assert [item["run"] for item in found.quality] == ["one", "again"]


def test_thinned_rows_are_counted_and_reported(preparing: Any) -> None:
    def retained(found: Any) -> int:
        return sum(len(part) for run in found.runs for part in run.stretches)

    runs = [driving("one", 1000), driving("two", 1001)]
    whole = preparing(runs, 2001)
    assert (retained(whole), whole.quality) == (2001, [])
    found = preparing(runs, 500)
    assert retained(found) < 1000
    (reported,) = found.quality
    assert (reported["run"], reported["kind"], reported["count"]) == ("all", "thinned", 2001 - retained(found))
    assert reported["message"].startswith(f"of 2001 rows, {retained(found)} in evenly spread pieces")


def test_one_hour_at_10_rows_per_second_is_used_completely_and_three_hours_are_thinned(preparing: Any) -> None:
    assert preparing([driving("hour", 36_000)]).quality == []
    (reported,) = preparing([driving("hours", 108_000)]).quality
    assert reported["kind"] == "thinned"


@pytest.mark.parametrize(
    ("size", "still"),
    [((0.0, 1.0), [0]), ((1.0, 0.0), [1]), ((0.9e-9, 1.1e-9), [0]), ((0.0, 0.0), [0, 1]), ((1.0, 1.0), [])],
)
def test_an_input_that_never_changes_is_named(preparing: Any, size: tuple[float, float], still: list[int]) -> None:
    actions = stepping(*size) - [1.0, 2.0]
    quality = preparing([driving("one", 60, actions)]).quality
    names = ", ".join(CAR.action[index].name for index in still)
    found = [(item["run"], item["kind"], item["count"], item["message"].split(" never")[0]) for item in quality]
    assert found == [("one", "constant_input", 60, names)] * bool(still)
    known = driving("one", 60, actions, (Finding("constant_input", "known"),))
    assert [item["message"] for item in preparing([known]).quality] == ["known"]


def until(seconds: float, period: float, start: float = 100.0) -> Any:
    """Times of rows a period apart, the last one after ``seconds``."""
    return start + np.append(np.arange(0.0, seconds - 1e-9, period), seconds)


def recording(*parts: Any, name: str = "one") -> Run:
    t = np.concatenate(parts)
    ends = np.cumsum([0, *(len(part) for part in parts)]).tolist()
    states = np.random.default_rng(len(t)).normal(size=(len(t), 2))
    stretches = tuple(Stretch(ends[index], ends[index + 1]) for index in range(len(parts)))
    return Run(name, PENDULUM, t, states, np.zeros((len(t), 1)), stretches)


def simulating(monkeypatch: pytest.MonkeyPatch, ends: Callable[[Any, Any], Any], scale: Sequence[float]) -> list[Any]:
    """``ends(windows, away)`` says where windows end by how far starts (..., states) are from those measured."""
    seen: list[Any] = []

    def simulate(models: Any, found: Any, rows: Any, starts: Any) -> Any:
        seen.append(found)
        assert list(models) == [MODEL] * len(starts) == [MODEL] * 3
        assert (found.steps >= rows[-1]).all(), "beyond a window's end nothing is simulated"
        states = np.full((len(found), len(rows), 2, 3), np.nan)
        states[:, -1] = np.moveaxis(ends(found, starts - found.states[found.start]), 0, -1)
        return states

    def change_scale(found: Any, rows: Any) -> Any:
        assert rows.tolist() == found.end.tolist()
        return np.array(scale)

    monkeypatch.setattr(data_checks, "simulate", simulate)
    monkeypatch.setattr(data_checks, "change_scale", change_scale)
    return seen


@pytest.fixture
def calm(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """No error of a start grows."""
    return simulating(monkeypatch, lambda _, away: away, (1.0, 1.0))


@pytest.mark.usefixtures("calm")
@pytest.mark.parametrize("step", range(7))
@pytest.mark.parametrize(("lacking", "enough"), [(0.0, True), (0.4, True), (0.6, False)])
def test_the_horizon_is_the_longest_of_which_there_are_20_windows_up_to_half_a_row(step, lacking, enough):
    run = recording(until(20.0 * SHARES[step] - lacking / 64.0, 1.0 / 64.0))
    assert select_horizon(MODEL, [run]) == (SHARES[step] if enough else SHARES[min(step + 1, 6)])


@pytest.mark.usefixtures("calm")
@pytest.mark.parametrize(
    ("period", "seconds", "found"),
    [
        (1.0 / 54.0, 1.5, 0.12), (1.0 / 48.0, 1.5, 0.18), (1.0 / 16.0, 25.0, 1.25), (1.0 / 16.0, 24.0, 0.875),
        (1.0 / 16.0, 5.0, 0.438), (0.25, 100.0, 5.0), (0.25, 99.0, 3.5), (0.25, 40.0, 1.75), (0.25, 2.0, 1.75),
        (0.03125, 20.0, 1.0), (0.03125, 1.0, 0.25),
    ],
)  # fmt: skip
def test_the_longest_horizon_is_1_s_or_20_rows_and_the_shortest_6_rows(period, seconds, found):
    assert select_horizon(MODEL, [recording(until(seconds, period))]) == found


@pytest.mark.usefixtures("calm")
def test_windows_of_all_stretches_count_and_the_median_rate_decides() -> None:
    part = until(7.3, 1.0 / 64.0)
    runs = [recording(part, part + 50.0), recording(part, np.zeros(0), name="two")]
    assert select_horizon(MODEL, runs) == 1.0, "seven and seven and seven"
    assert select_horizon(MODEL, runs[:1]) == 0.7, "ten and ten"
    rates = [recording(until(90.0, period), name=str(period)) for period in (0.25, 0.125, 1.0 / 64.0)]
    assert select_horizon(MODEL, rates) == 2.5


NAN = float("nan")


@pytest.mark.parametrize(
    ("of_rate", "of_angle", "scale", "found"),
    [(31.9, 0.0, (2.0, 0.5), 1.0), (32.1, 0.0, (2.0, 0.5), 0.5), (0.0, 1.99, (2.0, 0.5), 1.0),
     (0.0, 2.01, (2.0, 0.5), 0.5), (31.9, 1.99, (2.0, 0.5), 1.0), (-31.9, 1.99, (2.0, 0.5), 1.0),
     (-32.1, 1.9, (2.0, 0.5), 0.5), (1e300, 0.0, (2.0, 0.5), 0.5), (NAN, 0.0, (2.0, 0.5), 0.5),
     (0.0, float("inf"), (2.0, 0.5), 0.5), (0.0, 7.9e-9, (1.0, 0.0), 1.0), (0.0, 8.1e-9, (1.0, 0.0), 0.5)],
)  # fmt: skip
def test_an_error_of_the_start_may_grow_eightfold_in_units_of_the_change_of_each_state(
    monkeypatch: pytest.MonkeyPatch, of_rate: float, of_angle: float, scale: tuple[float, float], found: float
) -> None:
    """Changes of 2 and 0.5: the angle takes a quarter of the first number, the rate four times the second.

    A state that never changes counts as if it changed by 1e-9.
    """

    def ends(made: Any, away: Any) -> Any:
        if made.horizon < 0.6:
            return 5.0 + 0.0 * away
        angle, rate = away[..., 0], away[..., 1]
        bent = float(scale[1] > 0.0)  # squares are small, as the shift is
        with np.errstate(all="ignore"):
            after = [5.0 + of_rate * rate + 100.0 * rate**2, of_angle * angle + 10.0 * bent * angle**2]
            return np.stack(after, axis=-1)

    simulating(monkeypatch, ends, scale)
    assert select_horizon(MODEL, [recording(until(25.0, 1.0 / 64.0))]) == found


@pytest.mark.parametrize(("wild", "found"), [((0, 20), 1.0), ((0, 10, 20), 0.7), ((1, 2, 3, 4), 0.7), ((), 1.0)])
def test_an_error_of_the_start_may_grow_more_in_a_tenth_of_the_windows(monkeypatch, wild, found):
    def ends(made: Any, away: Any) -> Any:
        growing = made.start if made.horizon == 1.0 else np.full(len(made), -1)
        return away * np.where(np.isin(growing, 64 * np.array(wild, dtype=int)), 20.0, 1.0)[:, None]

    simulating(monkeypatch, ends, (1.0, 1.0))
    assert select_horizon(MODEL, [recording(until(21.0, 1.0 / 64.0))]) == found


def test_of_many_windows_about_a_hundred_evenly_spread_ones_are_simulated(calm: list[Any]) -> None:
    select_horizon(MODEL, [recording(until(300.0, 0.03125))])
    (found,) = calm
    assert 100 <= len(found) <= 150
    assert found.start[[0, -1]].tolist() == [0, 299 * 32]
    assert set(np.diff(found.start).tolist()) == {64, 96}
    mixed = [start + np.arange(0.0, 1.0, 1.0 / (32 if start % 3 == 0 else 64)) for start in range(40)]
    assert select_horizon(MODEL, [recording(np.concatenate(mixed))]) == 1.0
    assert len(set(calm[-1].steps.tolist())) > 1, "each window is followed to its own end"


@pytest.mark.parametrize(
    ("period", "lasts", "least"), [(1.0 / 64.0, 0.09375, 0.12), (0.25, 1.5, 1.75), (1.0, 6.0, 7.0)]
)
def test_runs_of_another_robot_or_too_short_for_any_window_are_refused(period, lasts, least):
    runs = [
        recording(until(2.0 * period, period), np.zeros(0), until(lasts, period, 500.0)),
        recording(until(period, period), name="two"),
    ]
    message = f"one: the longest stretch without a gap lasts {lasts:.4g} s, and effects are judged over {least:g} s"
    with pytest.raises(RunError, match=f"^{re.escape(message)} at least; record {recommended_recording(least)}$"):
        select_horizon(MODEL, runs)
    other: Any = SimpleNamespace(system=CAR)
    with pytest.raises(InputError, match="one: a run of robot 'pendulum'"):
        select_horizon(other, [recording(until(5.0, 0.25))])
    with pytest.raises(RunError, match="got none"):
        select_horizon(MODEL, [])


@pytest.fixture
def named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(data_checks, "shooting_of", lambda runs, seconds: ("to fit", runs, seconds))
    monkeypatch.setattr(data_checks, "heldout_of", lambda runs, seconds: ("to judge", runs, seconds))


@pytest.mark.usefixtures("named")
@pytest.mark.parametrize(
    ("horizon", "same"), [(0.7, True), (0.7 + 5e-10, True), (0.7 - 5e-10, True), (0.7 + 2e-9, False), (0.6, False),
                          (1.4, False), (-0.7, False)]
)  # fmt: skip
def test_windows_that_are_shown_at_the_same_horizon_are_those_that_were_judged(horizon: float, same: bool) -> None:
    runs: Any = ["a run"]
    found = data_at_horizon(runs, 0.7)
    assert (found.seconds, found.shooting, found.heldout) == (0.7, ("to fit", runs, 0.7), ("to judge", runs, 0.7))
    judged: Any = HorizonData(0.7, "fitted", "judged")  # type: ignore[arg-type]
    assert displayed_windows(runs, horizon, judged) == ("judged" if same else ("to judge", runs, horizon))


@pytest.mark.usefixtures("named")
@pytest.mark.parametrize(
    ("seconds", "lasts", "found"),
    [
        (2.0, 40.0, [1.0, 0.4, 4.0]), (2.0, 39.98, [1.0, 0.4, 4.0]), (2.0, 39.9, [1.0, 0.4]),
        (0.75, 40.0, [0.375, 1.5]), (0.7, 40.0, [1.4]), (1.75, 40.0, [0.875, 3.5]), (1.5, 7.5, [0.75]), (1.5, 7.0, []),
        (2.0, 4.0, [0.4]),
    ],
)  # fmt: skip
def test_half_a_fifth_and_twice_the_horizon_are_tried_if_6_rows_and_10_windows_fit(seconds, lasts, found):
    runs = [recording(until(lasts, 0.0625)), recording(until(0.5, 0.25), name="slow"),
            recording(until(0.25, 1.0 / 64.0), name="quick")]  # fmt: skip
    tried = list(data_at_other_horizons(runs, seconds))
    assert [item.seconds for item in tried] == pytest.approx(found)
    assert all(item.shooting == ("to fit", runs, item.seconds) for item in tried)


def driven(throttle, steer=None):
    """A recording at 20 Hz of a car with a throttle; its speed is three times that."""
    system = load_model("dart_car").system
    throttle = np.asarray(throttle)
    t = 0.05 * np.arange(len(throttle))
    steer = 0.3 * np.sin(t) if steer is None else steer
    states = np.column_stack([t, t, 0.0 * t, 3.0 * throttle])
    made = RawRows(t, states, np.column_stack([throttle, steer]))
    return run_of_rows(Path("drive.csv"), system, native_map(system), made, ())


def two_throttles():
    """Half a minute about 0.01, two minutes between 0.4 and 0.6, and hardly anything between."""
    slow, fast = (at + size * np.sin(0.7 * np.arange(2400) * 0.05) for at, size in ((0.01, 0.01), (0.5, 0.1)))
    return driven(np.concatenate([slow[:600], np.linspace(0.02, 0.4, 20), fast]))


def by_name(runs):
    return {item.variable: item for item in coverage_of(runs)}


def test_a_throttle_range_that_was_only_passed_through_is_a_gap():
    found = by_name([two_throttles()])
    assert set(found) == {"speed", "throttle", "steer"}  # neither a place nor an angle
    throttle = found["throttle"]
    assert throttle.low == pytest.approx(0.0, abs=0.01)
    assert throttle.high == pytest.approx(0.6, abs=0.01)
    (gap,) = throttle.gaps
    assert gap.low == pytest.approx(0.06, abs=0.01)
    assert gap.high == pytest.approx(0.42, abs=0.07)
    assert gap.seconds < 3.0
    assert not found["steer"].gaps


def test_an_even_drive_has_no_gap_and_few_data_have_no_coverage():
    even = np.random.default_rng(1).uniform(0.0, 0.6, 4800)
    assert not any(item.gaps for item in coverage_of([driven(even)]))
    assert (coverage_of([driven(even[:200])]), coverage_of([])) == ((), ())
    assert "throttle" not in by_name([driven(np.full(4800, 0.3))])


FULL = 400


def by_parts(*counts, level=0.0, rows=4000, period=0.0625):
    """The range of a throttle with so many rows at 0.5, 1.5 and so on; the seventh part is filled up to ``rows``.

    4000 rows in 250 s: a block is a fortieth, 100 rows.
    """
    counts = list(counts)
    counts[6] += rows - sum(counts)
    throttle = level + np.concatenate([np.full(count, part + 0.5) for part, count in enumerate(counts)])
    system, t = load_model("dart_car").system, period * np.arange(rows)
    actions = np.column_stack([throttle, 0.0 * t])
    return by_name([Run("one", system, t, np.zeros((rows, 4)), actions, (Stretch(0, rows),))]).get("throttle")


@pytest.mark.parametrize(
    ("counts", "gaps"),
    [
        ([FULL] * 10, []),
        ([FULL, FULL, 0, *[FULL] * 7], []),  # both sides say what lies in a single part
        ([FULL, FULL, 60, 39, *[FULL] * 6], [(2.3, 4.1, 99)]), ([FULL, FULL, 99, 99, *[FULL] * 6], [(2.3, 4.1, 198)]),
        ([FULL, FULL, 100, 39, *[FULL] * 6], []),  # a block is enough
        ([FULL, FULL, 0, 0, 0, 30, FULL, FULL, 0, FULL], [(2.3, 5.9, 30)]),
    ],
)  # fmt: skip
def test_a_gap_is_two_parts_of_ten_or_more_with_less_than_a_block_each(counts, gaps):
    found = by_parts(*counts)
    assert (found.seconds, found.low, found.high) == (pytest.approx(250.0), 0.5, pytest.approx(9.5))
    edges = [(gap.low, gap.high, gap.seconds) for gap in found.gaps]
    assert edges == [pytest.approx((low, high, 0.0625 * rows)) for low, high, rows in gaps]


@pytest.mark.parametrize(("end", "low", "high"), [(49, 1.5, 8.5), (60, 1.4, 8.6), (100, 0.5, 9.5)])
def test_the_ends_of_a_range_hold_half_a_block_and_its_last_parts_a_block(end, low, high):
    found = by_parts(end, *[FULL] * 8, end)
    assert (found.low, found.high) == (pytest.approx(low), pytest.approx(high))


def test_a_minute_is_needed_and_a_throttle_that_changes():
    assert by_parts(*[96] * 10, rows=976) is not None, "61 s"
    assert by_parts(*[94] * 10, rows=944) is None, "59 s"
    assert by_parts(0, 0, 0, 0, 0, 0, 4000) is None
    assert by_parts(*[FULL] * 10, level=-30.0).low == pytest.approx(-29.5), "of any sign"


def test_a_range_holds_both_its_ends_and_a_gap_its_lower_one():
    system = load_model("dart_car").system
    found = [CoveredRange("throttle", "1", 0.0, 1.0, 200.0, (CoverageGap(0.4, 0.6, 1.0),))]
    tried = np.array([-1e-9, 0.0, 0.4 - 1e-9, 0.4, 0.6 - 1e-9, 0.6, 1.0, 1.0 + 1e-9])
    notice = within_coverage(found, system, np.zeros((8, 4)), np.column_stack([tried, 0 * tried]))
    assert notice.tolist() == [False, True, True, False, False, True, True, False]


def test_the_first_sentence_names_the_widest_gaps():
    throttle = {"variable": "throttle", "unit": "1", "low": 0.0, "high": 0.6, "seconds": 270.0}
    gaps = [{"low": 0.08, "high": 0.32, "seconds": 9.2}]
    assert "throttle 0.08 to 0.32 (9 of 270 s)" in gaps_clause({"coverage": [{**throttle, "gaps": gaps}]})
    assert gaps_clause({"coverage": [{**throttle, "gaps": []}]}) == ""
    assert gaps_clause({}) == ""


def test_a_left_out_log_is_also_judged_within_the_coverage_of_the_others():
    row = {"part": "car", "name": "one.csv", "change": -0.7, "added": ["a"], "verdict": "x", "unseen_change": -0.1}
    found = targets_of([{**row, "unseen_told": 0.2, "unseen_where_told": [0.5, 0.3]}])
    assert [item["met"] for item in found] == [False, True]
    assert found[1]["measured"] == "-40.0 %; 20 % of its predictions lie there"
