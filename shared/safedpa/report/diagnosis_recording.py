"""Writes a diagnosis as a Rerun recording: measured and predicted trajectories, one stage after the other."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.comparison.excerpt import first_seconds
from safedpa.comparison.rollout import rollout
from safedpa.comparison.where import POSITION
from safedpa.comparison.windows import Windows, windows_of
from safedpa.dynamics import PhysicsModel
from safedpa.errors import InputError, RecordingError
from safedpa.records.run import Run
from safedpa.report.diagnosis_story import number, report_text, step_text

# Length [s] of the run that is played in each stage, and of each run drawn in the plane: a viewer watches no more.
_MAX_SECONDS = 60.0
# More paths would cover each other.
_MAX_RUNS = 6
# Pause between two stages [s].
_PAUSE = 2.0
_TIME_LINE = "t"
_MEASURED = 0xC8C8C8FF
_BEFORE, _AFTER = 0xE8803CFF, 0x4AA8E8FF
_ROBOT = 0xFFFFFFFF


def write_recording(
    document: Mapping[str, Any], runs: Sequence[Run], models: Sequence[PhysicsModel], folder: Path
) -> Path:
    """Writes ``diagnosis.rrd`` into an existing folder and returns its path.

    The timeline plays the first minute of the first run once per stage, the given model first. Each state is a curve,
    measured and predicted (open loop, restarted after every horizon); all runs are drawn in the plane. Raises
    RecordingError if the file cannot be written.
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
    """Returns consecutive windows of one horizon over the first minute of the first runs."""
    try:
        every = windows_of(first_seconds(runs[:_MAX_RUNS], _MAX_SECONDS), horizon, stride=1)
    except InputError:  # no stretch of a whole horizon in the first minute: use the whole runs
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
    """Start on the timeline [s]."""
    entry: Mapping[str, Any]
    windows: Windows
    predicted: FloatArray
    """Predicted states, (steps + 1, windows, states)."""

    def log(self, stream: Any) -> float:
        """Draws the stage and returns its end on the timeline [s]."""
        names = self.windows.system.state_names
        if set(POSITION) <= set(names):
            self._log_plane(stream, [names.index(name) for name in POSITION])
        return self._log_curves(stream)

    def _log_plane(self, stream: Any, position: list[int]) -> None:
        import rerun as rr

        windows = self.windows
        pairs = list(zip(windows.start.tolist(), windows.end.tolist(), windows.steps.tolist(), strict=True))
        measured = [_flat(windows.states[start : end + 1, position]) for start, end, _ in pairs]
        predicted = [_flat(self.predicted[: steps + 1, index, position]) for index, (_, _, steps) in enumerate(pairs)]
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
        if set(POSITION) <= set(windows.system.state_names):
            position = [windows.system.state_names.index(name) for name in POSITION]
            points = _flat(windows.states[at][:, position]).astype(np.float32)
            stream.send_columns("plane/robot", [time], rr.Points2D.columns(positions=points))
        errors = np.full(2, number(self.entry["heldout_error"]))
        ends = rr.TimeColumn(_TIME_LINE, duration=[self.begin, float(seconds[-1])])
        stream.send_columns("error", [ends], rr.Scalars.columns(scalars=errors))
        return float(seconds[-1])


def _flat(points: FloatArray) -> FloatArray:
    """Flips y, which the viewer draws downwards."""
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
    error = rrb.TimeSeriesView(origin="/error", name="held-out error by stage")
    phrase = rrb.TextDocumentView(origin="/story", name="stage")
    left: list[Any] = [rrb.Horizontal(phrase, error)]
    if set(POSITION) <= set(windows.system.state_names):
        left.append(rrb.Spatial2DView(origin="/plane", name="all runs from above [m]", background=[24, 26, 30]))
    return rrb.Blueprint(
        rrb.Horizontal(rrb.Vertical(*left, row_shares=[1, 2][: len(left)]), rrb.Vertical(*curves)),
        rrb.BlueprintPanel(state="hidden"),
        rrb.SelectionPanel(state="hidden"),
        rrb.TimePanel(state="collapsed", timeline=_TIME_LINE),
        auto_views=False,
    )
