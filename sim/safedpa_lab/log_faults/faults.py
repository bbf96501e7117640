"""The matrix of faults: forty-one ways in which a log is unlike a table of numbers, and what each means in each format.

A fault changes an intact ``Table`` or ``Topics``; a fault of the bytes changes the file. It returns what a reader must
report. A format that a fault does not name cannot have it.
"""

from __future__ import annotations

import datetime
import sqlite3
from collections.abc import Callable, Mapping
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from safedpa_lab.log_faults.drive import COMMAND, NAMES, PERIOD, STATE, Drive, Message, Table, Topics

__all__ = ["FAULTS", "FORMS", "TOPIC_FORMS", "Case", "Expected", "Fault"]

FORMS: Final = ("csv", "parquet", "mcap", "db3", "ulg")
TOPIC_FORMS: Final = ("mcap", "db3", "ulg")
_BAGS: Final = ("mcap", "db3")
_TABLES: Final = ("csv", "parquet")


@dataclass
class Case:
    """One log that is to be spoilt: the drive, random numbers, and the intact log in one of its two forms."""

    drive: Drive
    rng: np.random.Generator
    form: str
    table: Table
    topics: Topics
    start: float

    def row(self, low: float = 0.25, high: float = 0.75) -> int:
        """A random row in a part of the drive."""
        return int(self.rng.integers(round(low * len(self.drive)), round(high * len(self.drive))))

    def time(self, row: int) -> float:
        """Time of a row in the intact log [s]."""
        return self.start + row * PERIOD


@dataclass(frozen=True)
class Expected:
    """What a reader must report: kinds of findings, the channel, and times [s] of which one is within a second."""

    kinds: tuple[str, ...] = ()
    """Empty where the log must be read without a finding."""
    channel: str = ""
    times: tuple[float, ...] = ()
    damaged: frozenset[int] = frozenset()
    """Rows that no reader can use."""
    refusable: bool = False
    """Whether a refusal that names the fault is right as well."""


Spoil = Callable[[Case], Expected]


@dataclass(frozen=True)
class Fault:
    """One kind of fault; ``spoil`` by format, and ``harm``, which changes the written file."""

    name: str
    meaning: Mapping[str, str]
    """What it means, by formats separated by blanks."""
    spoil: Spoil | None = None
    harm: Callable[[Case, Path], Expected] | None = None

    @property
    def forms(self) -> tuple[str, ...]:
        """Formats in which it can occur."""
        return tuple(form for form in FORMS if any(form in key.split() for key in self.meaning))

    def meaning_in(self, form: str) -> str:
        """What it means in a format."""
        return next((text for key, text in self.meaning.items() if form in key.split()), "cannot occur")


def _moved(
    case: Case, change: Callable[[np.ndarray[Any, Any]], np.ndarray[Any, Any]], *, receipts: bool = True
) -> None:
    """Changes all times as a function of the true ones [s since the start]: stamps, and on request receipts."""
    t = case.drive.column("t")
    case.table.cells["t"] = change(t).tolist()
    messages = case.topics.messages
    for name in ("stamp", "receipt") if receipts else ("stamp",):
        now = np.array([getattr(message, name) for message in messages]) - case.start
        rows = np.array([message.row for message in messages]) * PERIOD
        changed = change(rows) - rows + now + case.start  # a message moves with its row
        for place, value in enumerate(np.round(changed, 6).tolist()):
            messages[place] = replace(messages[place], **{name: value})


def _step(seconds: float) -> Spoil:
    def spoil(case: Case) -> Expected:
        row = case.row()
        at = row * PERIOD
        _moved(case, lambda t: np.where(t >= at - 1e-9, t + seconds, t))
        kind = ("clock_reset",) if seconds < 0.0 else ("gap",)
        return Expected(kind, times=(case.time(row), case.time(row) + seconds))

    return spoil


def _reset(case: Case) -> Expected:
    """Three episodes; stamps restart, receipts continue."""
    first, second = case.row(0.25, 0.4), case.row(0.6, 0.75)
    bounds = np.array([0, first, second]) * PERIOD
    zero = case.start if case.form in _TABLES else -case.start + 20.0

    def change(t: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
        return t - bounds[np.searchsorted(bounds, t + 1e-9, side="right") - 1] + (zero if zero != case.start else 0.0)

    _moved(case, change, receipts=False)
    begin = 20.0 if case.form in _BAGS else case.start
    return Expected(("clock_reset",), times=(begin, begin + bounds[1]))


def _appended(case: Case) -> Expected:
    row = case.row()
    case.table.lines[row] = ",".join(NAMES)
    case.table.cells["t"][row:] = (case.drive.column("t")[row:] - row * PERIOD).tolist()
    return Expected(("clock_reset",), times=(0.0, row * PERIOD))


def _stamps(case: Case, topic: str, chosen: Callable[[int], bool], stamp: Callable[[Message], float]) -> None:
    for place, message in enumerate(case.topics.messages):
        if message.topic == topic and chosen(message.row):
            case.topics.messages[place] = replace(message, stamp=stamp(message))


def _driver_restart(case: Case) -> Expected:
    row = case.row()
    _stamps(case, COMMAND, lambda k: k >= row, lambda message: message.stamp - case.start + 3.0)
    return Expected(("bad_stamp",), COMMAND, (case.time(row),))


def _unstamped(case: Case) -> Expected:
    if case.form in _BAGS:
        _stamps(case, COMMAND, lambda k: k % 2 == 1, lambda message: 0.0)
        return Expected(("bad_stamp",), COMMAND, (case.time(1),))
    rows = range(10, len(case.drive), 20)
    case.table.cells["t"] = [0.0 if row in rows else t + 50.0 for row, t in enumerate(case.table.cells["t"])]
    return Expected(("bad_stamp",), times=(50.0 + 10 * PERIOD,), damaged=frozenset(rows))


def _future(case: Case) -> Expected:
    rows = {int(k) for k in case.rng.choice(np.arange(20, len(case.drive) - 20), 4, replace=False)}
    for topic in (STATE, COMMAND):
        _stamps(case, topic, rows.__contains__, lambda message: message.stamp + 3.1e7)
    for row in rows:
        case.table.cells["t"][row] += 3.1e7
    damaged = frozenset(rows) if case.form in _TABLES else frozenset[int]()
    return Expected(("bad_stamp",), STATE if case.form in _BAGS else "", (case.time(min(rows)),), damaged)


def _other_epoch(case: Case) -> Expected:
    _stamps(case, COMMAND, lambda k: k % 3 == 1, lambda message: message.stamp - case.start + 700.0)
    return Expected(("bad_stamp",), COMMAND, (case.time(1),))


def _two_clocks(case: Case) -> Expected:
    _stamps(case, COMMAND, lambda k: True, lambda message: message.stamp + 5.0)
    return Expected(("bad_stamp", "two_clocks"), COMMAND, (case.time(0),), refusable=True)


def _swapped(case: Case) -> Expected:
    """Every tenth row is written before the one in front of it."""
    order = list(range(len(case.drive)))
    for row in range(9, len(order) - 1, 10):
        order[row], order[row + 1] = order[row + 1], order[row]
    return _in_order(case, order, 9)


def _late_batch(case: Case) -> Expected:
    """Five rows are written after the next five."""
    row = case.row()
    order = list(range(len(case.drive)))
    order[row : row + 10] = [*order[row + 5 : row + 10], *order[row : row + 5]]
    return _in_order(case, order, row)


def _in_order(case: Case, order: list[int], first: int) -> Expected:
    case.table.ordered(order)
    by_row = {(message.topic, message.row): message for message in case.topics.messages}
    receipts = [message.receipt for message in case.topics.messages]
    late = [by_row[topic, row] for row in order for topic in (COMMAND, STATE)]
    case.topics.messages = [replace(one, receipt=at) for one, at in zip(late, receipts, strict=True)]
    channel = STATE if case.form in _BAGS else ""
    return Expected(("out_of_order",), channel, (case.time(first),))


def _repeated(case: Case) -> Expected:
    rows = {int(k) for k in case.rng.choice(len(case.drive), 12, replace=False)}
    case.table.ordered([k for row in range(len(case.drive)) for k in [row] * (1 + (row in rows))])
    case.topics.messages = [one for message in case.topics.messages for one in [message] * (1 + (message.row in rows))]
    return Expected(("repeated_row",), times=(case.time(min(rows)),))


def _gap(case: Case) -> Expected:
    row = case.row()
    lost = frozenset(range(row, row + 30))
    case.table.ordered([k for k in range(len(case.drive)) if k not in lost])
    case.topics.messages = [message for message in case.topics.messages if message.row not in lost]
    return Expected(("gap",), times=(case.time(row),), damaged=lost)


def _stuck(case: Case) -> Expected:
    """The clock stands for ten rows; in a bag the receipts continue."""
    row = case.row()
    stuck = frozenset(range(row + 1, row + 11))
    _moved(
        case, lambda t: np.where((t > row * PERIOD) & (t < (row + 11) * PERIOD - 1e-9), row * PERIOD, t), receipts=False
    )
    return Expected(("repeated_row", "gap", "bad_stamp"), times=(case.time(row),), damaged=stuck)


def _wraps(case: Case) -> Expected:
    """A counter of microseconds in 32 bits."""
    row = case.row()
    case.table.cells["t"] = [round(k * PERIOD * 1e6 - row * PERIOD * 1e6) % 2**32 for k in range(len(case.drive))]
    case.table.map = _map(t='{ from = "t", unit = "us" }')
    return Expected(("clock_reset",), times=(0.0, 2**32 * 1e-6))


def _pause(case: Case) -> Expected:
    """The commands are silent for 2 s; topics hold the newest one for 0.5 s at most."""
    row = case.row()
    silent = range(row, row + 40)
    for name in NAMES[5:]:
        case.table.cells[name] = [None if k in silent else cell for k, cell in enumerate(case.table.cells[name])]
    messages = case.topics.messages
    case.topics.messages = [one for one in messages if one.topic == STATE or one.row not in silent]
    kind = "not_a_number" if case.form in _TABLES else "stale_topic"
    channel = {"csv": "target_speed", "parquet": "target_speed", "ulg": "cmd"}.get(case.form, COMMAND)
    return Expected((kind,), channel, (case.time(row), case.time(row + 10)), frozenset(silent))


def _iso(case: Case) -> Expected:
    zone = datetime.timezone(datetime.timedelta(hours=int(case.rng.integers(-8, 9))))
    start = datetime.datetime(2026, 3, 29, 0, 59, 50, tzinfo=zone)
    times = [start + datetime.timedelta(seconds=t) for t in case.table.cells["t"]]
    case.table.cells["t"] = times if case.form == "parquet" else [str(one) for one in times]
    return Expected()


def _clock_times(case: Case) -> Expected:
    """Hours, minutes, seconds; a third of the drives passes midnight."""
    begin = float(case.rng.choice([36_000.0, 86_390.0, 86_395.0]))
    times = [(begin + t) % 86_400.0 for t in case.table.cells["t"]]
    case.table.cells["t"] = [f"{int(t // 3600):02d}:{int(t // 60 % 60):02d}:{t % 60.0:06.3f}" for t in times]
    return Expected()


def _epoch_unit(case: Case) -> Expected:
    power = int(case.rng.choice([3, 6, 9]))
    case.table.cells["t"] = [round((1_700_000_000 + t) * 10**power) for t in case.table.cells["t"]]
    return Expected(("time_unit",), "t")


def _typed(case: Case) -> Expected:
    import decimal

    cells = case.table.cells
    cells["t"] = [datetime.timedelta(seconds=t) for t in cells["t"]]
    cells["x"] = [decimal.Decimal(f"{x:.9f}") for x in cells["x"]]
    return Expected()


def _decimal_comma(case: Case) -> Expected:
    case.table.decimal = ","
    if case.rng.random() < 0.5:
        case.table.quoted = True
    else:
        case.table.delimiter = ";"
        for name in NAMES:  # zeros in more rows than a reader looks at from the start; the judge ignores them
            first = list(range(200)) if name == "t" else [0] * 200
            case.table.cells[name] = [*first, *(cell + 200 if name == "t" else cell for cell in case.table.cells[name])]
    return Expected(("decimal_comma", "repeated_row", "frozen", "gap"), times=())


def _names_with_commas(case: Case) -> Expected:
    units = ("s", "m", "m", "rad", "m/s", "m/s", "rad")
    names = [f"{name}, {unit}" for name, unit in zip(NAMES, units, strict=True)]
    case.table.delimiter = ";" if case.rng.random() < 0.5 else ","
    case.table.header = [f'"{name}"' for name in names] if case.form == "csv" else names
    case.table.map = _map(**{name: f'"{long}"' for name, long in zip(NAMES, names, strict=True)})
    return Expected()


def _trailing(case: Case) -> Expected:
    case.table.tail = ","
    if case.rng.random() < 0.5:
        case.table.header = [*NAMES, ""]
    return Expected()


def _padded(case: Case) -> Expected:
    case.table.header = [f" {name} " for name in NAMES]
    return Expected()


_MISSING: Final = ("#N/A", "1.#QNAN", "--", "-", "NULL", "n/a", "?", "missing", "#DIV/0!", "<NA>")


def _not_given(case: Case) -> Expected:
    rows = sorted(int(k) for k in case.rng.choice(len(case.drive), 6, replace=False))
    word = str(case.rng.choice(_MISSING))
    for row in rows:
        case.table.cells["x"][row] = None if case.form == "parquet" else word
    return Expected(("missing_value", "not_a_number"), "x", (case.time(rows[0]),), frozenset(rows))


def _booleans(case: Case) -> Expected:
    """The first rows are not armed and must be skipped."""
    row = case.row(0.05, 0.1)
    pair = [("False", "True"), ("false", "true"), ("FALSE", "TRUE")][int(case.rng.integers(3))]
    armed = [k >= row for k in range(len(case.drive))]
    case.table.cells["armed"] = list(armed) if case.form == "parquet" else [pair[one] for one in armed]
    case.table.map = 'skip_where = { column = "armed", equals = 0 }\n' + _map()
    return Expected(damaged=frozenset(range(row)))


def _missing_header(case: Case) -> Expected:
    case.table.header = []
    return Expected(("no_header",), refusable=True)


def _comment_header(case: Case) -> Expected:
    mark = str(case.rng.choice(["#", "%", "//", "# "]))
    case.table.header = [mark + NAMES[0], *NAMES[1:]]
    if case.rng.random() < 0.5:
        case.table.before = ("# made by a logger", "# 20 Hz, metres, radians")
    return Expected(("comment_lines",) if case.table.before else ())


def _other_delimiter(case: Case) -> Expected:
    case.table.delimiter = str(case.rng.choice(["|", "\t", " ", "   ", " | "]))
    return Expected()


def _encoding(case: Case) -> Expected:
    case.table.encoding = str(case.rng.choice(["utf-16", "utf-8-sig", "utf-16-le", "utf-8"]))
    case.table.packed = case.table.encoding == "utf-8"
    return Expected()


def _lists(case: Case) -> Expected:
    values = case.drive.values.tolist()
    case.table.cells = {
        "timestamp": [row[0] for row in values], "observation.state": [row[1:5] for row in values],
        "action": [row[5:] for row in values],
    }  # fmt: skip
    sources = [f'"observation.state[{k}]"' for k in range(4)] + ['"action[0]"', '"action[1]"']
    case.table.map = _map(t='"timestamp"', **dict(zip(NAMES[1:], sources, strict=True)))
    return Expected()


def _outer_joined(case: Case) -> Expected:
    """A line for each state, and a line for each command 5 ms before it."""
    cells: dict[str, list[Any]] = {name: [] for name in NAMES}
    for row in case.drive.values.tolist():
        for early, own in ((0.005, NAMES[5:]), (0.0, NAMES[1:5])):
            for name, value in zip(NAMES, row, strict=True):
                cells[name].append(value - early if name == "t" else value if name in own else None)
    case.table.cells = cells
    return Expected(("joined_rates",))


def _units_row(case: Case) -> Expected:
    case.table.lines[0] = str(case.rng.choice(["s,m,m,rad,m/s,m/s,rad", "[s],[m],[m],[rad],[m/s],[m/s],[rad]"]))
    return Expected(("comment_lines",), times=())


def _foreign_lines(case: Case) -> Expected:
    row = case.row()
    case.table.lines[row] = str(case.rng.choice(["# paused by the operator", "WARN: battery low", "--- marker 3 ---"]))
    return Expected(("malformed_line", "comment_lines"), times=())


def _cut_off(case: Case, path: Path) -> Expected:
    data = path.read_bytes()
    keep = case.rng.uniform(0.5, 0.8)
    end = round(keep * len(data))
    if case.form == "csv":  # not after ten digits of the last cell, which looks whole, and is
        begin = data.rindex(b"\n", 0, end) + 1
        last = data.rindex(b",", 0, data.index(b"\n", begin)) + 1
        end = int(case.rng.integers(begin + 20, last + 10))
    if case.form == "ulg" and end == _message_at(data, end):
        end -= 1  # a log that ends between two messages is whole
    path.write_bytes(data[:end])
    rows = frozenset(range(round((keep - 0.06) * len(case.drive)), len(case.drive)))
    whole = case.form in ("parquet", "db3")  # the index of the one is at its end; pages of the other are anywhere
    return Expected(("cut_off", "damaged", "malformed_line"), damaged=rows, refusable=whole)


def _message_at(data: bytes, at: int) -> int:
    """Byte at which the first message of a flight log at or after a byte begins."""
    begin = 16
    while begin < at:
        begin += 3 + int.from_bytes(data[begin : begin + 2], "little")
    return begin


def _hole(case: Case, path: Path) -> Expected:
    """Zeros in the middle, as after a failed write."""
    data = bytearray(path.read_bytes())
    share = case.rng.uniform(0.4, 0.6)
    at, size = round(share * len(data)), min(4096, len(data) // 20)
    data[at : at + size] = bytes(size)
    path.write_bytes(data)
    lost = 0.16 if case.form in ("mcap", "db3") else 0.08  # a chunk, or the rest of its page
    rows = range(round((share - lost) * len(case.drive)), round((share + lost) * len(case.drive)))
    return Expected(
        ("cut_off", "damaged", "malformed_line"), damaged=frozenset(rows), refusable=case.form in ("parquet", "db3")
    )


_OVERWRITTEN = 40
"""Rows of a state with zeros; of commands a fifth, which are held for as long."""


def _overwritten(case: Case, path: Path) -> Expected:
    """Zeros in a file without checksums: over rows of a state, or over whole messages."""
    row = case.row()
    if case.form == "parquet":
        from pyarrow import parquet

        parquet.write_table(parquet.read_table(path), path, compression="none", use_dictionary=False)
        rows = range(row, row + _OVERWRITTEN)
        contents = [case.drive.column("speed")[rows.start : rows.stop].tobytes()]
        expected = Expected(("frozen", "damaged", "not_a_number"), "speed", (case.time(row),), frozenset(rows))
    else:
        rows = range(row, row + _OVERWRITTEN // 5)
        contents = (_without_checksums(path) if case.form == "mcap" else _commands(path))[rows.start : rows.stop]
        expected = Expected(("damaged",), COMMAND, (case.time(row),), frozenset(rows))
    data = path.read_bytes()
    for content in contents:
        data = data.replace(content, bytes(len(content)), 1)
    path.write_bytes(data)
    return expected


def _commands(path: Path) -> list[bytes]:
    """Contents of the commands in a SQLite bag."""
    query = "SELECT data FROM messages JOIN topics ON topics.id = topic_id WHERE name = ? ORDER BY messages.id"
    with closing(sqlite3.connect(path)) as base:
        return [data for (data,) in base.execute(query, (COMMAND,))]


def _without_checksums(path: Path) -> list[bytes]:
    """Writes an MCAP again without chunks and checksums; returns the contents of the commands."""
    import io

    from mcap.reader import make_reader
    from mcap.writer import Writer

    commands, channels = [], dict[int, int]()
    reader = make_reader(io.BytesIO(path.read_bytes()))
    with path.open("wb") as file:
        writer = Writer(file, use_chunking=False, enable_crcs=False)
        writer.start(profile="ros2", library="log-faults")
        for schema, channel, message in reader.iter_messages(log_time_order=False):
            if channel.id not in channels and schema is not None:
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer.register_channel(channel.topic, channel.message_encoding, number)
            writer.add_message(channels[channel.id], message.log_time, message.data, message.publish_time)
            commands += [message.data] if channel.topic == COMMAND else []
        writer.finish()
    return commands


def _resubscribed(case: Case) -> Expected:
    case.topics.resubscribed = 2 * case.row()
    return Expected()


def _two_types(case: Case) -> Expected:
    """The first half of the commands is a Twist, the rest a TwistStamped: another program publishes them."""
    row = case.row()
    messages = case.topics.messages
    case.topics.messages = [replace(one, form="plain" if one.row < row else "") for one in messages]
    if case.rng.random() < 0.5:
        case.topics.field = "linear.x"
    lost = range(row) if case.topics.field != "linear.x" else range(row, len(case.drive))
    return Expected(("two_types",), COMMAND, (case.time(row), case.time(0)), frozenset(lost), refusable=True)


def _unclosed(case: Case, path: Path) -> Expected:
    """The second half of the messages is only in the write-ahead log, as when the recorder was killed."""
    other = path.with_name("other.db3")
    path.rename(other)
    half = len(case.topics.messages) // 2
    with closing(sqlite3.connect(other)) as base:
        rows = base.execute("SELECT * FROM messages ORDER BY id").fetchall()
        base.execute("DELETE FROM messages WHERE id > ?", (half,))
        base.commit()
        base.execute("PRAGMA journal_mode = WAL")
        base.execute("PRAGMA wal_autocheckpoint = 0")
        base.executemany("INSERT INTO messages VALUES (?, ?, ?, ?)", rows[half:])
        base.commit()
        for name in (other.name, f"{other.name}-wal"):
            path.with_name(name.replace("other", path.stem)).write_bytes(path.with_name(name).read_bytes())
    other.unlink()
    return Expected(("cut_off",), damaged=frozenset())


def _map(**sources: str) -> str:
    lines = [f"{name} = {sources.get(name, chr(34) + name + chr(34))}" for name in NAMES]
    return "\n".join(["[columns]", *lines]) + "\n"


def _fault(name: str, spoil: Spoil, **meaning: str) -> Fault:
    return Fault(name, {key.replace("_", " "): text for key, text in meaning.items()}, spoil)


FAULTS: Final = (
    _fault("clock_set_back", _step(-5.013), csv_parquet="times go back by 5 s", mcap_db3="stamps and receipts go back"),
    _fault("clock_set_back_a_little", _step(-0.311), csv_parquet="by 0.3 s", mcap_db3="stamps and receipts, by 0.3 s"),
    _fault("clock_set_forward", _step(37.0), csv_parquet="times step by 37 s", mcap_db3="stamps and receipts step"),
    _fault("simulation_reset", _reset, csv_parquet="times restart twice", mcap_db3="stamps restart, receipts continue"),
    _fault("appended_file", _appended, csv="a second log with its header follows the first"),
    _fault("driver_restart", _driver_restart, mcap_db3="stamps of the commands begin again at the driver's start"),
    _fault("unstamped", _unstamped, csv_parquet="one time in twenty is 0", mcap_db3="every other command has stamp 0"),
    _fault("future_time", _future, csv_parquet="four times are a year ahead", mcap_db3="four stamps are a year ahead"),
    _fault("other_epoch", _other_epoch, mcap_db3="every third command is stamped since boot"),
    _fault("two_clocks", _two_clocks, mcap_db3="commands are stamped by a computer 5 s ahead"),
    _fault("swapped_rows", _swapped, csv_parquet="neighbours are swapped", mcap_db3="messages arrive out of order"),
    _fault("late_batch", _late_batch, csv_parquet="five rows come 0.25 s late", mcap_db3="five messages arrive late"),
    _fault("repeated_rows", _repeated, csv_parquet="rows occur twice", mcap_db3_ulg="messages occur twice"),
    _fault("gap", _gap, csv_parquet="1.5 s without rows", mcap_db3_ulg="1.5 s without messages"),
    _fault("stuck_clock", _stuck, csv_parquet="ten rows have one time", mcap_db3="ten messages have one stamp"),
    _fault("counter_wraps", _wraps, csv_parquet="microseconds in 32 bits begin again"),
    _fault("command_pause", _pause, csv_parquet="2 s of empty cells", mcap_db3_ulg="2 s without commands"),
    _fault("iso_times", _iso, csv="ISO 8601 with a zone", parquet="timestamps with a zone"),
    _fault("clock_times", _clock_times, csv="hours:minutes:seconds, also past midnight"),
    _fault("epoch_unit", _epoch_unit, csv_parquet="ms, us or ns since 1970, and no unit in the map"),
    _fault("typed_columns", _typed, parquet="durations and decimals"),
    _fault("decimal_comma", _decimal_comma, csv="between semicolons, from row 200 on; or quoted between commas"),
    _fault("names_with_commas", _names_with_commas, csv="quoted names with commas", parquet="names with commas"),
    _fault("trailing_delimiter", _trailing, csv="at the end of rows, in half of the logs also of the header"),
    _fault("padded_names", _padded, csv_parquet="blanks around names"),
    _fault("missing_words", _not_given, csv="a word for a missing value", parquet="nulls"),
    _fault("booleans", _booleans, csv="true and false as words", parquet="a column of booleans"),
    _fault("missing_header", _missing_header, csv="the first line has numbers"),
    _fault("comment_header", _comment_header, csv="the names are in a comment line"),
    _fault("other_delimiter", _other_delimiter, csv="pipes, tabs or blanks"),
    _fault("encoding", _encoding, csv="UTF-16, a byte order mark, or packed by gzip"),
    _fault("list_columns", _lists, parquet="state and action are lists"),
    _fault("outer_joined", _outer_joined, csv_parquet="two rates in one table, with empty cells"),
    _fault("units_row", _units_row, csv="the second line names the units"),
    _fault("foreign_lines", _foreign_lines, csv="a line of text between the rows"),
    Fault(
        "cut_off",
        {
            "csv": "the last line ends in one of its cells",
            "parquet": "no footer",
            "mcap": "no index",
            "db3 ulg": "bytes lost",
        },
        harm=_cut_off,
    ),
    Fault(
        "hole",
        {"csv mcap db3 ulg": "zeros in the middle", "parquet": "zeros in the middle; pages have checksums"},
        harm=_hole,
    ),
    Fault(
        "overwritten",
        {
            "parquet": "zeros over rows of a state, no checksums; over a command, or in its range: cannot be seen",
            "mcap db3": "zeros over messages, no checksums; over a part of a message, in its range: cannot be seen",
        },
        harm=_overwritten,
    ),
    _fault("resubscribed", _resubscribed, ulg="the commands get another identifier"),
    _fault("two_types", _two_types, mcap_db3="Twist, then TwistStamped on one topic"),
    Fault("unclosed", {"db3": "messages are only in the write-ahead log"}, harm=_unclosed),
)
"""All faults, in the order of the table."""
