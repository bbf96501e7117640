"""Column maps: every key does what it says, every mistake is named."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from safedpa.errors import ColumnMapError
from safedpa.records import load_column_map, load_run
from safedpa.records.apply_map import Rows, keep_rows
from safedpa.records.column_map_file import parse_column_map, shipped_column_maps
from safedpa.records.derive import slope
from safedpa.records.run import Stretch
from safedpa.records.units import UNITS, factor_to_si
from safedpa.robots.car.system import CAR, CAR_THROTTLE
from safedpa.robots.pendulum.system import PENDULUM

GOOD = """
format = 1
robot = "car"
[columns]
t = { from = "stamp", unit = "ms" }
x = { from = "px", unit = "cm" }
y = { from = "py", flip = true, offset = 1.5 }
yaw = { from = "heading", unit = "deg" }
speed = { from = "v", unit = "km/h" }
target_speed = { from = "cmd", scale = 2.0 }
steer = { from = "servo", scale = -0.3, offset = 0.01 }
"""


def write_log(path: Path, rows: int = 50) -> dict[str, np.ndarray]:
    k = np.arange(rows)
    columns = {
        "stamp": 50.0 * k,
        "px": 100.0 * np.sin(0.05 * k),
        "py": np.cos(0.05 * k),
        "heading": np.mod(-2.0 * k + 180.0, 360.0) - 180.0,
        "v": np.full(rows, 3.6),
        "cmd": 0.5 + 0.1 * np.sin(k),
        "servo": 0.2 * np.cos(k),
        "mode": (k < 5) * 1.0,
    }
    text = "\n".join(",".join(repr(float(column[row])) for column in columns.values()) for row in range(rows))
    path.write_text(",".join(columns) + "\n" + text + "\n")
    return columns


def test_units_scales_offsets_flips_and_wrapped_angles(tmp_path: Path) -> None:
    raw = write_log(tmp_path / "log.csv")
    run = load_run(tmp_path / "log.csv", CAR, parse_column_map(GOOD))
    np.testing.assert_allclose(run.t, raw["stamp"] / 1000)
    np.testing.assert_allclose(run.states[:, 0], raw["px"] / 100)
    np.testing.assert_allclose(run.states[:, 1], 1.5 - raw["py"])
    np.testing.assert_allclose(np.diff(run.states[:, 2]), np.radians(-2.0))
    np.testing.assert_allclose(run.states[:, 3], 1.0)
    np.testing.assert_allclose(run.actions[:, 0], 2.0 * raw["cmd"])
    np.testing.assert_allclose(run.actions[:, 1], 0.01 - 0.3 * raw["servo"])


def test_rows_are_skipped_by_number_and_by_value(tmp_path: Path) -> None:
    write_log(tmp_path / "log.csv")
    by_value = GOOD.replace("[columns]", 'skip_where = { column = "mode", equals = 1.0 }\n[columns]')
    by_number = GOOD.replace("[columns]", "skip_first_rows = 5\n[columns]")
    for text in (by_value, by_number):
        run = load_run(tmp_path / "log.csv", CAR, parse_column_map(text))
        assert len(run.t) == 45
        assert run.t[0] == pytest.approx(0.25)


def test_an_angle_that_is_not_named_is_not_unwrapped(tmp_path: Path) -> None:
    write_log(tmp_path / "log.csv", 150)
    run = load_run(tmp_path / "log.csv", CAR, parse_column_map(GOOD.replace("[columns]", "unwrap = []\n[columns]")))
    assert np.abs(run.states[:, 2]).max() <= np.pi
    assert "jump" in [finding.kind for finding in run.findings]


def test_the_tracked_point_is_moved_to_the_rear_axle(tmp_path: Path) -> None:
    t = 0.02 * np.arange(200)
    yaw = 0.8 * t
    rear = np.stack([np.sin(yaw) / 0.8, (1 - np.cos(yaw)) / 0.8])
    ahead, left = np.array([np.cos(yaw), np.sin(yaw)]), np.array([-np.sin(yaw), np.cos(yaw)])
    tracked = rear + 0.2 * ahead + 0.05 * left
    table = np.column_stack([t, *tracked, yaw - 0.01, 0.5 + 0.1 * np.sin(3 * t), 0.1 * np.cos(t)])
    np.savetxt(tmp_path / "log.csv", table, delimiter=",", header="t,x,y,yaw,throttle,steer", comments="", fmt="%.17g")
    text = """
format = 1
robot = "car"
[columns]
t = "t"
x = "x"
y = "y"
yaw = "yaw"
speed = { derive = "speed_from_position", window = 0.1 }
throttle = "throttle"
steer = "steer"
[tracked_point]
ahead = 0.2
left = 0.05
yaw_offset = 0.01
"""
    run = load_run(tmp_path / "log.csv", CAR_THROTTLE, parse_column_map(text))
    assert [finding.kind for finding in run.findings] == ["derived_state"]
    [(times, states, _)] = run.parts()
    assert times[0] == pytest.approx(t[2])
    assert times[-1] == pytest.approx(t[-3])
    inner = slice(2, -2)
    np.testing.assert_allclose(states[:, :2], rear.T[inner], atol=1e-12)
    np.testing.assert_allclose(states[:, 2], yaw[inner], atol=1e-12)
    np.testing.assert_allclose(states[:, 3], 1.0, atol=1e-3)


@settings(max_examples=50, deadline=None)
@given(
    seed=st.integers(0, 1000),
    start=st.sampled_from([0.0, 1.7e9]),
    rate=st.floats(-5, 5),
    acceleration=st.floats(-5, 5),
    window=st.sampled_from([0.02, 0.06, 0.1]),
)
def test_a_slope_is_exact_for_parabolas_and_for_lines_under_jitter(
    seed: int, start: float, rate: float, acceleration: float, window: float
) -> None:
    t = start + 0.01 * np.arange(80)
    wanted = rate + acceleration * (t - t[0])
    found = slope(t, 3.0 + rate * (t - t[0]) + 0.5 * acceleration * (t - t[0]) ** 2, window)
    inner = np.isfinite(found)
    assert int((~inner).sum()) == 2 * max(1, round(window / 2 / 0.01))
    digits = 1e-9 if start == 0.0 else 1e-3  # what unix times cost
    np.testing.assert_allclose(found[inner], wanted[inner], atol=digits)
    jitter = t + np.random.default_rng(seed).uniform(-0.003, 0.003, 80)
    line = slope(jitter, 3.0 + rate * (jitter - jitter[0]), window)
    np.testing.assert_allclose(line[np.isfinite(line)], rate, atol=digits)


def test_a_slope_has_no_phase_shift_and_the_stated_loss() -> None:
    t = 0.001 * np.arange(4000)
    for frequency, window in ((2.0, 0.1), (5.0, 0.04), (1.0, 0.2)):
        found = slope(t, np.sin(2 * np.pi * frequency * t) / (2 * np.pi * frequency), window)
        inner = np.isfinite(found)
        wanted = np.cos(2 * np.pi * frequency * t)[inner]
        gain = float(found[inner] @ wanted / (wanted @ wanted))
        assert gain == pytest.approx(1 - (np.pi * frequency * window) ** 2 / 10, abs=0.01)
        np.testing.assert_allclose(found[inner], gain * wanted, atol=5e-3)


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 1000), period=st.sampled_from([0.03, 0.05, 0.1]))
def test_kept_rows_are_picked_and_their_actions_keep_the_impulse(seed: int, period: float) -> None:
    random = np.random.default_rng(seed)
    t = np.cumsum(random.uniform(0.009, 0.011, 400))
    rows = Rows(t, random.standard_normal((400, 2)), random.standard_normal((400, 1)))
    kept, stretches = keep_rows(rows, [Stretch(0, 150), Stretch(160, 400)], period)
    assert set(kept.t) <= set(t)
    assert len(stretches) == 2
    for stretch, whole in zip(stretches, (slice(0, 150), slice(160, 400)), strict=True):
        times = kept.t[stretch.start : stretch.stop]
        assert np.diff(times) == pytest.approx(period, abs=0.012)
        inside = (t[whole] >= times[0]) & (t[whole] < times[-1])
        held = np.diff(t[whole], append=np.nan)[inside]
        impulse = float(rows.actions[whole][inside][:, 0] @ held)
        thinned = float(kept.actions[stretch.start : stretch.stop - 1, 0] @ np.diff(times))
        assert thinned == pytest.approx(impulse, abs=1e-9)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (("format = 1", "format = 2"), "format: got 2, wanted 1"),
        (("format = 1", "format = "), "not TOML"),
        (('robot = "car"', "robot = 3"), "robot: got 3"),
        (("[columns]", "skip_rows = 3\n[columns]"), "skip_rows: unknown key; did you mean 'skip_first_rows'?"),
        (("[columns]", "skip_first_rows = -1\n[columns]"), "skip_first_rows: got -1"),
        (("[columns]", "skip_first_rows = 1.5\n[columns]"), "skip_first_rows: got 1.5"),
        (("[columns]", "keep_period = 0\n[columns]"), "keep_period: got 0, wanted seconds above 0"),
        (("[columns]", 'keep_period = "fast"\n[columns]'), "keep_period: got 'fast'"),
        (("[columns]", 'skip_where = { column = "a" }\n[columns]'), "skip_where.equals: got None"),
        (("[columns]", 'skip_where = { colum = "a", equals = 1 }\n[columns]'), "skip_where.colum: unknown key"),
        (("[columns]", "skip_where = 3\n[columns]"), "skip_where: got 3"),
        (("[columns]", 'unwrap = ["yew"]\n[columns]'), "unwrap: got 'yew'; did you mean 'yaw'?"),
        (("[columns]", "tracked_point = 1\n[columns]"), "tracked_point: got 1"),
        (("[columns]", "tracked_point = { forward = 1 }\n[columns]"), "tracked_point.forward: unknown key"),
        (('unit = "cm"', 'unit = "cmm"'), "columns.x.unit: unknown unit 'cmm'; did you mean '"),
        (('unit = "cm"', "unit = 5"), "columns.x.unit: got 5"),
        (("flip = true", "flip = 1"), "columns.y.flip: got 1, wanted true or false"),
        (("offset = 1.5", 'offset = "1.5"'), "columns.y.offset: got '1.5', wanted a finite number"),
        (("offset = 1.5", "offset = nan"), "columns.y.offset: got nan"),
        (("scale = 2.0", "scale = 0"), "columns.target_speed.scale: got 0"),
        (("scale = 2.0", "gain = 2"), "columns.target_speed.gain: unknown key"),
        (('from = "px", ', ""), "columns.x.from: got None"),
        (('"px"', '"py"'), "columns.y: column 'py' is already the source of 'x'"),
        (('speed = { from = "v", unit = "km/h" }', "speed = 3"), "columns.speed: got 3"),
        (
            ('{ from = "v", unit = "km/h" }', '{ derive = "speed" }'),
            "got 'speed'; did you mean 'slope'? known: rate_from_angle",
        ),
        (('{ from = "v", unit = "km/h" }', '{ derive = "speed_from_position" }'), "columns.speed.window: missing"),
        (
            ('{ from = "v", unit = "km/h" }', '{ derive = "rate_from_angle", window = 0.1 }'),
            "gives 'rate', not 'speed'",
        ),
        (('{ from = "px", unit = "cm" }', '{ derive = "speed_from_position", window = 1 }'), "gives 'speed', not 'x'"),
    ],
)
def test_every_mistake_names_its_key(change: tuple[str, str], words: str) -> None:
    assert change[0] in GOOD
    with pytest.raises(ColumnMapError) as caught:
        parse_column_map(GOOD.replace(*change))
    assert words in str(caught.value)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (('unit = "cm"', 'unit = "deg"'), "columns.x.unit: got unit 'deg', wanted one for m: m, mm, cm"),
        (("steer =", "steering ="), "columns.steering: the model has no 'steering'; did you mean 'steer'?"),
        (("steer = {", "#"), "columns.steer: missing; the car needs t, x, y, yaw, speed, target_speed, steer"),
    ],
)
def test_a_map_that_does_not_fit_the_system_is_refused(tmp_path: Path, change: tuple[str, str], words: str) -> None:
    write_log(tmp_path / "log.csv")
    with pytest.raises(ColumnMapError) as caught:
        load_run(tmp_path / "log.csv", CAR, parse_column_map(GOOD.replace(*change)))
    assert words in str(caught.value)


def test_a_tracked_point_is_refused_for_a_pendulum(tmp_path: Path) -> None:
    write_log(tmp_path / "log.csv")
    text = (
        'format=1\nrobot="pendulum"\n[columns]\nt="stamp"\nangle="px"\nrate="py"\ntorque="v"\n[tracked_point]\nahead=1'
    )
    with pytest.raises(ColumnMapError, match="a pendulum has no x, y and yaw"):
        load_run(tmp_path / "log.csv", PENDULUM, parse_column_map(text))


def test_shipped_maps_are_found_by_name_and_a_missing_file_lists_them(tmp_path: Path) -> None:
    assert set(shipped_column_maps()) >= {"dart_car_columns", "dfki_pendulum_columns"}
    for name in shipped_column_maps():
        assert load_column_map(name) == load_column_map(f"{name}.toml")
    with pytest.raises(
        ColumnMapError, match=r"nothing: cannot be read .*one of dart_car_bag, dart_car_columns, dfki_pendulum_columns"
    ):
        load_column_map("nothing")
    (tmp_path / "mine.toml").write_text("format = 3")
    with pytest.raises(ColumnMapError, match=r"mine.toml: format: got 3"):
        load_column_map(tmp_path / "mine.toml")


@given(unit=st.sampled_from(sorted(UNITS)), wanted=st.sampled_from(sorted({unit.si for unit in UNITS.values()})))
def test_units_convert_to_their_own_kind_alone(unit: str, wanted: str) -> None:
    if UNITS[unit].si == wanted:
        assert factor_to_si(unit, wanted, "key") > 0.0
    else:
        with pytest.raises(ColumnMapError, match="key: got unit"):
            factor_to_si(unit, wanted, "key")
