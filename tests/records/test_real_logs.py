"""The real logs of the RC car and of the pendulum, where they are present."""

import os
from pathlib import Path

import numpy as np
import pytest

from safedpa.records import Run, load_column_map, load_run
from safedpa.records.column_map.derive import slope
from safedpa.robots.car.system import CAR_THROTTLE
from safedpa.robots.pendulum.system import PENDULUM

DATA = Path(os.environ.get("SAFEDPA_DATA", Path(__file__).parents[3] / "shared" / "data"))
CAR_LOGS = sorted(DATA.glob("dart_rc_car/*/*.csv"))
PENDULUM_LOGS = sorted(DATA.glob("dfki_pendulum/**/data_measured.csv"))

pytestmark = pytest.mark.skipif(
    not (CAR_LOGS and PENDULUM_LOGS), reason=f"measured data is absent ({DATA}); set SAFEDPA_DATA to its folder"
)


def car(path: Path) -> Run:
    return load_run(path, CAR_THROTTLE, load_column_map("dart_car_columns"))


def pendulum(path: Path) -> Run:
    return load_run(path, PENDULUM, load_column_map("dfki_pendulum_columns"))


def test_there_are_four_drives_and_six_swings() -> None:
    assert len(CAR_LOGS) == 4
    assert len(PENDULUM_LOGS) == 6


@pytest.mark.parametrize("path", CAR_LOGS, ids=lambda path: path.stem[-8:])
def test_a_drive_is_one_stretch_at_20_hz(path: Path) -> None:
    run = car(path)
    assert [finding.kind for finding in run.findings] == ["held", "derived_state"]
    assert "10 rows (0.1 s)" in run.findings[0].message
    assert len(run.stretches) == 1
    assert run.period == pytest.approx(0.05, abs=1e-4)
    assert 67.0 < run.duration < 105.0


@pytest.mark.parametrize("path", CAR_LOGS, ids=lambda path: path.stem[-8:])
def test_the_car_turns_the_way_it_steers_and_moves_the_way_it_looks(path: Path) -> None:
    run = car(path)
    _, _, yaw, speed = run.states.T
    turning = slope(run.t, yaw, 0.2)
    slow = np.isfinite(turning) & (speed > 0.3) & (speed < 1.5)
    wanted = (speed * np.tan(run.actions[:, 1]) / 0.1735)[slow]
    if np.ptp(wanted) > 0.5:
        gain = float(wanted @ turning[slow] / (wanted @ wanted))
        assert 0.7 < gain < 1.3
    sideways = slope(run.t, run.states[:, 1], 0.1) * np.cos(yaw) - slope(run.t, run.states[:, 0], 0.1) * np.sin(yaw)
    assert float(np.median(np.abs(sideways[slow] / speed[slow]))) < 0.05


@pytest.mark.parametrize("path", CAR_LOGS, ids=lambda path: path.stem[-8:])
def test_the_derived_speed_is_that_of_the_wheels_once_these_have_reported(path: Path) -> None:
    run = car(path)
    table = np.genfromtxt(path, delimiter=",", names=True)
    encoder = np.interp(run.t + 0.13, table["vicon_time"], table["vel_encoder"])
    assert float(np.corrcoef(encoder, run.states[:, 3])[0, 1]) > 0.95
    assert 0.9 < float(encoder @ run.states[:, 3] / (encoder @ encoder)) < 1.02


@pytest.mark.parametrize("path", PENDULUM_LOGS, ids=lambda path: path.parent.name[-20:])
def test_a_swing_starts_hanging_and_gravity_pulls_from_upright(path: Path) -> None:
    run = pendulum(path)
    kinds = {finding.kind for finding in run.findings}
    assert kinds <= {"derived_state", "gap", "cut"}
    assert ("gap" in kinds) == ("sac" in str(path))
    assert abs(abs(run.states[0, 0]) - np.pi) < 0.2
    raw = np.genfromtxt(path, delimiter=",", names=True)
    assert run.duration > 0.98 * (raw["time"][-1] - raw["time"][0])
    near_bottom = np.cos(run.states[:, 0]) < -0.9
    acceleration = slope(run.t, run.states[:, 1], 0.06)
    good = near_bottom & np.isfinite(acceleration)
    assert float(np.corrcoef(np.sin(run.states[good, 0]), acceleration[good])[0, 1]) > 0.3


@pytest.mark.parametrize("path", PENDULUM_LOGS, ids=lambda path: path.parent.name[-20:])
def test_torque_drives_in_the_direction_of_the_angle(path: Path) -> None:
    run = pendulum(path)
    t, (angle, rate), torque = run.t, run.states.T, run.actions[:, 0]
    rows = max(1, round(0.06 / run.period))
    smooth = np.convolve(torque, np.ones(rows) / rows, "same")
    acceleration = slope(t, rate, 0.06)
    good = np.isfinite(acceleration) & (np.abs(rate) > 0.3)
    columns = np.column_stack([smooth, np.sin(angle), rate, np.sign(rate)])[good]
    solution = np.linalg.lstsq(columns, acceleration[good], rcond=None)[0]
    assert solution[0] > 1.0
    assert 15.0 < solution[1] < 25.0
