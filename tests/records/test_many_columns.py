"""A table with thousands of columns: what is wrong with it is still one sentence."""

from pathlib import Path

import pytest

from safedpa.errors import did_you_mean
from safedpa_services.command_line.group import safedpa


def test_few_names_are_listed_whole() -> None:
    assert did_you_mean("sped", ["yaw", "speed"]) == "did you mean 'speed'? known: speed, yaw"


def test_of_many_names_those_that_are_like_it() -> None:
    notice = did_you_mean("sped", [*(f"c{index}" for index in range(2000)), "speed", "spend"])
    assert "speed" in notice
    assert "spend" in notice
    assert notice.endswith("and 1990 more")
    assert len(notice) < 300


def test_a_broad_table_is_refused_in_one_short_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    table = tmp_path / "broad.csv"
    head = ["t", *(f"c{index}" for index in range(2000))]
    table.write_text("\n".join([",".join(head), *(",".join(["1.0"] * len(head)) for _ in range(3))]))
    assert safedpa.run(["compare", "car", str(table), "--out", str(tmp_path / "page")]) == 2
    notice = capsys.readouterr().err
    assert "column 'x' is missing" in notice
    assert len(notice) < 500
