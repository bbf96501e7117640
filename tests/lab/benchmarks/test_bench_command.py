"""How the benchmark measures, compares and keeps what it found; its command; two checkouts side by side."""

import json
import math
import sys
import venv
from collections import Counter
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from safedpa.errors import InputError, SafedpaError
from safedpa_lab.benchmarks import suite
from safedpa_lab.benchmarks.against import FIGURES, against, checkout_of, interval_of_median
from safedpa_lab.benchmarks.peer_process import ask_peer, interpreter_with
from safedpa_lab.benchmarks.results import Curve, Effort, Entry, Row, Target, microseconds, missing
from safedpa_lab.benchmarks.rows import ROWS
from safedpa_lab.benchmarks.suite import chosen_rows, read_document, run_rows
from safedpa_lab.benchmarks.table import figure_text, markdown, row_lines, target_texts
from safedpa_lab.benchmarks.timing import PERCENTILES, percentiles, rate, timed
from safedpa_services.command_line.group import safedpa


@given(st.lists(st.floats(0.0, 1e9), min_size=1, max_size=50))
def test_percentiles_lie_in_order_within_what_was_measured(values: list[float]) -> None:
    found = percentiles(values)
    in_order = [found[name] for name in (*PERCENTILES, "longest")]
    assert (in_order, found["longest"]) == (sorted(in_order), pytest.approx(max(values), abs=0.006))


def test_every_input_is_called_in_turn_and_warmed_up() -> None:
    calls: Counter[int] = Counter()
    times = timed(lambda given: calls.update([given]), [1, 2, 3], 300, seconds=60.0)
    assert times["calls"] == 300
    assert set(calls.values()) == {110}  # a tenth of the calls before
    assert times["wall"]["p50"] >= 0.0
    assert times["processor"]["p50"] >= 0.0


@pytest.mark.long
def test_a_slow_call_ends_with_what_there_is() -> None:
    assert timed(lambda _: sum(range(1000)), [0], 10**6, seconds=0.0)["calls"] == 21


def test_a_rate_counts_units() -> None:
    one, ten = (rate(lambda: sum(range(20_000)), units, 0.0, least=9)["best_per_second"] for units in (1.0, 1e6))
    assert ten > 100.0 * one


def _row(better: Any = "less") -> Row:
    times = {"wall": {"p50": 10.0, "p99": 20.0, "p999": 30.0}, "processor": {"p50": 9.0}, "calls": 3}
    ours = (microseconds("safedpa", times, "small"), Entry("safedpa", {"p50": 40.0}, problem="large"))
    peers = (
        Entry("other", {"p50": 20.0}, problem="large", note="does less"),
        missing("third", "not installed", "small"),
    )
    curve = Curve("growth", "size", "us", (1.0, 2.0), {"safedpa": (10.0, 40.0), "other": (None, 20.0)})
    targets = (Target("p50", 10.0, 10.0, "us"), Target("rate", 5.0, 4.0, "steps/s", "more"))
    return Row("filter", "one thing", "p50", ours, peers, targets, (curve,), better, ("a note",))


def test_a_peer_is_compared_on_the_same_problem_alone() -> None:
    less, more = _row(), _row("more")
    assert (less.ratio(less.peers[0]), more.ratio(more.peers[0])) == (pytest.approx(0.5), pytest.approx(2.0))
    assert less.ratio(less.peers[1]) is None
    assert less.ratio(Entry("foreign", {"p50": 1.0}, problem="none of ours")) is None


def test_a_target_is_reached_from_its_own_side() -> None:
    assert [target.reached for target in _row().targets] == [True, False]
    document = _row().as_document()
    assert [target["reached"] for target in document["targets"]] == [True, False]
    assert [peer["ratio"] for peer in document["peers"]] == [0.5, None]
    assert json.loads(json.dumps(document, allow_nan=False)) == json.loads(json.dumps(document))


def test_rows_are_chosen_in_their_order() -> None:
    everything = chosen_rows((), Effort(full=True))
    assert everything == list(ROWS)
    assert set(everything) - set(chosen_rows((), Effort())) == {"kernel", "largest-fleet", "long-logs", "weights"}
    assert chosen_rows(("start", "filter"), Effort()) == ["filter", "start"]
    with pytest.raises(InputError, match="adaptation"):
        chosen_rows(("adaption",), Effort())


def test_results_are_kept_row_by_row(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[str] = []

    def measured(name: str, effort: Effort) -> Row:
        del effort
        asked.append(name)
        if name == "batch":
            raise SafedpaError("no room")
        return _row()

    monkeypatch.setattr(suite, "measured", measured)
    file, reported = tmp_path / "speed.json", []
    run_rows(["filter", "batch"], Effort(), file, lambda name, _: reported.append(name))
    assert "failed" in read_document(file)["rows"]["batch"]
    run_rows(["adaptation"], Effort(), file, lambda name, _: reported.append(name))
    assert list(read_document(file)["rows"]) == ["filter", "adaptation", "batch"]
    asked.clear()
    run_rows(["filter", "adaptation", "batch"], Effort(), file, lambda name, _: reported.append(name), resume=True)
    assert (asked, reported) == (["batch"], ["filter", "batch", "adaptation", "filter", "adaptation", "batch"])
    row = read_document(file)["rows"]["filter"]
    assert row["machine"]["cores"] >= 1
    assert row["effort"] == "usual"


def test_a_foreign_file_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "speed.json"
    file.write_text("[]", encoding="utf-8")
    with pytest.raises(InputError, match="no results of this benchmark"):
        read_document(file)


def _document(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    monkeypatch.setattr(suite, "measured", lambda name, effort: _row())
    return run_rows(["filter", "adaptation"], Effort(quick=True), tmp_path / "speed.json", lambda name, row: None)


def test_the_table_has_every_figure(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    document = _document(tmp_path, monkeypatch)
    columns, lines = row_lines(document["rows"]["filter"])
    assert columns == ["program", "problem", "p50", "p99", "p99.9", "processor", "times ahead"]
    assert all(len(line) == len(columns) for line in lines)
    assert lines[0][2:] == ("10.0 us", "20.0 us", "30.0 us", "9.00 us", "")
    assert (lines[2][-1], lines[3][2:]) == ("0.50", ("-",) * 5)
    page = markdown(document)
    for phrase in ("## filter", "does less", "not installed", "a note", "not reached", "load average", "effort quick"):
        assert phrase in page
    assert target_texts(document["rows"]["filter"])[0] == "p50, at most 10.0 us, 10.0 us, reached"
    assert [figure_text(value, "us") for value in (None, 1.234, 123.4, 2.5e6)] == ["-", "1.23 us", "123 us", "2.50 s"]
    assert figure_text(5.1e6, "steps/s") == "5.10 Msteps/s"


def test_a_missing_peer_is_reported() -> None:
    answer = ask_peer("filters:cvxpy", "no_such_package_anywhere", {}, ())
    assert "no_such_package_anywhere is not installed" in answer["missing"]
    assert interpreter_with("json", (sys.executable,)) == sys.executable


def test_a_peer_answers_in_a_python_that_knows_nothing_of_this_project(tmp_path, monkeypatch) -> None:
    venv.create(tmp_path / "peer")
    inside = next((tmp_path / "peer" / "lib").glob("python*")) / "site-packages"
    (inside / "numpy.pth").write_text(str(Path(np.__file__).parents[1]), encoding="utf-8")
    (inside / "casadi.py").write_text("raise ImportError('this is no casadi')", encoding="utf-8")
    other = tmp_path / "elsewhere"
    (other / "safedpa_lab").mkdir(parents=True)
    (other / "safedpa_lab" / "__init__.py").write_text("raise ImportError('found on the path')", encoding="utf-8")
    monkeypatch.setenv("PYTHONPATH", str(other))
    answer = ask_peer("filters:casadi", "casadi", {"problems": []}, (str(tmp_path / "peer" / "bin" / "python"),))
    assert answer == {"answers": []}


def test_a_failing_peer_is_reported_with_its_exit_code() -> None:
    assert "exit code 1" in ask_peer("adaptation:onnx", "json", {}, ())["missing"]


ROOT = Path(__file__).parents[3]


def test_a_machine_that_slows_down_does_not_change_the_ratio() -> None:
    """It becomes a tenth slower from drive to drive; ours takes 1.2 times as long."""
    drives, asked = count(), []

    def drive(folder: Path) -> dict[str, float]:
        asked.append(folder.name)
        return {"time": 1.1 ** next(drives) * (1.2 if folder.name == "ours" else 1.0)}

    found = against(Path("ours"), Path("other"), 20, 1.0, drive=drive)["figures"]["time"]
    assert (asked[:6], len(asked)) == (["other", "ours", "ours", "other", "other", "ours"], 42)
    assert found["ratio"] == pytest.approx(1.2, rel=0.1)
    low, high = found["interval"]
    assert low <= 1.2 <= high


@pytest.mark.parametrize(("number", "low", "high"), [(3, 0, 2), (5, 0, 4), (6, 0, 5), (10, 1, 8), (20, 5, 14)])
def test_the_interval_is_that_of_the_sign_test(number: int, low: int, high: int) -> None:
    assert interval_of_median([float(value) for value in range(number)]) == (low, high)
    outside = 2.0 * sum(math.comb(number, rank) for rank in range(low + 1)) / 2.0**number
    assert number < 6 or outside <= 0.05


def test_what_is_no_checkout_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="wanted a checkout"):
        checkout_of(tmp_path)
    assert checkout_of(ROOT) == ROOT


@pytest.mark.long
@pytest.mark.processes
@pytest.mark.slow
def test_this_checkout_against_itself(capsys: pytest.CaptureFixture[str]) -> None:
    assert safedpa.run(["bench", "against", str(ROOT), "--pairs", "1", "--seconds", "1", "--json"]) == 0
    figures = json.loads(capsys.readouterr().out)["figures"]
    assert 0.1 < figures["start to the first action"]["ours"] < 180.0
    assert figures["sense to act, p50"]["ratio"] > 0.0


@pytest.mark.parametrize(("most", "code"), [("1.1", 1), ("1.3", 0)])
def test_what_is_slower_than_it_may_be_ends_with_an_error(most, code, tmp_path, monkeypatch) -> None:
    for name in ("shared/safedpa", "services", "sim"):
        (tmp_path / name).mkdir(parents=True)
    (tmp_path / "shared/safedpa/__init__.py").touch()

    def drive(folder: Path, *_: object) -> dict[str, float]:
        return dict.fromkeys(FIGURES, 1.0 if folder == tmp_path else 1.2)

    monkeypatch.setattr("safedpa_lab.benchmarks.against.driven", drive)
    assert safedpa.run(["bench", "against", str(tmp_path), "--pairs", "1", "--seconds", "1", "--most", most]) == code


@pytest.mark.long
@pytest.mark.processes
@pytest.mark.slow
def test_rows_of_this_checkout_against_itself(capsys: pytest.CaptureFixture[str]) -> None:
    rows = ["--only", "batch", "--only", "decision-parts"]  # of those that load neither torch nor another's programs
    assert safedpa.run(["bench", "against", str(ROOT), "--pairs", "1", *rows, "--json"]) == 0
    figures = json.loads(capsys.readouterr().out)["figures"]
    assert {"decision-parts, the whole decision, physics [us]", "batch, all at once [us]"} <= set(figures)
    assert all(row["unit"] == "us" and 1.0 < row["ours"] < 1e5 for row in figures.values())


@pytest.mark.slow
def test_the_rows_are_listed(capsys: pytest.CaptureFixture[str]) -> None:
    assert safedpa.run(["bench", "list"]) == 0
    notice = capsys.readouterr().out
    assert all(name in notice for name in ROWS)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "phrase"),
    [
        (["--quick", "--full"], "choose one"),
        (["--only", "filters"], "filter"),
        (["--data", "nowhere"], "--data nowhere: no such folder"),
    ],
)
def test_what_makes_no_sense_is_refused(arguments: list[str], phrase: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert safedpa.run(["bench", "all", *arguments]) == 2
    assert phrase in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.long
def test_a_quick_run_has_every_part(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file, page = tmp_path / "speed.json", tmp_path / "speed.md"
    rows = ("adaptation", "batch", "point-steps")
    only = [word for name in rows for word in ("--only", name)]
    pictures = ["--pictures", str(tmp_path)]
    assert safedpa.run(["bench", "all", "--quick", *only, "--json", str(file), "--markdown", str(page), *pictures]) == 0
    document = json.loads(file.read_text(encoding="utf-8"))
    assert tuple(document["rows"]) == rows
    notice = capsys.readouterr().out
    for name, row in document["rows"].items():
        assert "failed" not in row, row
        assert name in notice
        assert f"## {name}" in page.read_text(encoding="utf-8")
        assert row["targets"]
        assert all(entry["figures"][row["figure"]] > 0.0 for entry in row["ours"])
        assert all(entry["figures"] or entry["missing"] for entry in row["peers"])
        if row["figure"] == "p50":
            assert all({"p50", "p99", "p999"} <= set(entry["figures"]) for entry in row["ours"])
    assert (tmp_path / "speed.png").exists()
    assert (tmp_path / "speed_growth.png").exists()
