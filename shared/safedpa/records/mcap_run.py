"""One robot's run out of a recording of the bus."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from safedpa.bus.messages import StateMessage, VerdictMessage
from safedpa.bus.topics import STATE, VERDICT, topic_of
from safedpa.errors import RunError, did_you_mean
from safedpa.records.apply_map import Rows
from safedpa.records.column_map import native_map
from safedpa.records.mcap_messages import read_messages
from safedpa.records.run import Finding, Run
from safedpa.records.run_of_rows import run_of_rows
from safedpa.systems import System

__all__ = ["Recording", "read_recording", "read_run_from_mcap"]


@dataclass
class Recording:
    """One robot's ticks, in order, and the verdicts where they were recorded.

    ``actions`` [k] is what was applied over the period after tick k: the robot reports it with tick k + 1. It is
    NaN where that report is missing.
    """

    robot: str
    t: NDArray[np.float64]
    states: NDArray[np.float64]
    actions: NDArray[np.float64]
    stamps: list[tuple[int, int]]
    """(epoch, tick) of each row."""
    verdicts: dict[tuple[int, int], VerdictMessage] = field(default_factory=dict)
    findings: tuple[Finding, ...] = ()


def read_run_from_mcap(path: str | Path, system: System, robot: str | None = None) -> Run:
    """States and applied actions of one robot as a run; ``robot`` is needed when the recording holds several.

    Raises RunError when the file is no recording, holds no such robot, or one of another system.
    """
    path = Path(path)
    recording = read_recording(path, robot)
    for what, values, names in (
        ("states", recording.states, system.state_names),
        ("actions", recording.actions, system.action_names),
    ):
        if values.shape[1] != len(names):
            raise RunError(
                f"{path}: robot '{recording.robot}': got {values.shape[1]} {what}, wanted {len(names)} "
                f"({', '.join(names)}); name the model of that robot"
            )
    known: NDArray[np.bool_] = np.asarray(np.isfinite(recording.actions).all(axis=1))
    rows = Rows(recording.t, recording.states, recording.actions).taken(known)
    return run_of_rows(path, system, native_map(system), rows, recording.findings)


def read_recording(path: Path, robot: str | None = None, *, with_verdicts: bool = False) -> Recording:
    """Ticks of one robot, and the safety filter's verdicts when wanted. Raises RunError as ``read_run_from_mcap``."""
    findings: list[Finding] = []
    topics = (STATE, VERDICT) if with_verdicts else (STATE,)
    states: dict[str, dict[tuple[int, int], StateMessage]] = {}
    verdicts: dict[str, dict[tuple[int, int], VerdictMessage]] = {}
    for key, _, message in read_messages(path, findings, topics):
        name = topic_of(key)[1]
        stamp = (message.epoch, message.tick)
        if isinstance(message, StateMessage):
            states.setdefault(name, {}).setdefault(stamp, message)
        elif isinstance(message, VerdictMessage):
            verdicts.setdefault(name, {}).setdefault(stamp, message)
    chosen = _chosen(path, robot, list(states), findings)
    return _recording(path, chosen, states[chosen], verdicts.get(chosen, {}), findings)


def _chosen(path: Path, robot: str | None, robots: list[str], findings: list[Finding]) -> str:
    if not robots:
        reason = f" ({'; '.join(finding.message for finding in findings)})" if findings else ""
        raise RunError(f"{path}: no robot's states in it{reason}; wanted a recording of a drive")
    if robot is None and len(robots) > 1:
        raise RunError(f"{path}: holds {len(robots)} robots: {', '.join(sorted(robots))}; name one of them")
    if robot is not None and robot not in robots:
        raise RunError(f"{path}: robot '{robot}': {did_you_mean(robot, robots)}")
    return robot or robots[0]


def _recording(
    path: Path,
    robot: str,
    messages: dict[tuple[int, int], StateMessage],
    verdicts: dict[tuple[int, int], VerdictMessage],
    findings: list[Finding],
) -> Recording:
    ordered = list(_in_order(messages))
    widths = {(len(message.values), len(message.applied)) for message in ordered}
    if len(widths) > 1:
        raise RunError(f"{path}: robot '{robot}': the number of its states or actions changes; record each robot alone")
    actions = np.full((len(ordered), len(ordered[0].applied)), np.nan)
    for row, message in enumerate(ordered):
        after = messages.get((message.epoch, message.tick + 1))
        if after is not None:
            actions[row] = after.applied
    return Recording(
        robot,
        np.array([message.robot_time for message in ordered]),
        np.array([message.values for message in ordered]),
        actions,
        [(message.epoch, message.tick) for message in ordered],
        verdicts,
        tuple(findings),
    )


def _in_order(messages: dict[tuple[int, int], StateMessage]) -> Iterator[StateMessage]:
    """By epoch in the order in which the epochs began, then by tick."""
    epochs = list(dict.fromkeys(epoch for epoch, _ in messages))
    for epoch in epochs:
        yield from sorted((m for m in messages.values() if m.epoch == epoch), key=lambda m: m.tick)
