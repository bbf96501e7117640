"""Converts the cells of a table to numbers: missing values, booleans, dates, times of day, decimal commas.

``numbers_of_texts`` converts cells of text, ``numbers_of_column`` a typed column of Arrow.
"""

from __future__ import annotations

import datetime
import re
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.records.run import Finding

if TYPE_CHECKING:
    import pyarrow

__all__ = [
    "DATE",
    "NULLS",
    "Cells",
    "element_of",
    "floats_of",
    "has_decimal_commas",
    "missing_value_findings",
    "numbers_of_column",
    "numbers_of_texts",
]

NULLS = ["", "nan", "NaN", "NAN", "NA", "N/A", "null", "NULL", "None", "-nan"]
"""Words for a missing value that programs write for NaN; they are read without a finding."""
_MISSING = {
    "#n/a", "#na", "n/a", "na", "<na>", "nat", "null", "none", "nil", "missing", "undefined", "invalid", "-", "--",
    "---", "?", ".", "*", "#div/0!", "#num!", "#value!", "#ref!", "#name?", "#null!", "1.#qnan", "1.#ind", "-1.#ind",
    "-1.#qnan", "1.#snan", "nan(ind)", "-nan(ind)", "nan(snan)", "+nan",
}  # fmt: skip
"""Further words, in lower case, of spreadsheets, loggers and C libraries; each is reported."""
_INFINITE = {"1.#inf": float("inf"), "-1.#inf": float("-inf")}
_BOOLEANS = {"true": 1.0, "false": 0.0, "yes": 1.0, "no": 0.0, "on": 1.0, "off": 0.0}
DATE = re.compile(r"\s*\d{1,4}[-/.:]\d{1,2}[-/.:]\d")
"""The beginning of a date, or of a time of day."""
_DAY_FIRST = re.compile(r"(\d{1,2})\.(\d{1,2})\.(\d{4})[ T,]+(.*)")
_TIME_OF_DAY = re.compile(r"(\d{1,3}):(\d{1,2}):(\d{1,2}(?:[.,]\d+)?)")
_DAY = 86_400.0
_EPOCH = datetime.datetime(1970, 1, 1, tzinfo=datetime.UTC)
_ONE_SECOND = datetime.timedelta(seconds=1)
_COMMA_NUMBER = re.compile(r"[-+]?\d*,\d+(?:[eE][-+]?\d+)?")


@dataclass
class Cells:
    """A column of text as numbers, shape (rows,); ``bad`` are the rows of cells that are none."""

    values: FloatArray
    bad: list[int] = field(default_factory=list)
    markers: Counter[str] = field(default_factory=Counter)
    """Words for a missing value, with their count."""
    is_time: bool = False
    """Whether the cells were dates or times of day: the values are then seconds."""


def numbers_of_texts(cells: Sequence[str | None], point: str) -> Cells:
    """Converts cells of text; ``point`` is the decimal mark.

    Dates are seconds since 1970 (without a zone: UTC), times of day seconds since the first midnight.
    """
    found = Cells(np.full(len(cells), np.nan))
    for row, cell in enumerate(cells):
        try:
            found.values[row] = _number(cell, point)
        except ValueError:
            found.bad.append(row)
    if found.bad:
        _convert_texts(cells, found)
    for parse in (_date, _time_of_day):
        if found.bad and _are_times(cells, found, parse):
            break
    return found


def _number(cell: str | None, point: str) -> float:
    """Converts a cell; raises ValueError if it is not a number.

    Stricter than ``float``, which accepts 1_0 and digits of other scripts. With decimal commas a point is refused,
    because it may separate thousands (1.234).
    """
    if cell is None or cell.strip() in NULLS:
        return float("nan")
    if "_" in cell or not cell.isascii() or (point == "," and "." in cell):
        raise ValueError(cell)
    return float(cell.replace(",", ".") if point == "," else cell)


def _convert_texts(cells: Sequence[str | None], found: Cells) -> None:
    rest = []
    for row in found.bad:
        text = (cells[row] or "").strip()
        word = text.lower()
        if word in _BOOLEANS:
            found.values[row] = _BOOLEANS[word]
        elif word in _INFINITE:
            found.values[row] = _INFINITE[word]
        elif word in _MISSING:
            found.markers[text] += 1
        else:
            rest.append(row)
    found.bad = rest


def _are_times(cells: Sequence[str | None], found: Cells, parse: Callable[[str], float]) -> bool:
    """Whether every cell that is not missing is a time; if so, ``found`` gets the times."""
    if np.isfinite(found.values).any():
        return False
    values = found.values.copy()
    try:
        values[found.bad] = [parse((cells[row] or "").strip()) for row in found.bad]
    except (ValueError, OverflowError):
        return False
    if parse is _time_of_day:
        filled = np.array(found.bad)
        values[filled] += _DAY * np.cumsum(np.append(False, np.diff(values[filled]) < -_DAY / 2.0))
    found.values, found.bad, found.is_time = values, [], True
    return True


def _date(text: str) -> float:
    """Seconds since 1970 of a date with a time: ISO 8601, with slashes after the year, or day.month.year."""
    text = text.removesuffix(" UTC").removesuffix(" GMT")
    day_first = _DAY_FIRST.fullmatch(text)
    if day_first:
        text = f"{day_first[3]}-{int(day_first[2]):02d}-{int(day_first[1]):02d} {day_first[4]}"
    elif text[4:5] == "/" and text[7:8] == "/":
        text = text.replace("/", "-", 2)
    moment = datetime.datetime.fromisoformat(text.replace(",", "."))
    moment = moment.replace(tzinfo=datetime.UTC) if moment.tzinfo is None else moment
    return (moment - _EPOCH) / _ONE_SECOND


def _time_of_day(text: str) -> float:
    found = _TIME_OF_DAY.fullmatch(text)
    if found is None:
        raise ValueError(text)
    return 3600.0 * int(found[1]) + 60.0 * int(found[2]) + float(found[3].replace(",", "."))


def has_decimal_commas(cells: Sequence[str | None], bad: Sequence[int]) -> bool:
    """Whether the first bad cell is a number with a decimal comma."""
    return bool(bad) and _COMMA_NUMBER.fullmatch((cells[bad[0]] or "").strip()) is not None


def missing_value_findings(markers: dict[str, Counter[str]]) -> list[Finding]:
    """The finding for words that were read as missing values, by column."""
    found = []
    for name, counted in markers.items():
        if counted:
            listed = ", ".join(f"'{word}'" for word, _ in counted.most_common(3))
            total = counted.total()
            cells = "1 cell holds" if total == 1 else f"{total} cells hold"
            found.append(Finding("missing_value", f"{name}: {cells} {listed}; read as missing values", total))
    return found


def element_of(name: str, present: Sequence[str]) -> tuple[str, int] | None:
    """Splits ``action[0]`` if the table has no such column, but one called ``action``."""
    found = re.fullmatch(r"(.+)\[(\d{1,6})\]", name)
    return (found[1], int(found[2])) if name not in present and found and found[1] in present else None


def numbers_of_column(column: pyarrow.ChunkedArray) -> Cells | None:
    """Converts a column of Arrow: numbers, booleans, decimals, timestamps, durations, times, dates and texts.

    None if its type has no numbers. Times are seconds; timestamps are seconds since 1970.
    """
    import pyarrow
    from pyarrow import types

    kind = column.type
    if types.is_dictionary(kind):
        column = column.cast(kind.value_type)
        kind = column.type
    if types.is_string(kind) or types.is_large_string(kind):
        texts = column.to_pylist()
        found = numbers_of_texts(texts, ".")
        if has_decimal_commas(texts, found.bad):
            found = numbers_of_texts(texts, ",")
        return None if found.bad else found
    ticks = {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9}
    if types.is_timestamp(kind) or types.is_duration(kind) or types.is_time(kind):
        whole = column.cast(pyarrow.int32() if types.is_time32(kind) else pyarrow.int64())
        # one rounding: gives the float nearest to the exact time
        seconds = floats_of(whole) / ticks[kind.unit]
        if types.is_time(kind):
            seconds += _DAY * np.cumsum(np.append(False, np.diff(seconds) < -_DAY / 2.0))[: len(seconds)]
        return Cells(seconds, is_time=True)
    if not (types.is_floating(kind) or types.is_integer(kind) or types.is_boolean(kind) or types.is_decimal(kind)):
        return None
    return Cells(floats_of(column))


def floats_of(column: pyarrow.ChunkedArray) -> FloatArray:
    """Converts a column of Arrow to float64, shape (rows,); null is NaN.

    Unlike ``to_numpy`` it does not import pandas, which takes longer than reading an hour.
    """
    import pyarrow

    # safe=False: ns since 1970 exceed the 53 bits of a float64, so times are rounded to 256 ns, as in all logs
    column = column.cast(pyarrow.float64(), safe=False)
    found, at = np.empty(len(column)), 0
    for chunk in column.chunks:
        part = found[at : at + len(chunk)]
        if len(chunk):
            part[:] = np.frombuffer(chunk.buffers()[1], np.float64, len(chunk), chunk.offset * part.itemsize)
        if chunk.null_count:
            part[np.from_dlpack(chunk.is_null().cast(pyarrow.uint8())) == 1] = np.nan
        at += len(chunk)
    return found
