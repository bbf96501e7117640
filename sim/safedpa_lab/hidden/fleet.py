"""A fleet of cars in which some lack something: recordings by robot, and the sealed truth next to them."""

from __future__ import annotations

import json
import shutil
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from safedpa_lab.hidden.case import Case, Effects
from safedpa_lab.hidden.write import write_cases

_BRAKE, _OFFSET = 0.05, 0.03
"""Share of the robots with a dragging brake, and with a bent steering."""
COMMON: Final[Effects] = {"quadratic_drag": {"coefficient": 0.02}}
"""Hidden in all robots of a fleet with something in common: a sixth of what is ordinary."""
_AT_ONCE = 20
"""Robots that are simulated side by side: memory does not grow with the fleet."""


@dataclass(frozen=True)
class FleetLogs:
    """Where a fleet lies. Anyone who diagnoses may look into ``recordings`` and at ``model`` alone."""

    folder: Path
    truth: dict[str, Any]

    @property
    def recordings(self) -> Path:
        """One folder for each robot."""
        return self.folder / "recordings"

    @property
    def model(self) -> Path:
        """The given model, without what is hidden."""
        return self.folder / "model.toml"


def fleet_truth(robots: int, seed: int, common: bool = False) -> dict[str, Effects]:
    """What is hidden in which robot: brakes that drag, bent steerings, one robot on a slope; most have nothing.

    5 % have a rolling resistance of 0.4 to 0.5 m/s2, 3 % a steering offset of 0.03 to 0.045 rad, at least one each.
    """
    random = np.random.default_rng([seed, 11])
    every: list[dict[str, dict[str, float]]] = [{} for _ in range(robots)]
    order = random.permutation(robots).tolist()
    brakes, offsets = max(1, round(_BRAKE * robots)), max(1, round(_OFFSET * robots))
    for index in order[:brakes]:
        every[index]["rolling_resistance"] = {"deceleration": float(random.uniform(0.4, 0.5))}
    for index in order[brakes : brakes + offsets]:
        every[index]["steering_offset"] = {"angle": float(random.uniform(0.03, 0.045))}
    for index in order[brakes + offsets : brakes + offsets + 1]:
        heading = float(random.uniform(-np.pi, np.pi))
        every[index]["constant_force"] = {"ax": 0.5 * float(np.cos(heading)), "ay": 0.5 * float(np.sin(heading))}
    shared = COMMON if common else {}
    return {f"car_{index:03d}": {**shared, **own} for index, own in enumerate(every)}


def write_fleet(
    truth: dict[str, Effects],
    folder: Path,
    seed: int,
    *,
    hard: bool = True,
    runs: int = 4,
    seconds: float = 40.0,
    report_progress: Callable[[int, int], None] = lambda _done, _all: None,
) -> FleetLogs:
    """Simulates every robot and writes ``recordings/ROBOT/run_*.csv``, ``model.toml`` and ``truth.json``."""
    logs = FleetLogs(
        folder,
        {
            "seed": seed,
            "hard": hard,
            "runs": runs,
            "seconds": seconds,
            "robots": {name: dict(own) for name, own in truth.items()},
        },
    )
    names, sealed = list(truth), folder / "truth.json"
    if sealed.exists() and json.loads(sealed.read_text(encoding="utf-8")) == logs.truth:
        return logs  # an interrupted experiment goes on
    for begin in range(0, len(names), _AT_ONCE):
        report_progress(begin, len(names))
        part = names[begin : begin + _AT_ONCE]
        cases = [
            Case(
                "fleet",
                int(np.random.SeedSequence([seed, 12, begin + place]).generate_state(1)[0]),
                truth[name],
                hard=hard,
                runs=runs,
                seconds=seconds,
            )
            for place, name in enumerate(part)
        ]
        _write_part(cases, part, logs)
    sealed.write_text(json.dumps(logs.truth, indent=1) + "\n", encoding="utf-8")
    return logs


def _write_part(cases: Sequence[Case], names: Sequence[str], logs: FleetLogs) -> None:
    with tempfile.TemporaryDirectory(prefix="safedpa-fleet-") as name:
        written = write_cases(cases, [Path(name) / robot for robot in names])
        for robot, log in zip(names, written, strict=True):
            own = logs.recordings / robot
            own.mkdir(parents=True, exist_ok=True)
            for path in log.runs:
                shutil.copy(path, own / path.name)
            logs.model.write_bytes(log.model.read_bytes())
