"""Finds out how a CSV file is written: encoding, header, delimiter and decimal mark.

Every delimiter is tried on lines from all parts of the file; the one that finds most of the wanted columns, in rows of
equal length, is right.
"""

from __future__ import annotations

import csv
import gzip
import io
import re
import zlib
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import IO

from safedpa.errors import RunError
from safedpa.limits import limit, too_much
from safedpa.records.readers.cells import DATE, element_of, numbers_of_texts
from safedpa.records.readers.own_process import allow_for
from safedpa.records.run import Finding

__all__ = ["COMMENTS", "GZIP", "CsvFile", "Layout", "decimal_comma_finding", "decoded", "find_layout"]

GZIP = b"\x1f\x8b"
COMMENTS = ("#", "%", "//")
_BLANKS = " "
_DELIMITERS = (",", ";", "\t", "|", _BLANKS)
_MAX_HEADER_LINES = 60
"""The header is searched among so many first lines."""
_PARTS, _PART_BYTES = 12, 2048
"""Pieces of the rest of the file from which further lines are taken."""
_FIRST_LETTERS = 4
"""Letters at the beginning of a text in UTF-16 that have to be ASCII: binary data may begin like one."""
_MIN_FITTING = 0.5
"""Share of the rows that must have as many cells as the header, if both are split at blanks."""
_UNPACKED_BYTES = 1 << 20
_MAX_UNIT = 16
"""Letters of the name of a unit."""
_NUMBER = re.compile(r"[-+]?(?:\d[\d.,]*|[.,]\d+)(?:[eE][-+]?\d+)?")


class CsvFile:
    """The bytes of a CSV file as UTF-8 text: unpacked and converted in memory if needed, else those of the file."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._text: bytes | None = None
        size = path.stat().st_size
        if size > limit("table_bytes"):
            raise too_much("table_bytes", f"{size} bytes", str(path))
        with path.open("rb") as file:
            start = file.read(256)
        self.findings: tuple[Finding, ...] = ()
        """Of the file as a whole: a packed one may be cut off."""
        if start.startswith(GZIP):
            self._text, self.findings = _unpacked(path, size)
            start = self._text[:256]
        encoding = _wide_encoding(start)
        if b"\r" in start and b"\n" not in start and not encoding:
            # Carriage returns alone, as old Macintosh programs end lines.
            data = path.read_bytes() if self._text is None else self._text
            if b"\n" not in data:
                self._text = data.replace(b"\r", b"\n")
        if encoding:
            data = path.read_bytes() if self._text is None else self._text
            text = data.decode(encoding, "replace").lstrip("\ufeff")
            if not text[:_FIRST_LETTERS].isascii():
                raise RunError(f"{path}: cannot be read as text; wanted a CSV file in UTF-8 or UTF-16")
            self._text = text.encode()

    def open(self) -> IO[bytes]:
        """The text as a new file."""
        return self.path.open("rb") if self._text is None else io.BytesIO(self._text)

    def columns_of_blanks(self) -> None:
        """Replaces runs of blanks between cells by tabs."""
        with self.open() as file:
            data = file.read()
        self._text = re.sub(rb"(?m)[ \t]+", b"\t", re.sub(rb"(?m)^[ \t]+|[ \t]+(?=\r?$)", b"", data))

    @cached_property
    def size(self) -> int:
        """Bytes of the text."""
        return self.path.stat().st_size if self._text is None else len(self._text)

    def first_lines(self) -> list[bytes]:
        """The first lines, among which the header is searched; any kind of line end."""
        most = limit("header_bytes")
        with self.open() as file:
            start = file.read(most + 1)
        lines = start.splitlines()[:_MAX_HEADER_LINES] or [b""]
        if len(start) > most and len(lines) == 1:
            raise too_much("header_bytes", f"more than {most} bytes in the first line", str(self.path))
        return lines

    def other_lines(self) -> list[str]:
        """Whole lines from all parts of the file."""
        found = []
        with self.open() as file:
            for part in range(1, _PARTS + 1):
                at = self.size * part // _PARTS - _PART_BYTES
                if at > 0:
                    file.seek(at)
                    found += file.read(_PART_BYTES).splitlines()[1:-1]
        return [text for line in found if (text := decoded(line))]


def _unpacked(path: Path, size: int) -> tuple[bytes, tuple[Finding, ...]]:
    """The text of a file packed by gzip, up to its damage, without the line that is damaged."""
    most = max(limit("expansion_free_bytes"), size * limit("expansion"))
    data, reason = bytearray(), ""
    with gzip.open(path) as packed:
        try:
            while len(data) <= most and (piece := packed.read1(_UNPACKED_BYTES)):
                data += piece
                allow_for(len(piece))
        except (EOFError, OSError, zlib.error) as error:
            reason = str(error)
    if len(data) > most:
        raise too_much("expansion", "more", str(path))
    if not reason:
        return bytes(data), ()
    end = data.rfind(b"\n") + 1
    if not end:
        raise RunError(f"{path}: cannot be unpacked by gzip ({reason}); it may be cut off: copy it again")
    text = f"the packed file is cut off or damaged ({reason}); it was read up to there"
    return bytes(data[:end]), (Finding("cut_off", text),)


def _wide_encoding(start: bytes) -> str:
    """The encoding of a text in UTF-16, with or without a byte order mark; empty for any other."""
    if start.startswith((b"\xff\xfe", b"\xfe\xff")):
        return "utf-16"
    even, odd = start[::2], start[1::2]
    if len(start) < 8 or not (even.count(0) or odd.count(0)):
        return ""
    if odd.count(0) == len(odd) and not even.count(0):
        return "utf-16-le"
    return "utf-16-be" if even.count(0) == len(even) and not odd.count(0) else ""


def decoded(line: bytes) -> str | None:
    """Decodes a line as UTF-8, else as Windows-1252 (a degree sign in a header); None if it is not text."""
    if b"\0" in line:
        return None
    for encoding in ("utf-8-sig", "cp1252"):
        try:
            return line.decode(encoding).strip("\r\n")
        except UnicodeDecodeError:
            continue
    return None


@dataclass(frozen=True)
class Layout:
    """Layout of a file: lines before the rows, column names, delimiter, decimal mark and encoding."""

    before: int
    """Lines before the header."""
    header: list[str]
    delimiter: str
    point: str
    findings: tuple[Finding, ...]
    skipped: int = 0
    """Lines between the header and the rows, which name units."""
    encoding: str = "utf8"


@dataclass(frozen=True)
class _Candidate:
    """A delimiter and a header line."""

    delimiter: str
    line: int
    header: list[str]
    score: tuple[bool, int, float, int]


def find_layout(file: CsvFile, wanted: Sequence[str]) -> Layout:
    """Finds the layout; raises RunError if the file is no text, is empty, or has no header."""
    path = file.path
    read = [decoded(line) for line in file.first_lines()]
    lines = [line or "" for line in read]
    rest = file.other_lines()
    best = max((_candidate(lines, rest, mark, wanted) for mark in _DELIMITERS), key=lambda one: one.score)
    if read[0] is None:  # binary: no header can follow
        raise RunError(f"{path}: the first line is not text; wanted a CSV file in UTF-8 with a header line")
    if not any(best.header):
        raise RunError(f"{path}: the first line is empty; wanted a header line with the columns' names")
    if not _matched(best.header, wanted) and all(_NUMBER.fullmatch(cell) or DATE.match(cell) for cell in best.header):
        raise RunError(
            f"{path}: has no header: line {best.line + 1} holds numbers; write a first line with the columns' names"
        )
    if best.delimiter == _BLANKS:
        file.columns_of_blanks()
    rows = [*lines[best.line + 1 :], *rest]
    cells = [_cells(row, best.delimiter) for row in rows]
    header = _header_for(best.header, cells)
    findings = [_comment_finding(best.line)] if best.line else []
    skipped = _units_line(cells[0] if cells else [], header, wanted)
    if skipped:
        text = f"line {best.line + 2} names units ({', '.join(filter(None, cells[0]))[:80]}) and was ignored; "
        findings.append(Finding("comment_lines", text + "units other than SI need a column map"))
    point = _decimal_mark(cells, header, best.delimiter, wanted)
    if point == ",":
        findings.append(decimal_comma_finding())
    elif best.delimiter == "," and _twice_as_many(lines[best.line + 1 :], len(header)):
        raise RunError(
            f"{path}: rows have twice as many cells as the header's {len(header)}: decimal commas in a file "
            "separated by commas; save it with decimal points, or with semicolons between the cells"
        )
    delimiter = "\t" if best.delimiter == _BLANKS else best.delimiter
    return Layout(best.line, header, delimiter, point, (*file.findings, *findings), int(skipped))


def decimal_comma_finding() -> Finding:
    """The finding for numbers with decimal commas."""
    text = "numbers have decimal commas and were read so; other programs may want decimal points"
    return Finding("decimal_comma", text)


def _comment_finding(before: int) -> Finding:
    notice = f"{before} {'line' if before == 1 else 'lines'} before the header were ignored as comments"
    return Finding("comment_lines", f"{notice}; the header is line {before + 1}", before)


def _candidate(lines: Sequence[str], rest: Sequence[str], delimiter: str, wanted: Sequence[str]) -> _Candidate:
    """The best header for a delimiter: the first line with most of the wanted names, else the first non-comment."""
    headers = [_cells(_bare(line), delimiter) for line in lines]
    matched = [_matched(header, wanted) for header in headers]
    number = matched.index(max(matched)) if any(matched) else _probable_header(lines, headers)
    header = headers[number]
    rows = [_cells(row, delimiter) for row in (*lines[number + 1 :], *rest) if row.strip()]
    fitting = sum(len(row) in (len(header), len(header) + 1) for row in rows) / max(1, len(rows))
    width = len(header) if delimiter != _BLANKS else 1  # blanks only where nothing else separates
    # "t [s],speed [m/s]" split at its blanks has a column t as well, but its rows do not fit
    fits = delimiter != _BLANKS or fitting >= _MIN_FITTING
    return _Candidate(delimiter, number, header, (fits, matched[number], round(fitting, 1), width))


def _probable_header(lines: Sequence[str], headers: Sequence[list[str]]) -> int:
    """The first line that is no comment and as long as most; a comment in front of numbers if it is as long."""
    plain = [number for number, line in enumerate(lines) if line.strip() and not line.startswith(COMMENTS)]
    if not plain:
        return 0
    usual = Counter(len(headers[number]) for number in plain).most_common(1)[0][0]
    first = next(number for number in plain if len(headers[number]) in (usual, usual - 1, usual + 1))
    if first and all(_NUMBER.fullmatch(cell) for cell in headers[first]):
        comment = next((n for n in range(first - 1, -1, -1) if lines[n].startswith(COMMENTS)), None)
        if comment is not None and len(headers[comment]) == len(headers[first]):
            return comment
    return first


def _bare(line: str) -> str:
    return line.lstrip("".join(COMMENTS)).strip() if line.startswith(COMMENTS) else line


def _cells(line: str, delimiter: str) -> list[str]:
    if delimiter == _BLANKS:
        return line.split()
    try:
        found = next(csv.reader([line], delimiter=delimiter, skipinitialspace=True), [])
    except csv.Error:
        found = line.split(delimiter)
    return [cell.strip() for cell in found]


def _matched(header: Sequence[str], wanted: Sequence[str]) -> int:
    names = {name.strip() for name in wanted}
    return sum(name in header or element_of(name, header) is not None for name in names)


def _header_for(header: list[str], rows: Sequence[list[str]]) -> list[str]:
    """The header with as many cells as the rows, if they differ by an empty cell at the end."""
    longer = sum(len(row) == len(header) + 1 and not row[-1] for row in rows)
    shorter = sum(len(row) == len(header) - 1 for row in rows)
    same = sum(len(row) == len(header) for row in rows)
    if longer > same:
        return [*header, ""]
    return header[:-1] if not header[-1] and shorter > same else header


def _units_line(cells: Sequence[str], header: Sequence[str], wanted: Sequence[str]) -> bool:
    """Whether the line after the header has a word in place of each wanted number."""
    used = [cells[place] for place, name in enumerate(header) if name in wanted and place < len(cells)]
    if len(cells) != len(header) or len(used) < 2 or not all(used) or not numbers_of_texts(used, ".").bad:
        return False
    return all(len(cell) <= _MAX_UNIT and not any(sign.isdigit() for sign in cell.rstrip("23)]")) for cell in used)


def _decimal_mark(rows: Sequence[list[str]], header: Sequence[str], delimiter: str, wanted: Sequence[str]) -> str:
    """A comma if cells of the wanted columns look like 1,5 and none like 1.5. Other columns may hold dates."""
    used = [place for place, name in enumerate(header) if name in wanted]
    # a row with fewer cells than the header is malformed: commas in it may separate cells
    cells = [row[place] for row in rows if len(row) == len(header) for place in used]
    text = " ".join(cell for cell in cells if not DATE.match(cell) and not cell.startswith("["))
    return "," if re.search(r"\d,\d", text) and not re.search(r"\d\.\d", text) else "."


def _twice_as_many(rows: Sequence[str], cells: int) -> bool:
    """Whether every row has twice as many cells as the header, all whole numbers: 0,05,1,25 for 0.05 and 1.25."""
    filled = [row for row in rows if row.strip()][:-1]  # the last one may be cut off
    numbers = all(re.fullmatch(r"[-+\d, ]+", row) for row in filled)
    return bool(filled) and numbers and all(row.count(",") + 1 == 2 * cells for row in filled)
