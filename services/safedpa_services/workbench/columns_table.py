"""The form of a column map: one line of controls for each quantity, with the first values of the chosen column."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

from nicegui import ui

from safedpa_services.workbench.column_form import DERIVED, Line, units_for
from safedpa_services.workbench.elements import named, text
from safedpa_services.workbench.file_preview import RawRows

__all__ = ["ColumnsTable"]


class ColumnsTable:
    """Source, unit, scale, offset and sign of every quantity; tells when one of them was changed."""

    def __init__(self, on_change: Callable[[], None]) -> None:
        self._on_change = on_change
        self.lines: list[Line] = []
        self._raw = RawRows((), ())
        self._grid = ui.element("div").classes("map-grid")

    def show(self, lines: list[Line], raw: RawRows) -> None:
        """Draws the form anew."""
        self.lines, self._raw = list(lines), raw
        self._grid.clear()
        if not lines:
            return
        with self._grid:
            for title in ("quantity", "column of the file", "its unit", "times", "plus [SI]", "flip", "first values"):
                text(title, "head")
            for index, line in enumerate(lines):
                self._line(index, line)

    def _line(self, index: int, line: Line) -> None:
        text(f"{line.target} [{line.si}]")
        columns = [*([DERIVED] if line.derivation or line.source == DERIVED else []), *self._raw.names]
        if line.source and line.source not in columns:
            columns.append(line.source)
        self._choice(index, "source", columns, line.source or None, f"column for {line.target}")
        units = units_for(line.si)
        self._choice(index, "unit", units, line.unit or line.si, f"unit of {line.target}")
        self._number(index, "scale", line.scale, f"factor of {line.target}")
        self._number(index, "offset", line.offset, f"offset of {line.target}")
        box = ui.checkbox(value=line.flip, on_change=lambda e: self._changed(index, "flip", bool(e.value)))
        box.props(f'dense aria-label="flip the sign of {line.target}"')
        text(self._first_values(line.source), "quiet one-line")

    def _choice(self, index: int, field: str, options: list[str], value: str | None, title: str) -> None:
        known = value if value in options else None
        box = ui.select(options, value=known, on_change=lambda e: self._changed(index, field, str(e.value or "")))
        named(box.props("dense outlined options-dense").classes("flat"), title)

    def _number(self, index: int, field: str, value: float, title: str) -> None:
        box = ui.number(value=value, on_change=lambda e: self._changed(index, field, e.value))
        named(box.props("dense outlined debounce=400").classes("flat"), title)

    def _changed(self, index: int, field: str, value: Any) -> None:
        if value is None:
            return
        change: dict[str, Any] = {field: float(value) if field in ("scale", "offset") else value}
        if field == "source":
            change["kept"] = None
        self.lines[index] = replace(self.lines[index], **change)
        if field == "source":
            self.show(self.lines, self._raw)
        self._on_change()

    def _first_values(self, source: str) -> str:
        if source not in self._raw.names:
            return ""
        at = self._raw.names.index(source)
        return ", ".join(row[at][:9] for row in self._raw.rows[:3] if at < len(row))
