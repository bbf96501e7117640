"""The worked example of docs/guides/column-maps.md does what the page says."""

import re
import runpy
from pathlib import Path

import numpy as np
import pytest

from safedpa.records import load_column_map, load_run
from safedpa.records.column_map.units import UNITS
from safedpa.robots.car.system import CAR_THROTTLE
from safedpa_services.command_line.group import safedpa

PAGE = (Path(__file__).parents[2] / "docs" / "guides" / "column-maps.md").read_text(encoding="utf-8")


def block(language: str) -> str:
    found = re.search(rf"```{language}\n(.*?)```", PAGE, re.DOTALL)
    assert found is not None
    return found.group(1)


@pytest.fixture
def drive(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The page's log, driven on for 20 s: a circle of changing radius, in the units of the page."""
    period, rows = 0.01, 2000
    t = period * np.arange(rows)
    speed = 1.0 + 0.2 * np.sin(0.7 * t)
    steer = 0.2 + 0.05 * np.sin(0.9 * t)
    yaw = np.pi / 2 + np.cumsum(speed * np.tan(steer) / 0.2) * period
    x = np.cumsum(speed * np.cos(yaw)) * period
    y = np.cumsum(speed * np.sin(yaw)) * period
    lines = block("csv").strip().splitlines()
    for k in range(rows):
        cells = (
            30 + 1000 * t[k],
            1200 + 1000 * (x[k] - x[0] + 0.06 * (np.cos(yaw[k]) - np.cos(yaw[0]))),
            -300 + 1000 * (y[k] - y[0] + 0.06 * (np.sin(yaw[k]) - np.sin(yaw[0]))),
            np.degrees((yaw[k] + np.pi) % (2 * np.pi) - np.pi),
            1500 - 1000 * steer[k],
            24 + 10 * np.sin(1.7 * t[k]),
            1,
        )
        lines.append(",".join(f"{float(cell):.9g}" for cell in cells))
    (tmp_path / "drive.csv").write_text("\n".join(lines) + "\n")
    (tmp_path / "drive_columns.toml").write_text(block("toml"))
    monkeypatch.chdir(tmp_path)
    np.savez(tmp_path / "truth.npz", t=t, speed=speed, steer=steer, yaw=yaw)
    return tmp_path


def test_the_map_gives_what_the_page_describes(drive: Path) -> None:
    run = load_run(drive / "drive.csv", CAR_THROTTLE, load_column_map(drive / "drive_columns.toml"))
    truth = np.load(drive / "truth.npz")
    assert run.period == pytest.approx(0.05, abs=1e-6)
    t, states, actions = list(run.parts())[-1]
    for index, name in ((2, "yaw"), (3, "speed")):
        wanted = np.interp(t - 0.03, truth["t"], truth[name])
        np.testing.assert_allclose(states[2:, index], wanted[2:], atol=5e-3)
    held = np.interp(t - 0.01, truth["t"], truth["steer"])  # the mean over the 0.05 s that follow
    np.testing.assert_allclose(actions[2:, 1], held[2:], atol=5e-3)
    assert np.hypot(*np.diff(states[:, :2], axis=0).T).max() < 0.07


def test_the_page_s_python_runs(drive: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (drive / "example.py").write_text(block("python"))
    runpy.run_path(str(drive / "example.py"))
    printed = capsys.readouterr().out
    assert "speed is the slope of the measured position over 0.1 s" in printed
    assert ", 4)" in printed


def test_the_page_s_command_runs(drive: Path, capsys: pytest.CaptureFixture[str]) -> None:
    program, *arguments = block("sh").split()
    assert program == "safedpa"
    assert safedpa.run([*arguments, "--out", str(drive)]) == 0, capsys.readouterr().err


def test_the_page_names_every_unit_and_every_finding() -> None:
    for unit in UNITS:
        assert re.search(rf"[` ]{re.escape(unit)}[` ]", PAGE), unit
    source = Path(__file__).parents[2] / "shared" / "safedpa" / "records"
    kinds = set()
    for path in source.rglob("*.py"):
        kinds |= set(re.findall(r'(?:finding|Finding)\(\s*"([a-z_]+)"', path.read_text(encoding="utf-8")))
    assert len(kinds) > 15
    for kind in kinds:
        assert f"`{kind}`" in PAGE, kind
