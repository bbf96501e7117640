"""Writes what the page shows as a Rerun recording, and serves Rerun's web viewer for it."""

from __future__ import annotations

import asyncio
import secrets
import shutil
import tempfile
import urllib.parse
from pathlib import Path
from typing import Any

import numpy as np
from fastapi import Response
from fastapi.responses import FileResponse
from nicegui import app

from safedpa.arrays import FloatArray
from safedpa.comparison.rollout import rollout
from safedpa.comparison.where import POSITION
from safedpa.comparison.windows import Windows
from safedpa.errors import RecordingError
from safedpa_services.web.viewer import Viewer, viewer_file
from safedpa_services.workbench.session.session import Session

_SECONDS = 20.0
"""s of the recording that are written, from the chosen start on."""
_TIME_LINE = "t"
_COLOURS = ((216, 94, 0), (138, 148, 160), (0, 114, 178))
"""Colours of the given, intermediate and present version; from the colour-blind safe palette of Okabe and Ito."""
_MEASURED = (200, 200, 200)


_MIN_FREE_BYTES = 64 << 20
"""Free disk space that a view needs. A view has a few MB, and Rerun's file writer does not report a full disk."""


def write_view(session: Session, path: Path) -> None:
    """Writes the measured and predicted states of the chosen run to a Rerun recording.

    The prediction restarts from the measured state after each horizon. The time line is the time of the run; it begins
    at the chosen start. Raises RecordingError if the file cannot be written.
    """
    import rerun as rr
    import rerun.blueprint as rrb

    windows = _from_start(session)
    if shutil.disk_usage(path.parent).free < _MIN_FREE_BYTES:
        raise RecordingError(f"{path.parent}: cannot be written (the disk is full: free some space)")
    stream = rr.RecordingStream("safedpa workbench")
    try:
        stream.set_sinks(rr.FileSink(path))
    except (RuntimeError, ValueError, OSError) as error:
        raise RecordingError(f"{path}: cannot be written ({error}); choose another folder with --out") from error
    panels: list[Any] = [rrb.TimeSeriesView(origin=f"states/{v.name}", name=v.name) for v in windows.system.state]
    if set(POSITION) <= set(windows.system.state_names):
        panels.insert(0, rrb.Spatial2DView(origin="plane", name="plane"))
    time = rrb.TimePanel(timeline=_TIME_LINE, play_state="paused")
    around = rrb.SelectionPanel(state="collapsed"), rrb.BlueprintPanel(state="collapsed")
    stream.send_blueprint(rrb.Blueprint(rrb.Grid(*panels), time, *around))
    rows = [np.arange(start, end + 1) for start, end in zip(windows.start, windows.end, strict=True)]
    at = np.concatenate(rows)
    _log(stream, "measured", windows, windows.states[at], at, _MEASURED)
    for number, version in enumerate(session.versions):
        predicted = rollout(version.model, windows)
        states = np.concatenate([predicted[: len(part), index] for index, part in enumerate(rows)])
        colour = _COLOURS[2] if number == session.number else _COLOURS[min(number, 1)]
        _log(stream, version.label.replace("+", "with").replace(" ", "_"), windows, states, at, colour)
    stream.flush(timeout_sec=10.0)
    stream.disconnect()  # closes the file


def _from_start(session: Session) -> Windows:
    """Consecutive windows of one horizon, from the chosen start to the end of its stretch or for ``_SECONDS``."""
    windows = session.comparison.windows
    first = session.start
    begin, run = windows.begin[first], windows.run[first]
    selected = [first]
    for index in range(first + 1, len(windows)):
        same = windows.begin[index] == begin and windows.run[index] == run
        late = windows.time[windows.start[index]] - windows.time[windows.start[first]] > _SECONDS
        if same and not late and windows.start[index] >= windows.end[selected[-1]]:
            selected.append(index)
    return windows.select(np.array(selected, dtype=np.int64))


def _log(stream: Any, name: str, windows: Windows, states: FloatArray, at: Any, colour: tuple[int, int, int]) -> None:
    import rerun as rr

    time = rr.TimeColumn(_TIME_LINE, duration=windows.time[at])
    for index, state in enumerate(windows.system.state):
        path = f"states/{state.name}/{name}"
        stream.log(path, rr.SeriesLines(colors=[colour], names=[name], widths=[2.0]), static=True)
        stream.send_columns(path, [time], rr.Scalars.columns(scalars=states[:, index]))
    if set(POSITION) <= set(windows.system.state_names):
        place = [windows.system.state_names.index(key) for key in POSITION]
        points = states[:, place] * np.array([1.0, -1.0])  # y points down in the 2-D view
        ends = np.cumsum([step + 1 for step in windows.steps.tolist()])[:-1]
        stream.log(f"plane/{name}", rr.LineStrips2D(np.split(points, ends), colors=[colour], radii=0.02), static=True)
        dots = rr.Points2D.columns(positions=points, colors=[colour] * len(points), radii=[0.05] * len(points))
        stream.send_columns(f"plane/{name}/now", [time], dots)


class RerunViewerServer:
    """Serves Rerun's web viewer and the written recordings under this page's own address."""

    def __init__(self) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="safedpa-workbench-")
        self._viewer = Viewer()
        app.on_shutdown(self._folder.cleanup)
        app.get("/rerun/recordings/{name}", include_in_schema=False)(self._recording)
        app.get("/rerun/{name:path}", include_in_schema=False)(self._file)

    async def open(self, session: Session, origin: str) -> str:
        """Writes a recording of the session and returns the path at which the viewer shows it."""
        name = f"{secrets.token_hex(8)}.rrd"
        await asyncio.to_thread(write_view, session, Path(self._folder.name) / name)
        recording = urllib.parse.quote(f"{origin}/rerun/recordings/{name}", safe="")
        return f"/rerun/?url={recording}"

    async def _recording(self, name: str) -> Response:
        path = Path(self._folder.name) / Path(name).name
        return FileResponse(path) if path.is_file() else Response(status_code=404)

    async def _file(self, name: str) -> Response:
        return await viewer_file(self._viewer, name)
