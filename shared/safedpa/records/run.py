"""A recorded run: time, states and actions of one robot, cut into stretches without defects."""

from __future__ import annotations

import importlib
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from safedpa.result import AbstractPlottedResult
from safedpa.systems import System

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["Finding", "RawRows", "Run", "Stretch"]


@dataclass(frozen=True)
class RawRows:
    """t (rows,), states (rows, states) and actions (rows, actions) of a log, before its quality was checked."""

    t: NDArray[np.float64]
    states: NDArray[np.float64]
    actions: NDArray[np.float64]
    segment: NDArray[np.intp] | None = None
    """Segment of each row, between which a clock was set, (rows,); None: a segment ends where t goes back."""

    def taken(self, index: NDArray[np.intp] | NDArray[np.bool_]) -> RawRows:
        """Some of the rows."""
        segment = None if self.segment is None else self.segment[index]
        return RawRows(self.t[index], self.states[index], self.actions[index], segment)

    def breaks(self) -> NDArray[np.bool_]:
        """Rows that begin a segment, but the first one, (rows,)."""
        steps = np.diff(self.t) < 0.0 if self.segment is None else np.diff(self.segment) != 0
        return np.append(False, steps)[: len(self.t)]


@dataclass(frozen=True)
class Finding:
    """A fact about the quality of the data that the user should know."""

    kind: str
    """Such as gap, repeated_row, not_a_number, clock_reset, jump, constant_input."""
    message: str
    """A sentence: what was found, how often, where first, and what was done about it."""
    count: int = 1
    start_t: float | None = None
    """Time of the first occurrence, s."""

    def accepted_in(self, keep: Sequence[str]) -> Finding:
        """Returns it as one that a map accepts if its kind is in ``keep``: it then forbids no diagnosis."""
        if self.kind not in keep:
            return self
        text = f"{self.message.split('; ')[0]}; kept, as the map says"
        return replace(self, kind=f"kept_{self.kind}", message=text)


@dataclass(frozen=True)
class Stretch:
    """Rows ``start`` to ``stop`` (exclusive) of a run, without a gap, jump or missing value."""

    start: int
    stop: int

    def __len__(self) -> int:
        return self.stop - self.start


@dataclass(frozen=True, repr=False)
class Run(AbstractPlottedResult):
    """One recording, in SI units and radians, angles unwrapped.

    ``name`` is that of its source, ``system`` names the states and actions with their units. ``t`` (samples,) [s] grows
    strictly within each stretch; ``states`` (samples, states); ``actions`` (samples, actions), where the action of a
    row is applied until the next row. ``stretches`` are the rows between defects: defective rows are removed; do not
    compute across the border of two stretches. ``findings`` say what was found in the data; ``keep`` has the kinds
    of them that the column map accepts. Time is that of the source, possibly seconds since 1970: compute differences in
    float64.

    Example:

        >>> t = np.arange(0.0, 5.0, 0.05)
        >>> run = safedpa.Run.from_arrays(t, np.stack([np.sin(t), np.cos(t)], axis=1), np.cos(t)[:, None], "pendulum")
        >>> run
        Run(name=arrays, robot=pendulum, rows=100, duration=4.95 s, period=0.05 s, stretches=1, findings=1)
    """

    name: str
    system: System
    t: NDArray[np.float64]
    states: NDArray[np.float64]
    actions: NDArray[np.float64]
    stretches: tuple[Stretch, ...]
    findings: tuple[Finding, ...] = ()
    keep: tuple[str, ...] = ()

    @classmethod
    def from_arrays(
        cls, t: ArrayLike, states: ArrayLike, actions: ArrayLike, system: Any, *, name: str = "arrays"
    ) -> Run:
        """Makes a run of arrays in SI units, with the checks of a file.

        t (samples,) [s], states (samples, states), actions (samples, actions), in the order of ``system``: a system, a
        model, or the name of a robot. Raises RunError for other shapes, or if no stretch is usable.
        """
        made: Run = _in_memory().run_of_arrays(t, states, actions, system, name)
        return made

    @classmethod
    def from_dataframe(cls, frame: Any, system: Any, columns: Any = None, *, name: str = "dataframe") -> Run:
        """Makes a run of a pandas or polars DataFrame, an Arrow table or a dictionary of columns.

        Without ``columns`` the frame has the native names: ``t`` and the states and actions of ``system`` (a system, a
        model, or the name of a robot). ``columns`` is a column map (a file, a shipped name, a ``ColumnMap``) or a
        dictionary such as ``{"angle": {"from": "theta", "unit": "deg"}}`` with the columns that have another name. A
        column of dates becomes seconds since 1970. Raises RunError and ColumnMapError.

        Example:

            >>> import pandas
            >>> frame = pandas.read_csv("log.csv").rename(columns={"t": "time"})
            >>> safedpa.Run.from_dataframe(frame, "pendulum", {"t": "time"}).states.shape
            (600, 2)
        """
        made: Run = _in_memory().run_of_frame(frame, system, columns, name)
        return made

    @cached_property  # cached: used for each stretch, and a log can have thousands
    def period(self) -> float:
        """Median time between rows [s]."""
        steps = [np.diff(self.t[part.start : part.stop]) for part in self.stretches if len(part) > 1]
        return float(np.median(np.concatenate(steps))) if steps else float("nan")

    @property
    def duration(self) -> float:
        """Total duration of the stretches, s."""
        return float(sum(self.t[part.stop - 1] - self.t[part.start] for part in self.stretches if len(part)))

    def parts(self) -> Iterator[tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]]:
        """Yields (t, states, actions) of each stretch."""
        for part in self.stretches:
            rows = slice(part.start, part.stop)
            yield self.t[rows], self.states[rows], self.actions[rows]

    def to_dict(self) -> dict[str, Any]:
        """Returns what is known about the run, without its rows."""
        rows = sum(len(part) for part in self.stretches)
        return {
            "name": self.name,
            "robot": self.system.name,
            "rows": rows,
            "duration": self.duration,
            "period": self.period,
            "stretches": len(self.stretches),
            "findings": [asdict(finding) for finding in self.findings],
        }

    def _facts(self) -> dict[str, object]:
        facts = {**self.to_dict(), "findings": len(self.findings)}
        return facts | {"duration": f"{self.duration:.4g} s", "period": f"{self.period:.4g} s"}

    def _columns(self) -> dict[str, Sequence[Any]]:
        names = (*self.system.state_names, *self.system.action_names)
        table = np.concatenate([self.states, self.actions], axis=1)
        return {"t": self.t.tolist(), **{name: table[:, at].tolist() for at, name in enumerate(names)}}

    def _draw(self, figure: Figure) -> None:
        variables = (*self.system.state, *self.system.action)
        panels = figure.subplots(-(-len(variables) // 3), 3, sharex=True, squeeze=False).ravel()
        for panel, variable, at in zip(panels, variables, range(len(variables)), strict=False):
            panel.set_title(f"{variable.name} [{variable.unit}]", fontsize="small")
            for t, states, actions in self.parts():
                panel.plot(t - self.t[0], np.concatenate([states, actions], axis=1)[:, at], color="#0072B2", lw=0.8)
        figure.supxlabel("time [s]", fontsize="small")


def _in_memory() -> Any:
    """Returns the module that checks rows; by its name, since it imports this one."""
    return importlib.import_module("safedpa.records.in_memory")
