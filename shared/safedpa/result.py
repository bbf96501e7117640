"""What results have in common: one line in a cell, and the same facts as a table, a document, a page and a plot."""

from __future__ import annotations

import html
import io
from abc import ABC, abstractmethod
from base64 import b64encode
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, TypeVar, final, overload

from safedpa.extras import need_module
from safedpa.limits import readable

if TYPE_CHECKING:
    import pandas
    import pyarrow
    from matplotlib.figure import Figure

__all__ = ["AbstractPlottedResult", "AbstractResult", "Plot", "Rows", "one_line"]

Row = TypeVar("Row")

_LONGEST_LINE = 370
"""Characters of a result in a cell, before a note that it was cut: at most 400 in all."""
_LONGEST_FACT = 120
"""Characters of one fact of a result in a cell."""
_PAGE_ROWS = 1000
"""Rows of the table on a page; ``to_dataframe`` and ``to_arrow`` have all of them."""
_CELL_ROWS = 20
"""Rows of a table in a cell."""
_STYLE = "body{font-family:sans-serif;margin:2em} td,th{text-align:left;padding:2px 12px 2px 0;vertical-align:top}"


def one_line(kind: str, facts: Mapping[str, object]) -> str:
    """Returns ``Kind(name=value, ...)`` in one line of at most 400 characters, without control characters."""
    parts = (f"{name}={readable(str(value), _LONGEST_FACT)}" for name, value in facts.items())
    return readable(f"{kind}({', '.join(parts)})", _LONGEST_LINE)


@final
class Plot:
    """A drawn figure: a notebook shows it, ``save`` writes it, ``figure`` is the figure of matplotlib.

    Example:

        >>> plot = safedpa.read_log("log.csv", "pendulum").plot()
        >>> plot, plot.save("log.png").name
        (Plot(title=Run), 'log.png')
    """

    def __init__(self, figure: Figure, title: str) -> None:
        self.figure, self.title = figure, title

    def save(self, path: str | Path) -> Path:
        """Writes the figure; the ending of the name chooses the format: .png, .svg or .pdf."""
        self.figure.savefig(path)
        return Path(path)

    def __repr__(self) -> str:
        return one_line("Plot", {"title": self.title})

    def _repr_png_(self) -> bytes:
        written = io.BytesIO()
        self.figure.savefig(written, format="png")
        return written.getvalue()


class AbstractResult(ABC):
    """A result of the Python API.

    Printed, it is one line of at most 400 characters; a notebook shows the same facts as a table. ``to_dict`` is the
    document that the command prints with ``--json``.
    """

    @abstractmethod
    def to_dict(self) -> dict[str, Any]:
        """Returns the result as plain data for JSON: the document of the command's ``--json``."""

    @abstractmethod
    def _facts(self) -> dict[str, object]:
        """Returns what a cell shows, by name."""

    @abstractmethod
    def _columns(self) -> dict[str, Sequence[Any]]:
        """Returns the columns of the result's table; numbers, strings or None."""

    def __repr__(self) -> str:
        return one_line(type(self).__name__, self._facts())

    def _repr_html_(self) -> str:
        facts = [(name, readable(str(value), _LONGEST_FACT)) for name, value in self._facts().items()]
        rows = "".join(f"<tr><th>{html.escape(name)}</th><td>{html.escape(text)}</td></tr>" for name, text in facts)
        return f"<table><caption>{type(self).__name__}</caption>{rows}</table>"

    def to_dataframe(self) -> pandas.DataFrame:
        """Returns the result's table as a pandas DataFrame. Raises MissingExtraError without pandas."""
        need_module("pandas", "to_dataframe()")
        import pandas

        return pandas.DataFrame({name: list(values) for name, values in self._columns().items()})

    def to_arrow(self) -> pyarrow.Table:
        """Returns the result's table as an Arrow table. Raises MissingExtraError without pyarrow."""
        need_module("pyarrow", "to_arrow()")
        import pyarrow

        return pyarrow.table({name: pyarrow.array(list(values)) for name, values in self._columns().items()})

    def __arrow_c_stream__(self, requested_schema: object = None) -> object:
        """Lets other libraries read the table without a copy, as in ``polars.DataFrame(result)``."""
        return self.to_arrow().__arrow_c_stream__(requested_schema)

    def to_html(self, path: str | Path) -> Path:
        """Writes the result as one HTML page, readable offline, and returns its path."""
        written = Path(path)
        written.write_text(self._page(), encoding="utf-8")
        return written

    def _page(self) -> str:
        title = html.escape(type(self).__name__)
        return (
            f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{title}</title>'
            f"<style>{_STYLE}</style></head><body><h1>{title}</h1>{self._repr_html_()}{self._picture()}"
            f"{_table(self._columns(), _PAGE_ROWS, _LONGEST_LINE)}</body></html>\n"
        )

    def _picture(self) -> str:
        return ""


class AbstractPlottedResult(AbstractResult):
    """A result that can be drawn."""

    @abstractmethod
    def _draw(self, figure: Figure) -> None:
        """Draws the result on an empty figure."""

    def plot(self) -> Plot:
        """Draws the result with matplotlib; a notebook shows it. Raises MissingExtraError without matplotlib."""
        need_module("matplotlib", "plot()")
        from matplotlib.figure import Figure

        # Not pyplot: its figures stay in memory until they are closed, and a notebook shows them twice.
        figure = Figure(figsize=(9.0, 3.6), layout="constrained", dpi=100)
        self._draw(figure)
        return Plot(figure, type(self).__name__)

    def _picture(self) -> str:
        picture = b64encode(self.plot()._repr_png_()).decode("ascii")
        return f'<img alt="" src="data:image/png;base64,{picture}">'


@final
class Rows(AbstractResult, Sequence[Row], Generic[Row]):
    """A sequence of data classes or dictionaries that is shown as a table, such as the candidates of a diagnosis.

    Its table has a column for each field; those of nested tables are named as in ``per_state.speed``.

    Example:

        >>> runs = safedpa.compare("frictionless.toml", "log.csv").runs
        >>> len(runs), runs[0].name, runs.to_dataframe()["rows"].tolist()
        (1, 'log', [600])
    """

    def __init__(self, title: str, rows: Sequence[Row]) -> None:
        self.title, self._rows = title, tuple(rows)

    @overload
    def __getitem__(self, index: int) -> Row: ...

    @overload
    def __getitem__(self, index: slice) -> tuple[Row, ...]: ...

    def __getitem__(self, index: int | slice) -> Row | tuple[Row, ...]:
        return self._rows[index]

    def __len__(self) -> int:
        return len(self._rows)

    def to_dict(self) -> dict[str, Any]:
        """Returns the rows as dictionaries, under their title."""
        return {self.title: [_as_dict(row) for row in self._rows]}

    def _facts(self) -> dict[str, object]:
        return {"title": self.title, "rows": len(self), "columns": ", ".join(self._columns())}

    def _columns(self) -> dict[str, Sequence[Any]]:
        flat = [_flat(_as_dict(row)) for row in self._rows]
        return {name: [row.get(name) for row in flat] for name in dict.fromkeys(key for row in flat for key in row)}

    def _repr_html_(self) -> str:
        return _table(self._columns(), _CELL_ROWS, _LONGEST_FACT)


def _as_dict(row: Any) -> dict[str, Any]:
    return dict(row) if isinstance(row, Mapping) else asdict(row)


def _flat(row: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Returns nested tables as columns such as ``per_state.speed``, and lists as text."""
    found: dict[str, Any] = {}
    for name, value in row.items():
        if isinstance(value, Mapping):
            found |= _flat(value, f"{prefix}{name}.")
        else:
            found[prefix + name] = ", ".join(map(str, value)) if isinstance(value, (list, tuple)) else value
    return found


def _table(columns: Mapping[str, Sequence[Any]], most: int, longest: int) -> str:
    head = "".join(f"<th>{html.escape(name)}</th>" for name in columns)
    rows = list(zip(*(list(values)[:most] for values in columns.values()), strict=True))
    cells = "".join("<tr>" + "".join(f"<td>{_cell(item, longest)}</td>" for item in row) + "</tr>" for row in rows)
    return f"<table><tr>{head}</tr>{cells}</table>"


def _cell(value: Any, longest: int) -> str:
    text = "" if value is None else f"{value:.6g}" if isinstance(value, float) else str(value)
    return html.escape(readable(text, longest))
