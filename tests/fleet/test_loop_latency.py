"""The loop in containers has its own time from sense to act, compared with a bare chain of containers."""

import json
import sys

import pytest
from fleet_containers import ROOT, Fleet, run

pytestmark = pytest.mark.fleet


def test_loop_and_chain_are_measured_and_taken_away(fleet: Fleet, rows: list[tuple[str, ...]]) -> None:
    """Runs alongside the fleet of the other tests, so the durations are not asserted."""
    assert fleet.robots
    script = str(ROOT / "deploy" / "container_latency.py")
    found = json.loads(run(sys.executable, script, "--seconds", "5", "--rate", "20", timeout=120.0).stdout)
    assert found["ticks"] > 50
    assert found["watchdog_ticks"] < found["ticks"]
    assert found["collisions"] == 0
    for reported in (found["loop_us"], *found["bare_chain_us"]):
        assert 0.0 < reported["p50"] <= reported["p99"] <= reported["p999"]
    assert run("docker", "ps", "-aq", "--filter", "name=safedpa-latency").stdout == ""
    text = f"sense to act p99 {found['loop_us']['p99'] / 1000.0:.1f} ms, {found['watchdog_ticks']} late"
    rows.append(("one more robot, 5 s, next to the fleet", text))
