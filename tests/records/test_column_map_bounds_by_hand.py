"""Column maps just within and just beyond what they may say: each refusal names the key, and alone decides."""

from __future__ import annotations

import math

import pytest

from safedpa.errors import ColumnMapError
from safedpa.records.column_map import ColumnMap, DerivedColumn, SourceColumn
from safedpa.records.column_map_file import parse_column_map

HEAD = 'format = 1\nrobot = "pendulum"\n'
COLUMNS = '[columns]\nt = "time"\nangle = "a"\n'


def column(entry: str, name: str = "rate") -> str:
    """A map with one more column."""
    return f"{HEAD}{COLUMNS}{name} = {entry}\n"


def top(line: str) -> str:
    """A map with one more key at the top."""
    return f"{HEAD}{line}\n{COLUMNS}"


REFUSED = {
    "another format": (f'format = 2\nrobot = "a"\n{COLUMNS}', "format: got 2, wanted 1; this program reads no other"),
    "no format": (f'robot = "a"\n{COLUMNS}', "format: got None, wanted 1"),
    "no toml": ("format = ", "not TOML"),
    "unknown key": (top("period = 1"), "period: unknown key"),
    "no robot": (f"format = 1\n{COLUMNS}", "robot: got None, wanted the robot's name, 'car' say in quotes"),
    "empty robot": (f'format = 1\nrobot = ""\n{COLUMNS}', "robot: got '', wanted the robot's name"),
    "robot of another kind": (f"format = 1\nrobot = 3\n{COLUMNS}", "robot: got 3, wanted the robot's name"),
    "no columns": (HEAD, r"columns: missing; wanted a table \[columns\]"),
    "empty columns": (f"{HEAD}[columns]\n", r"columns: missing; wanted a table \[columns\]"),
    "columns of another kind": (f"{HEAD}columns = 1\n", r"columns: missing; wanted a table \[columns\]"),
    "one source twice": (
        column('"a"'),
        "columns.rate: column 'a' is already the source of 'angle'; one column can be one target only",
    ),
    "column of another kind": (column("1"), "columns.rate: got 1, wanted a column's name or a table like"),
    "empty name": (column('""'), "columns.rate.from: got '', wanted a column's name in quotes"),
    "no name": (column('{ unit = "rad/s" }'), "columns.rate.from: got None, wanted a column's name in quotes"),
    "unknown column key": (column('{ from = "b", factor = 2 }'), "columns.rate.factor: unknown key"),
    "unknown unit": (column('{ from = "b", unit = "furlong" }'), "columns.rate.unit: unknown unit 'furlong'"),
    "unit of another kind": (column('{ from = "b", unit = 1 }'), "columns.rate.unit: got 1, wanted a unit's name"),
    "empty unit": (column('{ from = "b", unit = "" }'), "columns.rate.unit: got '', wanted a unit's name"),
    "scale 0": (column('{ from = "b", scale = 0 }'), "columns.rate.scale: got 0, wanted another number; 0 would erase"),
    "scale true": (column('{ from = "b", scale = true }'), "columns.rate.scale: got True, wanted a finite number"),
    "scale infinite": (column('{ from = "b", scale = inf }'), "columns.rate.scale: got inf, wanted a finite number"),
    "offset nan": (column('{ from = "b", offset = nan }'), "columns.rate.offset: got nan, wanted a finite number"),
    "offset a text": (column('{ from = "b", offset = "1" }'), "columns.rate.offset: got '1', wanted a finite number"),
    "shift infinite": (column('{ from = "b", shift = -inf }'), "columns.rate.shift: got -inf, wanted a finite number"),
    "flip a number": (column('{ from = "b", flip = 1 }'), "columns.rate.flip: got 1, wanted true or false"),
    "flip a text": (column('{ from = "b", flip = "true" }'), "columns.rate.flip: got 'true', wanted true or false"),
    "hold 0": (column('{ from = "b", hold = 0 }'), "columns.rate.hold: got 0, wanted seconds above 0"),
    "hold below 0": (column('{ from = "b", hold = -0.1 }'), "columns.rate.hold: got -0.1, wanted seconds above 0"),
    "hold nan": (column('{ from = "b", hold = nan }'), "columns.rate.hold: got nan, wanted a finite number"),
    "join of one": (
        column('{ from = "b", join = "mean" }'),
        "columns.rate.join: got 'mean' for one column; name several",
    ),
    "join of a list of one": (column('{ from = ["b"], join = "sum" }'), "columns.rate.from: .* wanted two different"),
    "join of none": (
        column('{ from = [], join = "sum" }'),
        "columns.rate.from: .* wanted two different columns or more",
    ),
    "join of the same": (column('{ from = ["b", "b"], join = "sum" }'), "columns.rate.from: .* wanted two different"),
    "join of three, two alike": (
        column('{ from = ["b", "c", "b"], join = "sum" }'),
        "columns.rate.from: .* wanted two different columns or more",
    ),
    "joined by nothing": (column('{ from = ["b", "c"] }'), "columns.rate.join: got None, wanted how they become one"),
    "joined otherwise": (
        column('{ from = ["b", "c"], join = "median" }'),
        "columns.rate.join: got 'median', wanted how they become one: mean, sum, difference, norm, first",
    ),
    "joined of no names": (column('{ from = ["b", 2], join = "sum" }'), "columns.rate.from: got 2, wanted a column's"),
    "topic and from": (
        column('{ topic = "/o", field = "z", from = "b" }'),
        "columns.rate.from: got it beside a topic; write 'from' = \"/o:FIELD\", or leave it out",
    ),
    "topic and join": (
        column('{ topic = "/o", field = "z", join = "sum" }'),
        "columns.rate.join: got it beside a topic; write 'from' = \"/o:FIELD\", or leave it out",
    ),
    "topic alone": (column('{ topic = "/o" }'), "columns.rate: wanted a field of the topic, or for t clock"),
    "topic with field and clock": (
        f'{HEAD}[columns]\nangle = "a"\nt = {{ topic = "/o", field = "z", clock = "header" }}\n',
        "columns.t: wanted a field of the topic, or for t clock = .*, and not both",
    ),
    "empty topic": (column('{ topic = "", field = "z" }'), "columns.rate.topic: got '', wanted a topic's name"),
    "empty field": (column('{ topic = "/o", field = "" }'), "columns.rate.field: got '', wanted a field of the topic"),
    "clock beside t": (
        column('{ topic = "/o", clock = "header" }'),
        "columns.rate.clock: got 'header', wanted header or receipt, and for t alone",
    ),
    "unknown clock": (
        f'{HEAD}[columns]\nangle = "a"\nt = {{ topic = "/o", clock = "wall" }}\n',
        "columns.t.clock: got 'wall', wanted header or receipt, and for t alone",
    ),
    "frames of another kind": (top("frames = 1"), "frames: got 1, wanted tables like"),
    "frame of another kind": (
        top('frames = { "/o" = "map" }'),
        "frames./o: got 'map', wanted a table with frame_id and",
    ),
    "unknown frame": (top('frames = { "/o" = { frame = "map" } }'), "frames./o.frame: unknown key"),
    "empty frame": (top('frames = { "/o" = { frame_id = "" } }'), "frames./o.frame_id: got '', wanted a frame's name"),
    "derive and from": (
        column('{ derive = "rate_from_angle", window = 0.1, from = "b" }'),
        "columns.rate.from: unknown",
    ),
    "derive of another kind": (column("{ derive = 1, window = 0.1 }"), "columns.rate.derive: got 1, wanted what to"),
    "unknown derivation": (column('{ derive = "spin", window = 0.1 }'), "columns.rate.derive: got 'spin'; "),
    "slope of nothing": (column('{ derive = "slope", window = 0.1 }'), "columns.rate.of: missing; wanted the state of"),
    "of, where it is known": (
        column('{ derive = "rate_from_angle", window = 0.1, of = "angle" }'),
        "columns.rate.of: unknown with 'rate_from_angle'",
    ),
    "of no text": (
        column('{ derive = "slope", window = 0.1, of = 1 }'),
        "columns.rate.of: got 1, wanted a state's name",
    ),
    "no window": (
        column('{ derive = "rate_from_angle" }'),
        "columns.rate.window: missing; wanted the seconds over which",
    ),
    "window 0": (
        column('{ derive = "rate_from_angle", window = 0 }'),
        "columns.rate.window: got 0, wanted seconds above",
    ),
    "window infinite": (
        column('{ derive = "rate_from_angle", window = inf }'),
        "columns.rate.window: got inf, wanted a finite number",
    ),
    "derived for another": (
        column('{ derive = "rate_from_angle", window = 0.1 }', "torque"),
        "columns.torque.derive: 'rate_from_angle' gives 'rate', not 'torque'",
    ),
    "derived of what the log has not": (
        f'{HEAD}[columns]\nt = "time"\nrate = {{ derive = "rate_from_angle", window = 0.1 }}\n',
        "columns.rate.derive: 'rate_from_angle' needs the column 'angle' of the log",
    ),
    "derived of what is derived": (
        f'{HEAD}[columns]\nt = "time"\nrate = {{ derive = "rate_from_angle", window = 0.1 }}\n'
        'angle = { derive = "slope", of = "rate", window = 0.1 }\n',
        "columns.(rate|angle).derive: '(rate_from_angle|slope)' needs the column '(angle|rate)' of the log",
    ),
    "unwrap no list": (top('unwrap = "angle"'), "unwrap: got 'angle', wanted a list of names"),
    "unwrap of no column": (top('unwrap = ["angel"]'), "unwrap: got 'angel'; .*angle"),
    "unwrap, the second of no column": (top('unwrap = ["angle", "x"]'), "unwrap: got 'x'; "),
    "skip_where a number": (top("skip_where = 1"), "skip_where: got 1, wanted"),
    "skip_where of numbers": (top("skip_where = [1]"), r"skip_where: got \[1\], wanted"),
    "skip_where of one that is none": (
        top('skip_where = [{ column = "a", equals = 0.0 }, "b"]'),
        "skip_where: got .*, wanted",
    ),
    "skip_where unknown": (top('skip_where = { column = "a", above = 0.0 }'), "skip_where.above: unknown key"),
    "skip_where no column": (
        top("skip_where = { equals = 0.0 }"),
        "skip_where.column: got None, wanted a column's name",
    ),
    "skip_where no number": (
        top('skip_where = { column = "a" }'),
        "skip_where.equals: got None, wanted a finite number",
    ),
    "skip_where nan": (
        top('skip_where = { column = "a", equals = nan }'),
        "skip_where.equals: got nan, wanted a finite",
    ),
    "keep no list": (top('keep = "frozen"'), "keep: got 'frozen', wanted a list of findings whose rows are kept"),
    "keep what is unknown": (top('keep = ["frozen", "frosen"]'), "keep: got 'frosen'; .*frozen"),
    "keep a number": (top("keep = [1]"), "keep: got 1; "),
    "keep_period 0": (top("keep_period = 0"), "keep_period: got 0, wanted seconds above 0"),
    "keep_period below 0": (top("keep_period = -1.5"), "keep_period: got -1.5, wanted seconds above 0"),
    "keep_period true": (top("keep_period = true"), "keep_period: got True, wanted a finite number"),
    "skip_first_rows below 0": (
        top("skip_first_rows = -1"),
        "skip_first_rows: got -1, wanted a whole number, 0 or more",
    ),
    "skip_first_rows broken": (top("skip_first_rows = 1.5"), "skip_first_rows: got 1.5, wanted a whole number, 0 or"),
    "skip_first_rows true": (top("skip_first_rows = true"), "skip_first_rows: got True, wanted a whole number, 0 or"),
    "tracked_point a number": (top("tracked_point = 1"), "tracked_point: got 1, wanted a table with ahead, left"),
    "tracked_point unknown": (top("tracked_point = { up = 1 }"), "tracked_point.up: unknown key"),
    "tracked_point infinite": (top("tracked_point = { left = inf }"), "tracked_point.left: got inf, wanted a finite"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_a_map_that_says_too_much_or_too_little_is_refused_with_its_key(case: str) -> None:
    text, said = REFUSED[case]
    with pytest.raises(ColumnMapError, match=f"^{said}"):
        parse_column_map(text)


TAKEN = {
    "several of one column": (
        '{ from = ["a", "b"], join = "difference" }',
        SourceColumn("a", others=("b",), join="difference"),
    ),
    "two columns": ('{ from = ["b", "c"], join = "norm" }', SourceColumn("b", others=("c",), join="norm")),
    "three columns": ('{ from = ["b", "c", "d"], join = "first" }', SourceColumn("b", others=("c", "d"), join="first")),
    "a unit": ('{ from = "b", unit = "deg/s" }', SourceColumn("b", unit="deg/s")),
    "a scale below 0": ('{ from = "b", scale = -2 }', SourceColumn("b", scale=-2.0)),
    "a tiny scale": ('{ from = "b", scale = 1e-300 }', SourceColumn("b", scale=1e-300)),
    "no scale, no offset": ('{ from = "b", offset = 0, shift = 0.0 }', SourceColumn("b")),
    "a late column": ('{ from = "b", shift = -0.25, offset = 3 }', SourceColumn("b", shift=-0.25, offset=3.0)),
    "turned": ('{ from = "b", flip = true }', SourceColumn("b", flip=True)),
    "not turned": ('{ from = "b", flip = false }', SourceColumn("b")),
    "held": ('{ from = "b", hold = 0.001 }', SourceColumn("b", hold=0.001)),
    "a field": ('{ topic = "/o", field = "z" }', SourceColumn("/o:z")),
    "a field, held": ('{ topic = "/o", field = "z", hold = 2 }', SourceColumn("/o:z", hold=2.0)),
    "derived": ('{ derive = "rate_from_angle", window = 0.1 }', DerivedColumn("rate_from_angle", 0.1)),
    "a slope": ('{ derive = "slope", of = "angle", window = 1 }', DerivedColumn("slope", 1.0, "angle")),
}


@pytest.mark.parametrize("case", TAKEN)
def test_a_column_just_within_what_is_allowed_is_taken_as_it_says(case: str) -> None:
    entry, wanted = TAKEN[case]
    assert parse_column_map(column(entry)).columns["rate"] == wanted


@pytest.mark.parametrize("clock", ["header", "receipt"])
def test_time_may_be_a_clock_of_the_topic(clock: str) -> None:
    found = parse_column_map(f'{HEAD}[columns]\nt = {{ topic = "/o", clock = "{clock}" }}\nangle = "a"\n')
    assert found.columns["t"] == SourceColumn(f"/o:@{clock}")


def test_a_map_of_topics_that_names_no_time_takes_the_stamps_of_its_first_topic() -> None:
    """And one of columns without topics gets none: a log of a table has its own."""
    topics = parse_column_map(f'{HEAD}[columns]\nangle = "/joint:position"\nrate = "/imu:z"\n')
    assert topics.columns["t"] == SourceColumn("/joint:@stamp")
    assert "t" not in parse_column_map(f'{HEAD}[columns]\nangle = "a"\n').columns
    assert parse_column_map(f'{HEAD}[columns]\nangle = "/joint:a"\nt = "/imu:t"\n').columns["t"] == SourceColumn(
        "/imu:t"
    )


def test_what_stands_at_the_top_is_taken_as_it_says() -> None:
    found = parse_column_map(
        f'{HEAD}unwrap = ["angle"]\nskip_first_rows = 3\nkeep_period = 0.02\nkeep = ["frozen", "dead_command"]\n'
        'skip_where = [{ column = "mode", equals = 0 }, { column = "armed", equals = 1.5 }]\n'
        'tracked_point = { ahead = 0.1, left = -0.2 }\nframes = { "/o" = { frame_id = "map" } }\n'
        f"{COLUMNS}",
        "log",
    )
    assert (found.name, found.robot, found.unwrap, found.skip_first_rows) == ("log", "pendulum", ("angle",), 3)
    assert (found.keep_period, found.keep) == (0.02, ("frozen", "dead_command"))
    assert [(rule.column, rule.equals) for rule in found.skip_where] == [("mode", 0.0), ("armed", 1.5)]
    assert found.tracked_point is not None
    assert (found.tracked_point.ahead, found.tracked_point.left, found.tracked_point.yaw_offset) == (0.1, -0.2, 0.0)
    assert found.frames == {"/o": {"frame_id": "map"}}


def test_what_does_not_stand_there_is_nothing() -> None:
    found = parse_column_map(f"{HEAD}{COLUMNS}")
    assert (found.unwrap, found.skip_first_rows, found.skip_where, found.tracked_point) == (None, 0, (), None)
    assert (found.keep_period, found.keep, found.frames) == (None, (), {})
    assert isinstance(found, ColumnMap)
    assert parse_column_map(top("unwrap = []")).unwrap == ()
    one = parse_column_map(top('skip_where = { column = "mode", equals = 0 }')).skip_where
    assert [(rule.column, rule.equals) for rule in one] == [("mode", 0.0)]
    assert math.isclose(parse_column_map(top("keep_period = 1e-9")).keep_period or 0.0, 1e-9)
