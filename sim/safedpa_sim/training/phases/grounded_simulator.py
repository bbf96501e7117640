"""Corrects the training simulator by a diagnosis of a few real drives.

Networks that are tuned only on drives without load forget the effect of loads, because nothing in these drives
preserves it. A physics model does not forget: its effects compose. So the drives first correct the simulator: its
parameters are refitted, and effects are added until the diagnosis finds nothing missing. Phase 3 then trains on drives
with loads in the corrected simulator, together with the real ones.
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

_ROWS = 6000


@final
@dataclass(frozen=True)
class GroundedSimulator:
    """The corrected simulator and the diagnosis report behind it."""

    model: PhysicsModel
    report: Report

    def summary(self) -> dict[str, Any]:
        """Returns verdict, added effects in order, held-out error after each, and parameters for the record."""
        return {
            "verdict": self.report.verdict,
            "effects": list(self.report.added),
            "heldout_error": [stage.heldout_error for stage in self.report.stages],
            "parameters": {path: value.value for path, value in self.report.parameters.items()},
        }


def ground_simulator(
    configuration: Configuration, runs: Sequence[Run], report_progress: ReportProgress = silent
) -> GroundedSimulator:
    """Refits the parameters of the simulator's base to the runs and adds the effects that the diagnosis finds.

    Effects that the training randomises, such as a towed load, are in the model from the start with neutral values, so
    that the diagnosis does not search for them: the runs are recorded without them. Raises InputError when the
    diagnosis reaches no verdict on the runs.
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
        raise InputError(
            f"tuning: the runs are not informative enough to correct the simulator ({why}); record a more varied drive"
        )
    found = report.models[-1]
    return GroundedSimulator(
        found.with_settings({path: Setting(it.value) for path, it in found.settings.items()}), report
    )


def grounded_configuration(configuration: Configuration, grounded: GroundedSimulator) -> Configuration:
    """Returns the configuration with the corrected simulator."""
    return replace(configuration, simulator=grounded.model)


def _to_be_corrected(configuration: Configuration) -> PhysicsModel:
    model = configuration.simulator
    for name in dict.fromkeys(path.split(".")[0] for path in configuration.environment):
        if name != "base" and name not in {item.name for item in model.effects}:
            model = model.with_effect(effect(model.system.name, name), {})
    base = {path: it for path, it in model.settings.items() if path.startswith("base.")}
    return model.with_settings({path: Setting(it.value, free=True) for path, it in base.items()})


def _first(runs: Sequence[Run], rows: int) -> list[Run]:
    """Returns the first runs that together have ``rows`` rows; ten times as many only make the diagnosis slower."""
    retained, total = [], 0
    for run in runs:
        retained.append(run)
        total += sum(len(part) for part in run.stretches)
        if total >= rows:
            break
    return retained
