"""The benchmark of many robots: with processes in small, and the search for the largest fleet without."""

import json
import os
from typing import Any

import pytest
from click.testing import CliRunner
from hypothesis import given
from hypothesis import strategies as st

from safedpa.errors import InputError, SafedpaError
from safedpa_lab.benchmarks import fleet as module
from safedpa_lab.benchmarks.fleet import FleetTrial, fleet_benchmark, largest_fleet
from safedpa_lab.benchmarks.hostile.offering import FREEZES
from safedpa_lab.benchmarks.usage import usage_of
from safedpa_lab.commands.bench import command


@pytest.mark.long
def test_three_robots_a_flood_and_hostile_offers_through_real_processes() -> None:
    result = fleet_benchmark(FleetTrial(robots=3, seconds=2.0, loads="none,box", flood=True, offers=0.5))
    assert result["robots"] == 3
    assert result["robot_ticks"] > 60, "it stood most of the time"
    assert result["late_ticks"] < result["robot_ticks"], "not one action came in time"
    references = {name for name in result["processes"] if name.startswith("reference_")}
    others = {"robots", "adaptation", "policy", "safety_filter", "flood", "offers"}
    assert set(result["processes"]) == others | references
    assert references
    for used in result["processes"].values():
        assert used["us_per_robot_tick"] > 0.0
        assert used["mib_end"] > 10.0
        assert used["handles_end"] >= 3
    froze = result["offers"]["answers"][FREEZES]
    assert froze["refused"] == froze["answers"] > 0
    assert "at most 65536" in froze["reason"]
    usual = result["offers"]["in_peace"]["sense_to_act_ms"]["p50"]
    assert froze["after_state_ms"]["p50"] < 40.0 + 5.0 * usual, "it is refused in the tick in which it is heard"
    assert result["offers"]["under_attack"]["robot_ticks"] > 20
    json.dumps(result)


@pytest.mark.long
def test_a_process_that_cannot_start_ends_the_benchmark_with_its_last_message() -> None:
    with pytest.raises(SafedpaError, match=r"ended with exit code 2.*no_such_load"):
        fleet_benchmark(FleetTrial(robots=1, seconds=1.0, loads="no_such_load"))


@given(largest=st.integers(0, 700), begin=st.integers(1, 80))
def test_doubling_and_bisection_find_the_largest_fleet(largest: int, begin: int) -> None:
    tried: list[int] = []

    def measure(trial: FleetTrial) -> dict[str, Any]:
        return {"holds": trial.robots <= largest, "robots": trial.robots}

    found = largest_fleet(FleetTrial(begin, 1.0), lambda result: tried.append(result["robots"]), measure)
    assert found <= largest
    assert found + 1 > largest / 1.07 or largest - found <= 1
    assert len(tried) == len(set(tried)) <= 16


def test_the_kernel_reports_what_a_process_used_until_it_is_gone() -> None:
    used = usage_of(os.getpid())
    assert used is not None
    assert used.cpu_seconds > 0.0
    assert used.resident_mib > 10.0
    with open(os.devnull, "rb"), open(os.devnull, "rb"):
        more = usage_of(os.getpid())
    assert more is not None
    assert more.handles == used.handles + 2
    assert usage_of(2**22 + 1) is None


def test_the_command_prints_one_document_or_lines(monkeypatch: pytest.MonkeyPatch) -> None:
    times = {"p50": 3000, "p99": 5000, "p999": 6000, "longest": 7000}
    used = {"cores": 0.2, "us_per_robot_tick": 200.0, "mib_begin": 50.0, "mib_end": 50.1}
    used |= {"handles_begin": 17, "handles_end": 18}
    result = {
        "rate_hz": 20.0, "seconds": 5.0, "robots": 50, "robot_ticks": 5000, "late_ticks": 3, "late_share": 0.0006,
        "late_while_held_up": 1, "holds": True, "load_average": [0.1, 0.2], "sense_to_act_us": times,
        "own_lateness_us": times, "processes": {"policy": used}, "goals_reached": 4, "collisions": 0, "refusals": {},
    }  # fmt: skip
    monkeypatch.setattr(module, "fleet_benchmark", lambda trial, report_progress: {**result, "robots": trial.robots})
    monkeypatch.setattr("safedpa_lab.benchmarks.latency.bare_chain", lambda *_: {"p50": 1000.0, "p99": 1500.0})
    printed = CliRunner().invoke(command, ["fleet", "--robots", "7"], catch_exceptions=False).output
    assert "7 robots at 20 Hz for 20" in printed or "7 robots at 20 Hz for 5" in printed
    assert "3 of 5000 ticks late (0.060 %" in printed
    assert "50.0 to 50.1 MiB   17 to 18 open files" in printed
    document = json.loads(CliRunner().invoke(command, ["fleet", "--json"], catch_exceptions=False).output)
    assert document["bare_chain_us"]["p50"] == 1000.0
    assert document["trials"][0]["robots"] == 50


@pytest.mark.parametrize("options", [("--robots", "0"), ("--robots", "2000"), ("--seconds", "0.1"), ("--rate", "900")])
def test_invalid_options_are_refused_with_a_reason(options: tuple[str, str]) -> None:
    with pytest.raises(InputError, match="wanted"):
        CliRunner().invoke(command, ["fleet", *options], catch_exceptions=False)
