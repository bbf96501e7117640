"""Whether recordings allow a verdict: by seconds, windows, findings and inputs that stand still, by hand."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from safedpa.diagnosis.fit import readiness
from safedpa.diagnosis.fit.readiness import MOST_ROWS, judgeable, prepared
from safedpa.dynamics import load_model
from safedpa.records.run import Finding, Run, Stretch

CAR = load_model("car").system


def recording(
    name: str, rows: int, actions: Any = None, findings: tuple[Finding, ...] = (), period: float = 0.1
) -> Run:
    made = np.random.default_rng(1).normal(size=(rows, 2)) if actions is None else np.asarray(actions, dtype=float)
    states = np.random.default_rng(rows).normal(size=(rows, 4))
    return Run(name, CAR, period * np.arange(rows), states, made, (Stretch(0, rows),), findings)


def windows(count: int, horizon: float = 1.0) -> Any:
    made = SimpleNamespace(horizon=horizon, __len__=lambda: count)
    return SimpleNamespace(windows=type("Windows", (), {"__len__": lambda _: count, "horizon": made.horizon})())


@pytest.mark.parametrize(
    ("count", "rows", "enough"),
    [(10, 51, True), (9, 51, False), (10, 50, False), (9, 50, False), (1000, 1000, True)],
)
def test_ten_windows_and_five_seconds_are_enough(count: int, rows: int, enough: bool) -> None:
    run = recording("one", rows)
    found = judgeable(windows(count), [run], [run])
    assert (found.enough, found.wrong) == (enough, False)
    if not enough:
        seconds = 0.1 * (rows - 1)
        assert found.why_not == (
            f"{seconds:.1f} s in {count} independent windows of 1 s are too little to judge an effect; record at least "
            "10 s, better a minute"
        )


@pytest.mark.parametrize(("horizon", "wanted"), [(0.12, "5 s"), (0.5, "5 s"), (0.7, "7 s"), (2.0, "20 s")])
def test_it_is_told_how_much_is_wanted(horizon: float, wanted: str) -> None:
    run = recording("one", 20)
    assert judgeable(windows(3, horizon), [run], [run]).why_not.endswith(f"record at least {wanted}, better a minute")
    assert judgeable(windows(3, 7.0), [run], [run]).why_not.endswith("record at least 70 s, better 140 s")


def test_seconds_of_several_recordings_count_together() -> None:
    runs = [recording("one", 26), recording("two", 26)]
    assert judgeable(windows(10), runs, runs).enough
    assert not judgeable(windows(10), runs[:1], runs).enough, "what was not used counts for nothing"


@pytest.mark.parametrize(("step", "enough"), [(0.0, False), (0.9e-9, False), (1.1e-9, True), (0.1, True)])
def test_inputs_of_which_none_ever_changes_tell_nothing(step: float, enough: bool) -> None:
    actions = np.tile([1.0, 2.0], (60, 1))
    actions[30:, 1] += step
    run = recording("one", 60, actions)
    found = judgeable(windows(10), [run], [run])
    assert found.enough is enough
    assert found.why_not == ("" if enough else found.why_not)
    assert enough or "no input ever changes" in found.why_not


def test_one_input_that_changes_beside_one_alike_is_enough() -> None:
    run = recording("one", 60, np.repeat(np.linspace(0.0, 1.0, 60)[:, None], 2, axis=1))
    assert judgeable(windows(10), [run], [run]).enough


SEVERE = ("swapped_columns", "opposite_sign", "unit_mistake", "yaw_inconsistent", "steer_inconsistent", "time_offset")


@pytest.mark.parametrize("kind", [*SEVERE, "gap", "constant_input"])
def test_what_is_something_else_than_it_says_allows_no_verdict(kind: str) -> None:
    """Whether it is used or not, and however much there is."""
    bad = recording("bad", 60, findings=(Finding("jump", "a jump"), Finding(kind, "this one"), Finding(kind, "next")))
    good = recording("good", 60)
    found = judgeable(windows(10), [good], [good, bad])
    assert (found.wrong, found.why_not) == ((True, "bad: this one") if kind in SEVERE else (False, ""))
    assert found.enough is (kind not in SEVERE)


@pytest.fixture
def preparing(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.setattr(readiness, "evidence_seconds", lambda model, runs: 0.7)
    return lambda runs, *most: prepared(load_model("car"), runs, *most)


def test_what_was_found_in_each_recording_is_listed_and_a_repeated_one_counts_once(preparing: Any) -> None:
    one = recording("one", 60, findings=(Finding("gap", "a gap", 2, 0.5),))
    found = preparing(
        [one, Run("again", *[getattr(one, f) for f in ("system", "t", "states", "actions", "stretches")])]
    )
    assert [run.name for run in found.runs] == ["one"]
    assert found.seconds == 0.7
    assert found.quality[0] == {"run": "one", "kind": "gap", "message": "a gap", "count": 2, "start_t": 0.5}
    assert [item["run"] for item in found.quality] == ["one", "again"]


def test_of_more_rows_than_are_used_it_is_told_how_many(preparing: Any) -> None:
    runs = [recording("one", 1000), recording("two", 1001)]
    whole = preparing(runs, 2001)
    assert (sum(len(run.t[s.start : s.stop]) for run in whole.runs for s in run.stretches), whole.quality) == (2001, [])
    found = preparing(runs, 500)
    kept = sum(len(part) for run in found.runs for part in run.stretches)
    assert kept < 1000
    (told,) = found.quality
    assert (told["run"], told["kind"], told["count"]) == ("all", "thinned", 2001 - kept)
    assert told["message"].startswith(f"of 2001 rows, {kept} in evenly spread pieces")
    assert MOST_ROWS == 40_000


@pytest.mark.parametrize(
    ("size", "told"),
    [((0.0, 1.0), ["0"]), ((1.0, 0.0), ["1"]), ((0.9e-9, 1.1e-9), ["0"]), ((0.0, 0.0), ["0", "1"]), ((1.0, 1.0), [])],
)  # fmt: skip
def test_an_input_that_never_changes_is_named(preparing: Any, size: tuple[float, float], told: list[str]) -> None:
    actions = np.zeros((60, 2))
    actions[30:] = size
    quality = preparing([recording("one", 60, actions)]).quality
    names = ", ".join(CAR.action[int(index)].name for index in told)
    assert [(item["run"], item["kind"], item["count"]) for item in quality] == [("one", "constant_input", 60)] * bool(
        told
    )
    assert [item["message"].startswith(f"{names} never changes:") for item in quality] == [True] * bool(told)
    known = recording("one", 60, actions, (Finding("constant_input", "known"),))
    assert [item["message"] for item in preparing([known]).quality] == ["known"]
