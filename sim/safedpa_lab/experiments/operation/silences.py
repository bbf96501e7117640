"""Hangs or kills each process of a run, and measures when every place that a person looks at is right about it."""

from __future__ import annotations

import contextlib
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

from safedpa.bus import Bus, ZenohSettings, ZenohTransport
from safedpa.bus.monitor import FleetOverview, headline
from safedpa.errors import SafedpaError
from safedpa_lab.experiments.record import Options, ReportProgress, Result
from safedpa_services.command_line.status import document_of
from safedpa_services.metrics.exporter import FleetCollector

VICTIMS: Final = ("robot", "adaptation", "policy", "safety_filter", "recorder", "diagnosis", "supervisor")
PLACES: Final = ("status", "terminal", "headline", "metrics")
LIMIT_SECONDS: Final = 2.0
"""Time until a place is right; an alert follows the metrics after the delay that its rule states."""
RETURN_SECONDS: Final = 10.0
"""Time until the successor of a killed process is heard. A robot is healthy again only ten seconds after its last late
tick, because shares of the last ten seconds are shown."""
_PATIENCE_SECONDS = 180.0
_POLL_SECONDS = 0.05


def run(options: Options, report_progress: ReportProgress) -> Result:
    """Runs ``safedpa experiment silences``."""
    rows, victims = [], options["victims"] or VICTIMS
    with tempfile.TemporaryDirectory(prefix="safedpa-silences-") as name, _Run(Path(name)) as driven:
        for number, victim in enumerate(sorted(victims, key=VICTIMS.index)):  # the supervisor's end is the run's
            does = driven.kill if options["kill"] else driven.hang
            rows.append({"victim": victim, **does(victim, options["seconds"])})
            report_progress(number + 1, len(victims))
    kind, seconds = "kill" if options["kill"] else "hang", options["seconds"]
    return {"experiment": "silences", "kind": kind, "seconds": seconds, "limit_s": LIMIT_SECONDS, "rows": rows}


def verdict(result: Result) -> None:
    """Raises SafedpaError for each place that was wrong, too late, or right only for a time."""
    found = []
    for row in result["rows"]:
        for place, seconds in row["seconds"].items():
            if seconds is None or seconds > LIMIT_SECONDS:
                found.append(f"{row['victim']}: {place} after {'never' if seconds is None else f'{seconds:.1f} s'}")
        found += [f"{row['victim']}: {place} was right only for a time" for place in row["lapsed"]]
        if row.get("unreported"):
            found.append(f"{row['victim']}: status does not know that it was restarted")
        if (row["replaced"] or 0.0) > RETURN_SECONDS:
            found.append(f"{row['victim']}: replaced after {row['replaced']:.1f} s")
    if found:
        raise SafedpaError(f"silences: {'; '.join(found)}")


def report(result: Result) -> str:
    """Seconds until each place is right, by the process that hangs or is killed."""
    what = "Killed" if result["kind"] == "kill" else "Hung"
    lines = [f"{what}, observed for {result['seconds']:g} s; seconds until right", ""]
    columns = ("process", *PLACES, "replaced after", "healthy again after")
    lines += [f"| {' | '.join(columns)} |", "|---" * len(columns) + "|"]
    for row in result["rows"]:
        cells = [_cell(row["seconds"].get(place, -1.0)) for place in PLACES]
        cells += [_cell(-1.0 if seconds is None else seconds) for seconds in (row["replaced"], row["returned"])]
        lines.append(f"| {row['victim']} | {' | '.join(cells)} |")
    return "\n".join(lines)


def _cell(seconds: float | None) -> str:
    return "never" if seconds is None else "-" if seconds < 0.0 else f"{seconds:.1f}"


class _Run:
    """A run of ``safedpa up`` without pages, and an observer on its bus."""

    def __init__(self, folder: Path) -> None:
        self._output = folder / "output"
        command = [sys.executable, "-m", "safedpa_services", "up", "--headless", "--diagnosis", "--seconds", "0"]
        with self._output.open("wb") as log:
            self._up = subprocess.Popen([*command, "--out", str(folder / "runs")], stdout=log, stderr=log)

    def __enter__(self) -> _Run:
        self._wait(lambda: "--connect" in self._printed(), "no endpoint")
        self._endpoint = re.findall(r"--connect (\S+)", self._printed())[0]
        self._bus = Bus(ZenohTransport(ZenohSettings("client", connect=(self._endpoint,))), "fleet")
        self._fleet = FleetOverview(self._bus)
        return self

    def __exit__(self, *_: object) -> None:
        self._bus.close()
        self._up.send_signal(signal.SIGCONT)
        self._up.send_signal(signal.SIGINT)
        self._up.wait(_PATIENCE_SECONDS)

    def hang(self, victim: str, seconds: float) -> dict[str, Any]:
        """Hangs a process, and returns when the places were right, which lapsed, and when all was well again."""
        printed, pid = self._before(victim)
        os.kill(pid, signal.SIGSTOP)
        try:
            watched = self._watched(victim, printed, lambda passed: passed < seconds and self._pid_of(victim) == pid)
        finally:
            with contextlib.suppress(ProcessLookupError):  # the supervisor has killed and restarted it
                os.kill(pid, signal.SIGCONT)
        return {**watched, "replaced": None, "returned": self._wait(self._healthy, f"{victim}: not healthy again")}

    def kill(self, victim: str, seconds: float) -> dict[str, Any]:
        """Kills a process, and returns when the places knew of its restart or, of a supervisor, of its end."""
        printed, pid = self._before(victim)
        restarts = self._restarts(victim)
        os.kill(pid, signal.SIGKILL)
        if victim == "supervisor":
            self._up.wait(_PATIENCE_SECONDS)
            watched = self._watched(victim, printed, lambda passed: passed < seconds)
            return {**watched, "replaced": None, "returned": None}
        replaced = self._wait(lambda: self._is_heard(victim, pid), f"{victim}: not restarted")
        returned = replaced + self._wait(self._healthy, f"{victim}: not healthy again")
        known = self._restarts(victim) > restarts
        return {"seconds": {}, "lapsed": [], "replaced": replaced, "returned": returned, "unreported": not known}

    def _before(self, victim: str) -> tuple[int, int]:
        """Waits until all is well; returns the length of what is printed, and the victim's process id."""
        self._wait(lambda: self._healthy() and not any(self._right(victim, 0).values()), "not healthy")
        return len(self._printed()), self._pid_of(victim)

    def _watched(self, victim: str, printed: int, goes_on: Callable[[float], bool]) -> dict[str, Any]:
        """Returns when each place was first right, and which were wrong again while ``goes_on``."""
        first: dict[str, float | None] = dict.fromkeys(self._right(victim, printed))
        lapsed: set[str] = set()
        began = time.monotonic()
        while goes_on(passed := time.monotonic() - began):
            for place, is_right in self._right(victim, printed).items():
                if is_right and first[place] is None:
                    first[place] = passed
                elif not is_right and first[place] is not None:
                    lapsed.add(place)
        return {"seconds": first, "lapsed": sorted(lapsed)}

    def _is_heard(self, victim: str, before: int) -> bool:
        """Whether another process than ``before`` sends heartbeats as the victim."""
        self._fleet.listen(_POLL_SECONDS)
        known = [one for one in self._fleet.services.values() if one.name == victim]
        return any(one.pid != before and one.age(self._fleet.clock()) < LIMIT_SECONDS for one in known)

    def _restarts(self, victim: str) -> int:
        return self._fleet.roster.counts[("robot", "r1") if victim == "robot" else ("service", victim)]

    def _right(self, victim: str, printed: int) -> dict[str, bool]:
        """Returns which places say that the victim is missing."""
        self._fleet.listen(_POLL_SECONDS)
        label = "r1" if victim == "robot" else victim
        found = {"status": not document_of(self._fleet)["healthy"], "metrics": self._missing_metric(label)}
        if victim != "supervisor":
            found["terminal"] = f"{label}: missing" in self._printed()[printed:]
        robot = self._fleet.robots.get("r1")
        if robot is not None and victim in ("robot", "safety_filter"):
            now = self._fleet.clock()
            found["headline"] = bool(headline(now - robot.state_at, now - robot.verdict_at, 0.05))
        return found

    def _missing_metric(self, label: str) -> bool:
        samples = [one for family in FleetCollector(self._fleet).collect() for one in family.samples]
        return any(
            one.name == "safedpa_missing" and one.labels["name"] == label and one.value == 1.0 for one in samples
        )

    def _healthy(self) -> bool:
        self._fleet.listen(_POLL_SECONDS)
        return bool(document_of(self._fleet)["healthy"]) and bool(self._fleet.robots)

    def _printed(self) -> str:
        return self._output.read_text(errors="replace")

    def _pid_of(self, name: str) -> int:
        """Returns the process id; 0 if there is no such process now."""
        module = "safedpa_sim.robots" if name == "robot" else f"safedpa_services.{name}"
        if name == "supervisor":
            return self._up.pid
        for path in Path("/proc").glob("[0-9]*/cmdline"):
            with contextlib.suppress(OSError):
                parts = path.read_bytes().split(b"\0")
                if module.encode() in parts and self._endpoint.encode() in parts:
                    return int(path.parent.name)
        return 0

    def _wait(self, done: Callable[[], bool], trouble: str) -> float:
        began = time.monotonic()
        while not done():
            if time.monotonic() - began > _PATIENCE_SECONDS:
                raise SafedpaError(f"silences: {trouble} within {_PATIENCE_SECONDS:.0f} s: {self._printed()[-400:]}")
            time.sleep(_POLL_SECONDS)
        return time.monotonic() - began
