"""The terminal view of a run: robot, verdicts, health of every process."""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Sequence

from rich.console import Group
from rich.table import Table
from rich.text import Text

from safedpa.bus import StateMessage
from safedpa.bus.monitor import age_text, headline, is_stale
from safedpa_services.supervisor.child import Child
from safedpa_services.supervisor.run_monitor import RunMonitor

_SILENT_SECONDS = 1.0
_OLD_FINDING_SECONDS = 5.0
"""Findings arrive once a second of robot time."""
_COLOURS = {"passed": "green", "corrected": "yellow", "relaxed": "magenta", "violated": "bold red"}
_COLOURS |= {"fallback": "red", "disabled": "red", "stopped": "yellow"}


def render_view(
    watch: RunMonitor, children: Sequence[Child], hints: Sequence[str], warnings: Iterable[str] = ()
) -> Group:
    """Renders a headline, the table of processes, hints for the user, and the newest warnings."""
    return Group(
        _headline(watch),
        *_stationary(watch),
        _finding(watch),
        _processes(watch, children),
        *(Text(hint, style=_hint_style(hint)) for hint in hints),
        *(Text(line, style="yellow", no_wrap=True, overflow="ellipsis") for line in warnings),
    )


def _hint_style(hint: str) -> str:
    return "bold cyan" if hint.startswith("live view") else "dim"


def _stationary(watch: RunMonitor) -> list[Text]:
    """Returns how long the robot has been stationary and why, if the verdict reports a reason."""
    verdict, age = watch.verdict, watch.ages()[1]
    if verdict is None or age is None or not verdict.stationary_reason or is_stale(age):
        return []
    reason = f"stationary for {verdict.stationary_for:.0f} s, {verdict.stationary_reason}"
    return [Text.assemble((reason, "yellow"), (f"  {age_text(age)}", "dim"))]


def _headline(watch: RunMonitor) -> Text:
    """Returns the present first; then the newest values with their ages, dim if they are old."""
    state, verdict, (state_age, verdict_age) = watch.state, watch.verdict, watch.ages()
    if state is None or state_age is None:
        return Text("waiting for the robot")
    now = headline(state_age, verdict_age, state.period)
    line = Text.assemble((f"{now[:1].upper()}{now[1:]}. ", "bold red")) if now else Text()
    values = Text.assemble(
        (f"{state.robot_time:7.1f} s  ", "bold"),
        f"{_motion(state)}  goals {state.goals_reached}  ",
        (f"collisions {state.collisions}  ", "bold red" if state.collisions else "green"),
        (f"{age_text(state_age)}  ", "dim"),
    )
    if verdict is not None and verdict_age is not None:
        values.append(f"{verdict.status:<9} ", style=_COLOURS.get(verdict.status, ""))
        values.append(f"h {verdict.h_now:+.2f}  margin {verdict.margin:.3f}  {verdict.microseconds:.0f} us")
        values.append(f"  {age_text(verdict_age)}", style="dim")
    if now:  # nothing old in the colours of the present
        line.append("Last: ", style="dim").append(values.plain, style="dim")
        return line
    return values


def _motion(state: StateMessage) -> str:
    """Returns the speed of a car, the angle of a pendulum, or the first state of another robot."""
    if len(state.values) == 4:
        return f"{state.values[3]:+.2f} m/s"
    if state.corridor:
        return f"{math.degrees(state.values[0]):+.1f} degrees"
    return f"{state.values[0]:+.2f}"


def _finding(watch: RunMonitor) -> Text:
    """Returns the newest finding of the diagnosis."""
    finding = watch.finding
    if finding is None:
        return Text("")
    age = max(0.0, time.monotonic() - (watch.finding_at or 0.0))
    colour = "green" if finding.stage in ("learning", "watching") else "yellow"
    style = "dim" if age > _OLD_FINDING_SECONDS else colour
    return Text.assemble(
        (f"model {finding.model}  ", "bold"), (f"{finding.stage}: {finding.sentence}", style), f"  {age_text(age)}"
    )


def _processes(watch: RunMonitor, children: Sequence[Child]) -> Table:
    table = Table(box=None, pad_edge=False)
    for column in ("process", "state", "pid", "steps", "stale", "refused", "last step", "age", "restarts", ""):
        table.add_column(column, justify="right" if column in ("pid", "steps", "stale", "refused") else "left")
    for child in children:
        table.add_row(*_row(watch, child))
    return table


def _row(watch: RunMonitor, child: Child) -> tuple[str | Text, ...]:
    known = watch.health.get(child.name)
    if child.exit_code is not None:
        state = Text("ended", style="red")
    elif not child.heartbeat:
        state = Text("running", style="green")
    elif known is None:
        state = Text("starting", style="yellow")
    elif watch.silent_for(child.name) > _SILENT_SECONDS:
        state = Text("silent", style="red")
    else:
        state = Text(known[0].state, style="red" if known[0].state == "failing" else "green")
    first, restarts = (child.name, state, str(child.pid)), str(child.restarts)
    if known is None:
        return (*first, "", "", "", "", "", restarts, "")
    message = known[0]
    counts = (str(message.steps), str(message.stale), str(message.refused))
    age = f"{watch.silent_for(child.name):.1f} s"
    return (*first, *counts, f"{message.step_microseconds:.0f} us", age, restarts, Text(message.detail[:60]))
