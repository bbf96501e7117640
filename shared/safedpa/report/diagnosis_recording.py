"""A diagnosis as a Rerun recording: measured and predicted trajectories, stage by stage on the time line."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.comparison.excerpt import first_seconds
from safedpa.comparison.rollout import rollout
from safedpa.comparison.where import PLACE
from safedpa.comparison.windows import Windows, windows_of
from safedpa.dynamics import PhysicsModel
from safedpa.errors import InputError, RecordingError
from safedpa.records.run import Run
from safedpa.report.diagnosis_story import number, report_text, step_text

__all__ = ["write_recording"]

_MOST_SECONDS = 60.0
"""s of the run that is played in each stage, and of each run that is drawn in the plane."""
_MOST_RUNS = 6
_PAUSE = 2.0
"""s between two stages."""
_TIME_LINE = "t"
_MEASURED = 0xC8C8C8FF
_BEFORE, _AFTER = 0xE8803CFF, 0x4AA8E8FF
_ROBOT = 0xFFFFFFFF


def write_recording(
    document: Mapping[str, Any], runs: Sequence[Run], models: Sequence[PhysicsModel], folder: Path
) -> Path:
    """Writes ``diagnosis.rrd`` into a folder that exists; returns its path.

    The time line plays the first minute of the first run once for every stage, the given model first: each state as a
    curve, measured and predicted (open loop, restarted after every horizon), and all runs in the plane. Raises
    RecordingError when it cannot be written.
    """
    import rerun as rr

    path = folder / "diagnosis.rrd"
    windows = _back_to_back(runs, float(document.get("horizon", 1.0)))
    stream = rr.RecordingStream("safedpa diagnosis")
    try:
        stream.set_sinks(rr.FileSink(path))
    except (RuntimeError, ValueError, OSError) as error:
        raise RecordingError(f"{path}: cannot be written ({error}); choose another folder with --out") from error
    stream.send_blueprint(_blueprint(windows))
    begin = 0.0
    for index, model in enumerate(models):
        stage = _Stage(index, begin, document["stages"][index], windows, rollout(model, windows))
        stream.set_time(_TIME_LINE, duration=begin)
        stream.log("story", rr.TextDocument(_text(document, index), media_type=rr.MediaType.MARKDOWN))
        begin = stage.log(stream) + _PAUSE
    _name_curves(stream, windows)
    stream.flush(timeout_sec=10.0)
    return path


def _back_to_back(runs: Sequence[Run], horizon: float) -> Windows:
    """Windows of one horizon, each beginning where the last one ended, over the first minute of the first runs."""
    try:
        every = windows_of(first_seconds(runs[:_MOST_RUNS], _MOST_SECONDS), horizon, stride=1)
    except InputError:  # no stretch of a whole horizon so early: then from wherever there is one
        every = windows_of(runs, horizon, stride=1)
    retained, free = [], -1
    for index in np.argsort(every.start, kind="stable"):
        if every.start[index] >= free:
            retained.append(int(index))
            free = int(every.end[index])
    return every.select(np.array(retained, dtype=np.int64))


@dataclass(frozen=True)
class _Stage:
    number: int
    begin: float
    """s on the time line."""
    entry: Mapping[str, Any]
    windows: Windows
    predicted: FloatArray
    """(steps + 1, windows, states)"""

    def log(self, stream: Any) -> float:
        """Draws the stage; returns where it ends on the time line [s]."""
        names = self.windows.system.state_names
        if set(PLACE) <= set(names):
            self._log_plane(stream, [names.index(name) for name in PLACE])
        return self._log_curves(stream)

    def _log_plane(self, stream: Any, place: list[int]) -> None:
        import rerun as rr

        windows = self.windows
        pairs = list(zip(windows.start.tolist(), windows.end.tolist(), windows.steps.tolist(), strict=True))
        measured = [_flat(windows.states[start : end + 1, place]) for start, end, _ in pairs]
        predicted = [_flat(self.predicted[: steps + 1, index, place]) for index, (_, _, steps) in enumerate(pairs)]
        predicted = [strip[np.isfinite(strip).all(axis=1)] for strip in predicted]
        colour = _BEFORE if self.number == 0 else _AFTER
        stream.log("plane/measured", rr.LineStrips2D(measured, colors=np.uint32(_MEASURED), radii=0.012))
        stream.log("plane/predicted", rr.LineStrips2D(predicted, colors=np.uint32(colour), radii=0.02))

    def _log_curves(self, stream: Any) -> float:
        import rerun as rr

        windows, first = self.windows, np.flatnonzero(self.windows.run == self.windows.run[0])
        rows = [np.arange(windows.start[i], windows.end[i] + 1) for i in first]
        at = np.concatenate(rows)
        predicted = np.concatenate([self.predicted[: len(part), i] for i, part in zip(first, rows, strict=True)])
        seconds = self.begin + windows.time[at] - windows.time[at[0]]
        time = rr.TimeColumn(_TIME_LINE, duration=seconds)
        kind = "given" if self.number == 0 else "improved"
        for index, state in enumerate(windows.system.state):
            turns = 2.0 * np.pi * np.round((predicted[:, index] - windows.states[at, index]) / (2.0 * np.pi))
            shown = predicted[:, index] - (turns if state.angle else 0.0)
            for name, values in (("measured", windows.states[at, index]), (kind, shown)):
                stream.send_columns(f"states/{state.name}/{name}", [time], rr.Scalars.columns(scalars=values))
        if set(PLACE) <= set(windows.system.state_names):
            place = [windows.system.state_names.index(name) for name in PLACE]
            points = _flat(windows.states[at][:, place]).astype(np.float32)
            stream.send_columns("plane/robot", [time], rr.Points2D.columns(positions=points))
        errors = np.full(2, number(self.entry["heldout_error"]))
        ends = rr.TimeColumn(_TIME_LINE, duration=[self.begin, float(seconds[-1])])
        stream.send_columns("error", [ends], rr.Scalars.columns(scalars=errors))
        return float(seconds[-1])


def _flat(points: FloatArray) -> FloatArray:
    """The viewer counts y downwards."""
    return np.asarray(points * np.array([1.0, -1.0]))


def _text(document: Mapping[str, Any], index: int) -> str:
    stage, story = document["stages"][index], report_text(document)
    title = step_text(document["stages"][index - 1] if index else None, stage)
    lines = [f"# {title}", f"held-out error **{number(stage['heldout_error']):.3g}**", ""]
    for found in [item for item in story.found if item.effect in stage["effects"]]:
        parameters = [f"{name} {value} ± {spread} {unit}" for name, value, spread, unit in found.parameters]
        lines.append(f"- {found.effect}: {', '.join(parameters)}")
    return "\n".join([*lines, "", story.lead, "", story.remains])


def _name_curves(stream: Any, windows: Windows) -> None:
    import rerun as rr

    styles = {"measured": (_MEASURED, 1.5), "given": (_BEFORE, 2.0), "improved": (_AFTER, 2.0)}
    for state in windows.system.state:
        for kind, (colour, width) in styles.items():
            line = rr.SeriesLines(names=kind, colors=np.uint32(colour), widths=width)
            stream.log(f"states/{state.name}/{kind}", line, static=True)
    stream.log("error", rr.SeriesLines(names="held-out error", colors=np.uint32(_AFTER), widths=3.0), static=True)
    stream.log("plane/robot", rr.Points2D.from_fields(colors=[_ROBOT], radii=[0.07]), static=True)


def _blueprint(windows: Windows) -> Any:
    import rerun.blueprint as rrb

    corner = rrb.PlotLegend(rrb.Corner2D.LeftTop)
    curves = [
        rrb.TimeSeriesView(origin=f"/states/{state.name}", name=f"{state.name} [{state.unit}]", plot_legend=corner)
        for state in windows.system.state
    ]
    error = rrb.TimeSeriesView(origin="/error", name="held-out error, stage after stage")
    phrase = rrb.TextDocumentView(origin="/story", name="stage")
    left: list[Any] = [rrb.Horizontal(phrase, error)]
    if set(PLACE) <= set(windows.system.state_names):
        left.append(rrb.Spatial2DView(origin="/plane", name="all runs from above [m]", background=[24, 26, 30]))
    return rrb.Blueprint(
        rrb.Horizontal(rrb.Vertical(*left, row_shares=[1, 2][: len(left)]), rrb.Vertical(*curves)),
        rrb.BlueprintPanel(state="hidden"),
        rrb.SelectionPanel(state="hidden"),
        rrb.TimePanel(state="collapsed", timeline=_TIME_LINE),
        auto_views=False,
    )
