"""Long runs and runs on a full disk: what counts as growth, and what is refused by a limit."""

from pathlib import Path
from typing import Any

import pytest

from safedpa.errors import SafedpaError
from safedpa_lab.experiments.operation import full_disk, silences, soak

HOUR = 3600.0


def samples(seconds: float = HOUR, **rates: float) -> list[dict[str, float]]:
    """Memory [MB] that jumps while caches fill, and then grows by ``rates`` an hour."""
    every = {"recorder": 0.0, "page": 0.0, "recording": 70.0, "dashboard file": 60.0, **rates}
    rows = [0.1 * k * seconds for k in range(11)]
    jump = 50.0
    return [
        {"seconds": at, **{name: jump * (at > 0.1 * seconds) + rate * at / HOUR for name, rate in every.items()}}
        for at in rows
    ]


def result(**rates: float) -> dict[str, Any]:
    run = {"services": [], "collisions": 0, "incidents": []}
    return {"robots": 3, "minutes": 60.0, "run": run, **soak.judged(samples(**rates), HOUR)}


def test_growth_is_that_after_the_tenth_minute_of_an_hour_also_of_a_shorter_run() -> None:
    long, short = (soak.judged(samples(seconds, recorder=12.0), seconds) for seconds in (HOUR, 360.0))
    assert long["growth_mb"]["recorder"] == pytest.approx(10.0)
    assert short["growth_mb"]["recorder"] == pytest.approx(10.0)
    assert (long["extrapolated"], short["extrapolated"]) == (False, True)
    assert "extrapolated to an hour" in soak.report({"robots": 1, "minutes": 6.0, **short})


@pytest.mark.parametrize(
    ("rates", "text"),
    [
        ({"recorder": 7.0}, "recorder grows by 5.8 MB"),
        ({"page": 1200.0}, "the page"),
        ({"dashboard file": 71.0}, "1.01"),
    ],
)
def test_each_limit_fails_the_soak(rates: dict[str, float], text: str) -> None:
    soak.verdict(result())
    with pytest.raises(SafedpaError, match=text):
        soak.verdict(result(**rates))


@pytest.mark.parametrize(
    "changes",
    [{"ended": False}, {"robot_starts": 2}, {"filled": True, "reported": False}, {"readable": False}],
)
def test_each_fault_of_a_run_on_a_full_disk_is_one_trouble(changes: dict[str, Any]) -> None:
    good = {"ended": True, "robot_starts": 1, "filled": True, "reported": True, "readable": True}
    good |= {"phase": "drive", "free_bytes": 40_000, "code": 1}
    full_disk.verdict({"runs": [good]})
    assert len(full_disk.trouble_of({**good, **changes})) == 1
    with pytest.raises(SafedpaError, match="drive, 40000 bytes"):
        full_disk.verdict({"runs": [{**good, **changes}]})


def test_the_samples_of_a_stopped_run_are_judged_without_the_line_that_was_cut(tmp_path: Path) -> None:
    (tmp_path / "samples").write_text('{"seconds": 1.0, "page": 2.0}\n{"seconds": 2.0, "page": 4.0}\n{"seconds": 3')
    found = soak.judged(soak.recorded(tmp_path / "samples"), 2.0)
    assert (found["samples"], found["page_mb"]) == (2, 4.0)


RIGHT = {"victim": "robot", "seconds": {"status": 1.2}, "lapsed": [], "replaced": None, "returned": 0.4}


@pytest.mark.parametrize(
    ("kind", "changes", "text"),
    [
        ("hang", {"seconds": {"status": 2.1}}, "robot: status after 2.1 s"),
        ("hang", {"seconds": {"status": None}}, "robot: status after never"),
        ("hang", {"lapsed": ["metrics"]}, "robot: metrics was right only for a time"),
        ("kill", {"replaced": 10.1}, "robot: replaced after 10.1 s"),
        ("kill", {"unreported": True}, "robot: status does not know that it was restarted"),
    ],
)
def test_each_wrong_place_fails_the_silences(kind: str, changes: dict[str, Any], text: str) -> None:
    result = {"kind": kind, "seconds": 8.0, "rows": [RIGHT, {**RIGHT, "returned": None}]}
    silences.verdict(result)
    assert silences.report(result).count("1.2 |") == 2
    with pytest.raises(SafedpaError, match=text):
        silences.verdict({**result, "rows": [{**RIGHT, **changes}]})
