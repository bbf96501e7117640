"""The training simulator, corrected by what a few real drives say it lacks.

Networks that are tuned on drives without load forget what loads do: nothing in those drives holds it in place. Physics
does not forget. So the simulator's own physics is diagnosed by the same few drives (its parameters refitted, named
effects added until nothing is missing), and what it then says of loads, which compose with the rest as they do in
reality, is taught to the networks next to the real drives.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, final

from safedpa.diagnosis.diagnose import diagnose
from safedpa.diagnosis.report_schema import Report
from safedpa.dynamics import PhysicsModel, Setting
from safedpa.effects import effect
from safedpa.errors import InputError
from safedpa.records import Run
from safedpa_sim.training.configuration import Configuration
from safedpa_sim.training.progress import ReportProgress, silent

__all__ = ["GroundedSimulator", "ground_simulator", "grounded_configuration"]

_ROWS = 6000


@final
@dataclass(frozen=True)
class GroundedSimulator:
    """The corrected simulator, and the diagnosis that corrected it."""

    model: PhysicsModel
    report: Report

    def summary(self) -> dict[str, Any]:
        """What is worth recording: the effects in order and the error on held-out data after each."""
        return {
            "verdict": self.report.verdict,
            "effects": list(self.report.added),
            "heldout_error": [stage.heldout_error for stage in self.report.stages],
            "parameters": {path: value.value for path, value in self.report.parameters.items()},
        }


def ground_simulator(
    configuration: Configuration, runs: Sequence[Run], report_progress: ReportProgress = silent
) -> GroundedSimulator:
    """Refits every parameter of the simulator's base to the runs, and adds the effects that a diagnosis names.

    Effects that the training randomises (a towed load) stand in the model from the start, doing nothing: they are not
    looked for, because the runs are without them. Raises InputError when the runs allow no verdict.
    """
    report = diagnose(
        _to_be_corrected(configuration),
        _first(runs, _ROWS),
        report_progress=lambda done, every, notice: report_progress(
            "3", done, every, f"diagnosis of the simulator; {notice}"
        ),
    )
    too_few = report.verdict == "undecided" and report.unexplained is not None and not report.added
    if too_few or (report.verdict == "unexplained" and not report.added):
        why = report.unexplained.expression if report.unexplained else "nothing helps"
        raise InputError(f"tuning: the runs say nothing about the simulator ({why}); record a drive with more in it")
    found = report.models[-1]
    return GroundedSimulator(
        found.with_settings({path: Setting(it.value) for path, it in found.settings.items()}), report
    )


def grounded_configuration(configuration: Configuration, grounded: GroundedSimulator) -> Configuration:
    """The same training in the corrected simulator."""
    return replace(configuration, simulator=grounded.model)


def _to_be_corrected(configuration: Configuration) -> PhysicsModel:
    model = configuration.simulator
    for name in dict.fromkeys(path.split(".")[0] for path in configuration.environment):
        if name != "base" and name not in {item.name for item in model.effects}:
            model = model.with_effect(effect(model.system.name, name), {})
    base = {path: it for path, it in model.settings.items() if path.startswith("base.")}
    return model.with_settings({path: Setting(it.value, free=True) for path, it in base.items()})


def _first(runs: Sequence[Run], rows: int) -> list[Run]:
    """As many whole runs as hold ``rows`` rows: a diagnosis learns no more from ten times as many, and takes longer."""
    retained, total = [], 0
    for run in runs:
        retained.append(run)
        total += sum(len(part) for part in run.stretches)
        if total >= rows:
            break
    return retained
