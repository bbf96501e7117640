"""Column maps: every key does what it says, every mistake is named."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from safedpa.errors import ColumnMapError
from safedpa.records import load_column_map, load_run
from safedpa.records.column_map.apply import check_map, resample_rows
from safedpa.records.column_map.column_map import ColumnMap, DerivedColumn, SourceColumn, TrackedPoint, native_map
from safedpa.records.column_map.derive import slope
from safedpa.records.column_map.file import parse_column_map, shipped_column_maps
from safedpa.records.column_map.units import UNITS, factor_to_si
from safedpa.records.run import RawRows, Stretch
from safedpa.robots.car.system import CAR, CAR_THROTTLE
from safedpa.robots.pendulum.system import PENDULUM
from safedpa.systems import System

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
def test_a_slope_is_exact_for_parabolas_and_for_lines_under_jitter(seed, start, rate, acceleration, window):
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
    rows = RawRows(t, random.standard_normal((400, 2)), random.standard_normal((400, 1)))
    retained, stretches = resample_rows(rows, [Stretch(0, 150), Stretch(160, 400)], period)
    assert set(retained.t) <= set(t)
    assert len(stretches) == 2
    for stretch, whole in zip(stretches, (slice(0, 150), slice(160, 400)), strict=True):
        times = retained.t[stretch.start : stretch.stop]
        assert np.diff(times) == pytest.approx(period, abs=0.012)
        inside = (t[whole] >= times[0]) & (t[whole] < times[-1])
        held = np.diff(t[whole], append=np.nan)[inside]
        impulse = float(rows.actions[whole][inside][:, 0] @ held)
        thinned = float(retained.actions[stretch.start : stretch.stop - 1, 0] @ np.diff(times))
        assert thinned == pytest.approx(impulse, abs=1e-9)


HEAD = 'format = 1\nrobot = "pendulum"\n'
COLUMNS = '[columns]\nt = "time"\nangle = "a"\n'


def column(entry: str, name: str = "rate") -> str:
    """A map with one more column."""
    return f"{HEAD}{COLUMNS}{name} = {entry}\n"


def top(line: str) -> str:
    """A map with one more key at the top."""
    return f"{HEAD}{line}\n{COLUMNS}"


BAD_ENTRIES = """
1 >> : got 1, wanted a column's name or a table like
"a" >> : column 'a' is already the source of 'angle'; one column can be one target only
"" >> .from: got '', wanted a column's name in quotes
{ unit = "rad/s" } >> .from: got None, wanted a column's name in quotes
{ from = "b", factor = 2 } >> .factor: unknown key
{ from = "b", unit = "furlong" } >> .unit: unknown unit 'furlong'
{ from = "b", unit = "degs" } >> .unit: unknown unit 'degs'; did you mean 'deg
{ from = "b", unit = 1 } >> .unit: got 1, wanted a unit's name
{ from = "b", unit = "" } >> .unit: got '', wanted a unit's name
{ from = "b", scale = 0 } >> .scale: got 0, wanted another number; 0 would erase
{ from = "b", scale = true } >> .scale: got True, wanted a finite number
{ from = "b", scale = inf } >> .scale: got inf, wanted a finite number
{ from = "b", offset = nan } >> .offset: got nan, wanted a finite number
{ from = "b", offset = "1" } >> .offset: got '1', wanted a finite number
{ from = "b", shift = -inf } >> .shift: got -inf, wanted a finite number
{ from = "b", flip = 1 } >> .flip: got 1, wanted true or false
{ from = "b", flip = "true" } >> .flip: got 'true', wanted true or false
{ from = "b", hold = 0 } >> .hold: got 0, wanted seconds above 0
{ from = "b", hold = -0.1 } >> .hold: got -0.1, wanted seconds above 0
{ from = "b", hold = nan } >> .hold: got nan, wanted a finite number
{ from = "b", join = "mean" } >> .join: got 'mean' for one column; name several
{ from = ["b"], join = "sum" } >> .from: got ['b'], wanted two different
{ from = [], join = "sum" } >> .from: got [], wanted two different columns or more
{ from = ["b", "b"], join = "sum" } >> .from: got ['b', 'b'], wanted two different
{ from = ["b", "c", "b"], join = "sum" } >> .from: got ['b', 'c', 'b'], wanted two different columns or more
{ from = ["b", "c"] } >> .join: got None, wanted a way to join them
{ from = ["b", "c"], join = "median" } >> .join: got 'median', wanted a way to join them: mean, sum, difference, norm
{ from = ["b", 2], join = "sum" } >> .from: got 2, wanted a column's
{ topic = "/o", field = "z", from = "b" } >> .from: got it next to a topic
{ topic = "/o", field = "z", join = "sum" } >> .join: got it next to a topic
{ topic = "/o" } >> : wanted a field of the topic, or for t clock
{ topic = "", field = "z" } >> .topic: got '', wanted a topic's name
{ topic = "/o", field = "" } >> .field: got '', wanted a field of the topic
{ topic = "/o", clock = "header" } >> .clock: got 'header', wanted header or receipt, and for t alone
{ derive = "rate_from_angle", window = 0.1, from = "b" } >> .from: unknown
{ derive = 1, window = 0.1 } >> .derive: got 1, wanted what to
{ derive = "slop", window = 0.1 } >> .derive: got 'slop'; did you mean 'slope'? known: rate_from_angle
{ derive = "slope", window = 0.1 } >> .of: missing; wanted the state whose
{ derive = "slope", window = 0.1, of = 1 } >> .of: got 1, wanted a state's name
{ derive = "rate_from_angle", window = 0.1, of = "angle" } >> .of: unknown with 'rate_from_angle'
{ derive = "rate_from_angle" } >> .window: missing; wanted the seconds over which
{ derive = "rate_from_angle", window = 0 } >> .window: got 0, wanted seconds above
{ derive = "rate_from_angle", window = inf } >> .window: got inf, wanted a finite number
{ derive = "speed_from_position", window = 0.1 } >> .derive: 'speed_from_position' gives 'speed', not 'rate'
"""

BAD_KEYS = """
period = 1 >> period: unknown key
skip_rows = 1 >> skip_rows: unknown key; did you mean 'skip_first_rows'?
frames = 1 >> frames: got 1, wanted tables like
frames = { "/o" = "map" } >> frames./o: got 'map', wanted a table with frame_id and
frames = { "/o" = { frame = "map" } } >> frames./o.frame: unknown key
frames = { "/o" = { frame_id = "" } } >> frames./o.frame_id: got '', wanted a frame's name
unwrap = "angle" >> unwrap: got 'angle', wanted a list of names
unwrap = ["angel"] >> unwrap: got 'angel'; did you mean 'angle'?
unwrap = ["angle", "x"] >> unwrap: got 'x';
skip_where = 1 >> skip_where: got 1, wanted
skip_where = [1] >> skip_where: got [1], wanted
skip_where = [{ column = "a", equals = 0.0 }, "b"] >> skip_where: got [{
skip_where = { column = "a", above = 0.0 } >> skip_where.above: unknown key
skip_where = { equals = 0.0 } >> skip_where.column: got None, wanted a column's name
skip_where = { column = "a" } >> skip_where.equals: got None, wanted a finite number
skip_where = { column = "a", equals = nan } >> skip_where.equals: got nan, wanted a finite
keep = "frozen" >> keep: got 'frozen', wanted a list of findings whose rows are kept
keep = ["frozen", "frosen"] >> keep: got 'frosen'; did you mean 'frozen'?
keep = [1] >> keep: got 1;
keep_period = 0 >> keep_period: got 0, wanted seconds above 0
keep_period = -1.5 >> keep_period: got -1.5, wanted seconds above 0
keep_period = true >> keep_period: got True, wanted a finite number
skip_first_rows = -1 >> skip_first_rows: got -1, wanted a whole number, 0 or more
skip_first_rows = 1.5 >> skip_first_rows: got 1.5, wanted a whole number, 0 or
skip_first_rows = true >> skip_first_rows: got True, wanted a whole number, 0 or
tracked_point = 1 >> tracked_point: got 1, wanted a table with ahead, left
tracked_point = { up = 1 } >> tracked_point.up: unknown key
tracked_point = { left = inf } >> tracked_point.left: got inf, wanted a finite
"""

RATE = 'rate = { derive = "rate_from_angle", window = 0.1 }\n'
BAD_MAPS = {
    f'format = 2\nrobot = "a"\n{COLUMNS}': "format: got 2, wanted 1; this program reads no other",
    f'robot = "a"\n{COLUMNS}': "format: got None, wanted 1",
    "format = ": "not TOML",
    f"format = 1\n{COLUMNS}": "robot: got None, wanted the name of the robot, such as 'car' in quotes",
    f'format = 1\nrobot = ""\n{COLUMNS}': "robot: got '', wanted the name of the robot",
    f"format = 1\nrobot = 3\n{COLUMNS}": "robot: got 3, wanted the name of the robot",
    HEAD: "columns: missing; wanted a table [columns]",
    f"{HEAD}[columns]\n": "columns: missing; wanted a table [columns]",
    f"{HEAD}columns = 1\n": "columns: missing; wanted a table [columns]",
    f'{HEAD}[columns]\nangle = "a"\nt = {{ topic = "/o", field = "z", clock = "header" }}\n': "columns.t: wanted",
    f'{HEAD}[columns]\nangle = "a"\nt = {{ topic = "/o", clock = "wall" }}\n': "columns.t.clock: got 'wall', wanted",
    f'{HEAD}[columns]\nt = "time"\n{RATE}': "columns.rate.derive: 'rate_from_angle' needs the column 'angle' of",
    f'{HEAD}[columns]\nt = "time"\nangle = {{ derive = "slope", of = "rate", window = 0.1 }}\n{RATE}': (
        "columns.angle.derive: 'slope' needs the column 'rate' of the log"
    ),
}


def cases(table: str) -> list[tuple[str, str]]:
    """Pairs of what is written and how the refusal begins."""
    pairs = (line.split(" >> ") for line in table.strip().splitlines())
    return [(written, begin) for written, begin in pairs]


@pytest.mark.parametrize(
    ("text", "begin"),
    [
        *((column(entry), f"columns.rate{begin}") for entry, begin in cases(BAD_ENTRIES)),
        *((top(line), begin) for line, begin in cases(BAD_KEYS)),
        *BAD_MAPS.items(),
    ],
)
def test_every_mistake_is_refused_with_its_key(text: str, begin: str) -> None:
    with pytest.raises(ColumnMapError) as caught:
        parse_column_map(text)
    assert str(caught.value).startswith(begin)


@pytest.mark.parametrize(
    ("entry", "wanted"),
    [
        ('{ from = ["a", "b"], join = "difference" }', SourceColumn("a", others=("b",), join="difference")),
        ('{ from = ["b", "c", "d"], join = "first" }', SourceColumn("b", others=("c", "d"), join="first")),
        ('{ from = "b", unit = "deg/s" }', SourceColumn("b", unit="deg/s")),
        ('{ from = "b", scale = -2 }', SourceColumn("b", scale=-2.0)),
        ('{ from = "b", scale = 1e-300 }', SourceColumn("b", scale=1e-300)),
        ('{ from = "b", offset = 0, shift = 0.0, flip = false }', SourceColumn("b")),
        (
            '{ from = "b", shift = -1, offset = 3, flip = true }',
            SourceColumn("b", shift=-1.0, offset=3.0, flip=True),
        ),
        ('{ from = "b", hold = 0.001 }', SourceColumn("b", hold=0.001)),
        ('{ topic = "/o", field = "z", hold = 2 }', SourceColumn("/o:z", hold=2.0)),
        ('{ derive = "rate_from_angle", window = 0.1 }', DerivedColumn("rate_from_angle", 0.1)),
        ('{ derive = "slope", of = "angle", window = 1 }', DerivedColumn("slope", 1.0, "angle")),
    ],
)
def test_a_column_is_taken_as_it_is_written(entry: str, wanted: object) -> None:
    assert parse_column_map(column(entry)).columns["rate"] == wanted


def test_time_may_be_a_clock_of_a_topic_and_defaults_to_the_stamps_of_the_first_one() -> None:
    def time_of(text: str) -> object:
        return parse_column_map(f"{HEAD}[columns]\n{text}").columns.get("t")

    for clock in ("header", "receipt"):
        assert time_of(f't = {{ topic = "/o", clock = "{clock}" }}\nangle = "a"\n') == SourceColumn(f"/o:@{clock}")
    assert time_of('angle = "/joint:position"\nrate = "/imu:z"\n') == SourceColumn("/joint:@stamp")
    assert time_of('angle = "a"\n') is None


def test_every_key_is_optional_and_is_taken_as_it_is_written() -> None:
    found = parse_column_map(f"{HEAD}{COLUMNS}")
    assert (found.unwrap, found.skip_first_rows, found.skip_where, found.tracked_point) == (None, 0, (), None)
    assert (found.keep_period, found.keep, found.frames) == (None, (), {})
    assert parse_column_map(top("unwrap = []")).unwrap == ()
    one = parse_column_map(top('skip_where = { column = "mode", equals = 0 }')).skip_where
    assert [(rule.column, rule.equals) for rule in one] == [("mode", 0.0)]
    found = parse_column_map(
        f'{HEAD}unwrap = ["angle"]\nskip_first_rows = 3\nkeep_period = 1e-9\nkeep = ["frozen", "dead_command"]\n'
        'skip_where = [{ column = "mode", equals = 0 }, { column = "armed", equals = 1.5 }]\n'
        'tracked_point = { ahead = 0.1, left = -0.2 }\nframes = { "/o" = { frame_id = "map" } }\n'
        f"{COLUMNS}",
        "log",
    )
    assert (found.name, found.robot, found.unwrap, found.skip_first_rows) == ("log", "pendulum", ("angle",), 3)
    assert (found.keep_period, found.keep) == (1e-9, ("frozen", "dead_command"))
    assert [(rule.column, rule.equals) for rule in found.skip_where] == [("mode", 0.0), ("armed", 1.5)]
    assert found.tracked_point == TrackedPoint(ahead=0.1, left=-0.2, yaw_offset=0.0)
    assert found.frames == {"/o": {"frame_id": "map"}}


PENDULUM_MAP, CAR_MAP = native_map(PENDULUM), native_map(CAR)


def with_columns(found: ColumnMap, **columns: SourceColumn | DerivedColumn | None) -> ColumnMap:
    retained = {name: item for name, item in found.columns.items() if name not in columns}
    return replace(found, columns={**retained, **{name: item for name, item in columns.items() if item is not None}})


@pytest.mark.parametrize(
    ("columns", "problem"),
    [
        (CAR_MAP, "robot: the map is for a car, the model for a pendulum"),
        (
            with_columns(PENDULUM_MAP, rat=SourceColumn("x")),
            "columns.rat: the model has no 'rat'; did you mean 'rate'?",
        ),
        (with_columns(PENDULUM_MAP, t=None), "columns.t: missing; the pendulum needs t, angle, rate, torque"),
        (with_columns(PENDULUM_MAP, rate=None), "columns.rate: missing; the pendulum needs t, angle, rate, torque"),
        (replace(PENDULUM_MAP, tracked_point=TrackedPoint(ahead=0.1)), "tracked_point: a pendulum has no x, y and yaw"),
        (
            with_columns(PENDULUM_MAP, rate=DerivedColumn("slope", 0.1, "rate")),
            "columns.rate.derive: wanted for a state, of another state",
        ),
        (
            with_columns(PENDULUM_MAP, torque=DerivedColumn("slope", 0.1, "angle")),
            "columns.torque.derive: wanted for a state, of another state",
        ),
        (
            with_columns(PENDULUM_MAP, rate=DerivedColumn("slope", 0.1, "torque")),
            "columns.rate.of: got 'torque'; ",
        ),
        (
            with_columns(PENDULUM_MAP, rate=SourceColumn("rate", unit="deg")),
            "columns.rate.unit: got unit 'deg', wanted one for rad/s: rad/s, deg/s",
        ),
        (
            with_columns(PENDULUM_MAP, t=SourceColumn("t", unit="deg")),
            "columns.t.unit: got unit 'deg', wanted one for s: s, ms",
        ),
    ],
)
def test_a_map_that_does_not_fit_the_robot_is_refused(columns: ColumnMap, problem: str) -> None:
    with pytest.raises(ColumnMapError) as caught:
        check_map(columns, PENDULUM)
    assert str(caught.value).startswith(f"{columns.name}: {problem}")


@pytest.mark.parametrize(
    ("columns", "system"),
    [
        (PENDULUM_MAP, PENDULUM),
        (CAR_MAP, CAR),
        (replace(CAR_MAP, tracked_point=TrackedPoint(ahead=0.1)), CAR),
        (with_columns(PENDULUM_MAP, rate=DerivedColumn("slope", 0.1, "angle")), PENDULUM),
        (with_columns(PENDULUM_MAP, rate=DerivedColumn("rate_from_angle", 0.1)), PENDULUM),
        (with_columns(PENDULUM_MAP, rate=SourceColumn("rate", unit="deg/s")), PENDULUM),
        (with_columns(PENDULUM_MAP, t=SourceColumn("t", unit="ms")), PENDULUM),
    ],
)
def test_a_map_that_fits_the_robot_is_accepted(columns: ColumnMap, system: System) -> None:
    check_map(columns, system)


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
