"""Draws frames with Rerun, and arranges the panes of each robot. The only module that imports Rerun."""

from __future__ import annotations

import shutil
import time
from collections import deque
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from rerun.encodings import TimeRange

from safedpa.bus.logging import log_event
from safedpa.drawing import Discs, Lines, Rings
from safedpa.errors import InputError
from safedpa_services.dashboard.curves import legend_names
from safedpa_services.dashboard.display_settings import DisplaySettings
from safedpa_services.dashboard.fleet_view import Scene
from safedpa_services.dashboard.now_page import waiting_page
from safedpa_services.dashboard.shapes import (
    Bands,
    Curves,
    MarkdownPage,
    Note,
    Shape,
    States,
    StateSet,
    TimelineEntry,
    TimelineFrame,
)


def meaning(display: DisplaySettings) -> str:
    """Returns the Markdown page that explains the panes."""
    world = ((display.system.name, _PENDULUM), *_ANGLE) if display.is_pendulum else _WORLD
    return "\n\n".join(f"**{name}**: {text}" for name, text in (*world, *_PANES))


_WORLD = (
    (
        "world from above",
        "robot white, load pink, goal yellow, obstacles grey. Orange: the area that it needs to stop, and the rings "
        "which the centre line of that area must not cross. The trail has the colour of the verdict.",
    ),
    (
        "what its sensors see",
        "static objects grey, possibly moving ones red, pink rings where someone may be hidden; lines point to the "
        "objects that limit the action.",
    ),
)
_PENDULUM = "green: allowed angles, red: forbidden ones; the arrow is the estimated wind, its ring 5 m/s."
_ANGLE = (("angle and its rate", "inside the orange edge the filter can keep it in the corridor."),)
_PANES = (
    (
        "h",
        "the smallest barrier value, now and predicted for the next tick. Above 0: safe. The filter keeps "
        "it above the margin. A gap: the filter could not compute it.",
    ),
    ("action", "the policy's nominal action and the filtered action, between the actuator limits."),
    (
        "verdict",
        "filter: passed, corrected, relaxed (less than the margin), violated (outside), fallback (no decision), "
        "disabled, stopped. in_force: whose action the robot executes. diagnosis and model: stage, and number.",
    ),
    ("estimate", "the latent, estimated by the adaptation; the band is one standard deviation."),
    ("residual", "measured minus predicted state, one tick ahead. Near 0: the model is accurate."),
    ("error", "of predictions over 1 s. If it stays above its band, the diagnosis raises a finding."),
    ("time of a step", "computing time of each service for its last tick."),
    ("services", "ready, running, failing, or silent: no heartbeat for a second."),
)

APPLICATION = "safedpa"
SERVER_MEMORY = "8MB"
"""Data that a viewer which opens later gets: half a minute of three robots. The panes show 20 s."""
_FLUSH_SECONDS = 1.0
_BATCH_SECONDS = 0.4
"""Rows of one path are collected for this time [s] before they go to the viewers."""
_FILE_BATCH_SECONDS = 20.0
"""The same for the file: each batch of a path has a header of 1 kB, which with 5 s was half of the file. A kill or a
loss of power costs as much of the pictures; the recording of the bus loses half a second."""
_LOOK_SECONDS = 1.0


class RerunRecording:
    """A Rerun recording that goes to files, to viewers, or to both.

    The files and the viewers have a stream each, so that another file can begin while viewers stay connected. Raises
    InputError if the first file cannot be written or the port is taken.
    """

    def __init__(
        self,
        display: DisplaySettings,
        fleet: str,
        *,
        save: Path | None,
        bind: str,
        grpc_port: int | None,
        memory: str = SERVER_MEMORY,
        limits: FileLimits | None = None,
    ) -> None:
        self._display, self._fields = display, dict[str, Scene]()
        self._static: dict[tuple[str, ...], TimelineEntry] = {}
        """The newest static entry of each path, which every further file needs."""
        self._viewers: Any = None
        if grpc_port is not None:
            self._viewers = _stream(_BATCH_SECONDS)
            try:
                sink = rr.GrpcServerSink(bind, grpc_port, server_memory_limit=memory, newest_first=True)
                self._viewers.set_sinks(sink)
            except (RuntimeError, ValueError, OSError) as error:
                raise InputError(f"port {grpc_port}: {error}; choose another port") from error
        self._files = None if save is None else _Files(save, limits or FileLimits())
        self._log(TimelineEntry(("waiting",), waiting_page(fleet, {}), static=True))
        self._log(TimelineEntry(("meaning",), MarkdownPage(meaning(display)), static=True))
        self._shown = -1
        self.arrange({})

    @property
    def _streams(self) -> list[Any]:
        file = None if self._files is None else self._files.stream
        return [stream for stream in (self._viewers, file) if stream is not None]

    def arrange(self, fields: dict[str, Scene]) -> None:
        """Shows one tab per robot if there is a further one; replaces the arrangement made by the viewer's user."""
        if len(fields) == self._shown:
            return
        self._shown, self._fields = len(fields), dict(fields)
        for stream in self._streams:
            _arrange(stream, fields, self._display)

    def draw(self, frames: list[TimelineFrame]) -> None:
        """Sends the frames to the viewers and the file without waiting for them."""
        if self._files is not None and self._files.turn():
            for entry in self._static.values():
                _log(self._files.stream, entry, _archetype(entry.shape, 0.0, static=True))
            _arrange(self._files.stream, self._fields, self._display)
        for frame in frames:
            for stream in self._streams:
                stream.set_time(_TIME_LINE, duration=frame.at)
            for entry in frame.entries:
                self._log(entry, frame.at)

    def close(self) -> None:
        """Writes pending data, for at most one second."""
        for stream in self._streams:
            _close(stream)

    def _log(self, entry: TimelineEntry, at: float = 0.0) -> None:
        if entry.static:
            self._static[tuple(entry.path)] = entry
        archetype = _archetype(entry.shape, at, static=entry.static)
        if self._viewers is not None:
            _log(self._viewers, entry, archetype)
        if self._files is not None and self._files.stream is not None and self._files.takes(entry, at):
            _log(self._files.stream, entry, archetype)


@dataclass(frozen=True)
class FileLimits:
    """Limits of the files, which are a by-product: the recording of the bus comes first."""

    file_bytes: int = 64 << 20
    """A file that has grown to this size ends, and the next one begins."""
    files: int = 4
    """Files of this process that are kept; the oldest is removed when a further one begins."""
    interval: float = 0.0
    """Shortest time [s] on the time line between two rows of one curve or shape; changes and texts are all written."""
    free_bytes: int = 64 << 20
    """Free disk space below which no file is written; the recording and the logs need the rest."""


class _Files:
    """The files of one process: ``NAME.rrd``, ``NAME-2.rrd`` ...; a file that exists is never written to."""

    def __init__(self, save: Path, limits: FileLimits) -> None:
        self._save, self._limits = save, limits
        self._paths: deque[Path] = deque()
        self._number = 0
        """Number of the newest file."""
        self._written: dict[tuple[str, ...], float] = {}
        """By path: time of its newest row [s]."""
        self._next_look = 0.0
        self._is_stopped = False
        self.stream: Any = None
        """None while nothing is written."""
        if not save.parent.is_dir():
            raise InputError(f"recording {save}: its folder does not exist; choose another --save")
        if self._has_room():
            self._begin()

    def turn(self) -> bool:
        """Looks once a second whether another file has to begin; returns whether one has begun."""
        if time.monotonic() < self._next_look:
            return False
        self._next_look = time.monotonic() + _LOOK_SECONDS
        if not self._has_room():
            self._stop()
            return False
        with suppress(OSError):  # a file that the user removed: its stream goes on, unseen, until the next one
            if self.stream is not None and self._paths[-1].stat().st_size < self._limits.file_bytes:
                return False
        if self.stream is not None:
            _close(self.stream)
        with suppress(InputError):  # tried again after a second
            self._begin()
            return True
        return False

    def takes(self, entry: TimelineEntry, at: float) -> bool:
        """Whether an entry at time ``at`` [s] of the time line is written."""
        if entry.static or isinstance(entry.shape, States | Note | MarkdownPage) or entry.path[-1] == "trail":
            return True  # the trail consists of parts, each from the last one to the present
        key = tuple(entry.path)
        last = self._written.get(key)
        if last is not None and 0.0 <= at - last < 0.9 * self._limits.interval:
            return False
        self._written[key] = at
        return True

    def _begin(self) -> None:
        """Begins a file. Raises InputError if it cannot be written."""
        path, self._number = _free_path(self._save, self._number + 1)
        stream = _stream(_FILE_BATCH_SECONDS)
        try:
            stream.set_sinks(rr.FileSink(path, write_footer=False))  # without a footer it is complete at any time
        except (RuntimeError, ValueError, OSError) as error:
            raise InputError(f"recording {path}: {error}; choose another --save") from error
        if self._is_stopped:
            log_event("dashboard.file_resumed", f"the pictures go on in {path}", service="dashboard")
        self.stream, self._is_stopped = stream, False
        self._paths.append(path)
        while len(self._paths) > self._limits.files:
            with suppress(OSError):
                self._paths.popleft().unlink()

    def _has_room(self) -> bool:
        """Whether the disk has room, with some to spare before a stopped file begins again."""
        wanted = self._limits.free_bytes * (2 if self._is_stopped else 1)
        try:
            free = shutil.disk_usage(self._save.parent).free
        except OSError:
            return False
        if free < wanted and not self._is_stopped:
            sentence = f"{free / 1e6:.0f} MB of disk are left: the pictures are no longer written, the robots drive on"
            log_event("dashboard.file_stopped", sentence, level="warning", service="dashboard")
        return free >= wanted

    def _stop(self) -> None:
        if self.stream is not None:
            _close(self.stream)
        self.stream, self._is_stopped = None, True


def _free_path(path: Path, number: int) -> tuple[Path, int]:
    """Returns the first of ``NAME``, ``NAME-2``, ``NAME-3`` ... from ``number`` on that does not exist."""
    while True:
        free = path if number == 1 else path.with_name(f"{path.stem}-{number}{path.suffix}")
        if not free.exists():
            return free, number
        number += 1


def _stream(batch_seconds: float) -> Any:
    batches = rr.ChunkBatcherConfig.DEFAULT()
    batches.flush_tick = batch_seconds
    return rr.RecordingStream(APPLICATION, batcher_config=batches)


def _arrange(stream: Any, fields: dict[str, Scene], display: DisplaySettings) -> None:
    for name in fields:
        # the viewer's y axis points downwards, so the view is mirrored; the logged coordinates are the true ones
        for plane in ("world", "phase"):
            stream.log(["robots", name, plane], rr.Transform3D(scale=[1.0, -1.0, 1.0]), static=True)
    stream.send_blueprint(_blueprint_of(fields, display))


def _log(stream: Any, entry: TimelineEntry, archetype: Any) -> None:
    stream.log(list(entry.path), archetype, static=entry.static)


def _close(stream: Any) -> None:
    with suppress(RuntimeError):  # a viewer that does not read in time misses the last data
        stream.flush(timeout_sec=_FLUSH_SECONDS)
    stream.disconnect()


def _archetype(shape: Shape, at: float, *, static: bool) -> Any:  # noqa: PLR0911 - one line for each kind of shape
    match shape:
        case Discs(centres, radii, colour):
            return rr.Points2D(_points(centres), radii=radii, colors=_colours((colour,)))
        case Rings(centres, radii, colour, width):
            sizes = np.repeat(np.array(radii, dtype=np.float32).reshape(-1, 1), 2, axis=1)
            look = {"colors": _colours((colour,)), "line_radii": [width]}
            return rr.Ellipses2D(centers=_points(centres), half_sizes=sizes, **look)
        case Lines(strips, colours, width, on_top):
            points, order = [_points(strip) for strip in strips], _OVER_DISCS if on_top else None
            return rr.LineStrips2D(points, colors=_colours(colours), radii=[width], draw_order=order)
        case Curves(values, names, colours, widths):
            if static:
                return rr.SeriesLines(names=list(names), colors=_colours(colours), widths=list(widths))
            return rr.Scalars(list(values))
        case Bands(value, deviation, name, unit, colour):
            if static:
                units = [unit] if unit not in ("", "1") else None
                colours = _colours((colour,))
                return rr.Measurements.from_fields(names=[name], units=units, colors=colours, widths=[2.0])
            return rr.Measurements([value], variances=[deviation**2])
        case States(state):
            return rr.StateChange(state=state)
        case StateSet(colours):
            return rr.StateConfiguration(values=list(colours), colors=_colours(tuple(colours.values())))
        case Note(text, colour, level):
            return rr.TextLog(f"{at:.1f} s  {text}", level=level, color=colour)
        case MarkdownPage(text):
            return rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN)


def _colours(colours: tuple[int, ...]) -> Any:
    return np.array(colours, dtype=np.uint32)  # as an array: Rerun would read four plain numbers as one RGBA colour


def _points(points: tuple[tuple[float, float], ...]) -> Any:
    return np.array(points, dtype=np.float32).reshape(-1, 2)


_TIME_LINE = "t"
_OVER_DISCS = 35.0
"""Draw order; Rerun's default is 20 for lines and 30 for points."""
_MOST_TABS = 8
"""Robots with a tab; further ones are recorded, and the user can add panes for them."""

_SHOWN_SECONDS = 20.0
_PANE_POINTS, _LETTER_POINTS, _FRAME_POINTS = 370.0, 6.8, 46.0
"""Widths in a window of 1400 points: of a plot, of a letter of its legend, and of the legend's frame."""
_BACKGROUND = [24, 26, 30]
_LOG_COLUMNS = rrb.TextLogColumns(timeline_columns=[], text_log_columns=["Body"])


def _blueprint_of(fields: dict[str, Scene], display: DisplaySettings) -> rrb.Blueprint:
    """Returns one tab for each of the first robots, or the waiting page if there is none."""
    tabs = [_tab(name, scene, display) for name, scene in list(fields.items())[:_MOST_TABS]]
    waiting = rrb.TextDocumentView(origin="/waiting", name="waiting for a robot")
    return rrb.Blueprint(
        rrb.Tabs(*tabs) if tabs else waiting,
        rrb.TopPanel(state="hidden"),
        rrb.BlueprintPanel(state="hidden"),
        rrb.SelectionPanel(state="hidden"),
        rrb.TimePanel(state="collapsed", timeline=_TIME_LINE, play_state="following"),
        auto_views=False,
    )


def _tab(name: str, scene: Scene, display: DisplaySettings) -> Any:
    origin = str(rr.new_entity_path(["robots", name]))
    states, actions = display.system.state, display.system.action
    unit = f" [{display.h_unit.strip()}]" if display.h_unit else ""
    text_tabs = rrb.Tabs(
        rrb.TextDocumentView(origin=f"{origin}/now", name="now"),
        rrb.TextLogView(origin=f"{origin}/log", name="log", columns=_LOG_COLUMNS),
        rrb.TextDocumentView(origin="/meaning", name="help"),
        active_tab=0,
    )
    planes = _planes(origin, scene, display)
    left = rrb.Vertical(*planes, text_tabs, row_shares=[2.0, 1.7, 1.3] if display.is_pendulum else [3.4, 1.5])
    middle = rrb.Vertical(
        _curves(f"{origin}/barrier", f"h{unit}: above the margin", 11),
        *[_curves(f"{origin}/action/{v.name}", f"{v.name} [{v.unit}]: nominal and filtered", 8) for v in actions],
        _lanes(f"{origin}/verdict", "verdict, diagnosis, model"),
        row_shares=[1.2, *(1.2 for _ in actions), 1.6],
    )
    right = rrb.Vertical(
        _curves(f"{origin}/latent", "estimate, one sigma", max(map(len, legend_names(display)), default=0)),
        _curves(f"{origin}/residual", "measured - predicted", max(len(v.name + v.unit) + 3 for v in states)),
        _curves(f"{origin}/diagnosis/error", "error over 1 s [relative to usual change]", 15),
        _curves(f"{origin}/steps", "time of a step [ms]", 13),
        _lanes(f"{origin}/services", "services"),
        row_shares=[0.75, 1.2, 0.7, 1.2, 1.6],
    )
    return rrb.Horizontal(left, middle, right, column_shares=[1.48, 1, 1], name=name)


def _planes(origin: str, scene: Scene, display: DisplaySettings) -> list[Any]:
    if not display.is_pendulum:
        return [_plane(origin, "world", "world from above [m]", scene)]
    seconds = f"{display.corridor_seconds:g} s"
    return [
        _plane(origin, "world", "pendulum and estimated wind (ring: 5 m/s)", (-1.4, 1.4, -1.25, 1.4)),
        _plane(origin, "phase", f"x: angle, y: change of angle in {seconds} [rad]; safe set orange", scene),
    ]


def _plane(origin: str, part: str, title: str, scene: Scene) -> Any:
    low_x, high_x, low_y, high_y = scene
    edge = 0.04 * max(high_x - low_x, high_y - low_y)
    across, upwards = [low_x - edge, high_x + edge], [-high_y - edge, -low_y + edge]
    return rrb.Spatial2DView(
        origin=origin,
        contents=[f"{origin}/{part}/**"],
        name=title,
        background=_BACKGROUND,
        visual_bounds=rrb.VisualBounds2D(x_range=across, y_range=upwards),
        overrides={f"{origin}/{part}/trail": [rrb.VisibleTimeRanges([_last_seconds()])]},
    )


def _curves(origin: str, name: str, letters: int) -> Any:
    """Returns a plot whose curves end before the right edge, so that a legend of ``letters`` does not cover them."""
    share = min((_LETTER_POINTS * letters + _FRAME_POINTS) / _PANE_POINTS, 0.6)
    shown = TimeRange(start=_seconds(-_SHOWN_SECONDS), end=_seconds(_SHOWN_SECONDS * share / (1.0 - share)))
    return rrb.TimeSeriesView(
        origin=origin,
        name=name,
        time_ranges=[_last_seconds()],
        axis_x=rrb.archetypes.TimeAxis(view_range=shown),
        plot_legend=rrb.PlotLegend(rrb.Corner2D.RightTop),
    )


def _lanes(origin: str, name: str) -> Any:
    return rrb.StateTimelineView(origin=origin, name=name, time_ranges=[_last_seconds()])


def _last_seconds() -> Any:
    return rrb.VisibleTimeRange(_TIME_LINE, start=_seconds(-_SHOWN_SECONDS), end=_seconds(0.0))


def _seconds(after_cursor: float) -> Any:
    return rrb.TimeRangeBoundary.cursor_relative(seconds=after_cursor)
