"""``diagnose``: which physical effects a model lacks."""

from __future__ import annotations

import json
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, final

import numpy as np

from safedpa.api.deployment import CalibratedMargin, calibrate_margin_file, drive_command
from safedpa.api.inputs import Columns, Logs, Model, files_of, model_of, runs_of, title_of
from safedpa.comparison.comparison import EVERY, compare_model
from safedpa.comparison.excerpt import subsample_runs
from safedpa.comparison.output import results_folder
from safedpa.comparison.rollout import rollout
from safedpa.diagnosis.diagnose import diagnose as diagnose_runs
from safedpa.diagnosis.report_schema import Candidate, DiagnosisStage, FittedValue, Report, as_document
from safedpa.dynamics import LearnedBase, PhysicsModel, save_model, write_model
from safedpa.extras import need
from safedpa.progress import progress, progress_with_notes
from safedpa.records.run import Run
from safedpa.records.writers.tables import atomic_path
from safedpa.report.comparison_figures import COLOURS
from safedpa.report.diagnosis_lines import story_lines, value_text
from safedpa.report.diagnosis_page import report_page, write_report
from safedpa.report.diagnosis_recording import write_recording
from safedpa.report.overlays import chosen_windows
from safedpa.result import AbstractPlottedResult, Rows

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_WRITTEN = ("report.json", "report.html", "diagnosis.rrd", "model.toml", "margin.toml")
_PLOT_WINDOWS = 1500
"""Windows among which the worst is drawn: the search for it takes a second at most."""
_MARGIN_ROWS = 60_000
"""Evenly spread rows for the margin's calibration. Limited because the actuator state is simulated along each of
them."""


@final
@dataclass(frozen=True)
class SavedDiagnosis:
    """The files of a diagnosis: the ``folder``, and the calibrated ``margin``.

    ``drive`` is the shell command that drives the simulated robot with model and margin; None without a margin, and
    after the verdicts "undecided" and "unexplained".

    Example:

        >>> found = safedpa.diagnose("frictionless.toml", "log.csv", out="found")
        >>> sorted(path.name for path in found.saved.folder.iterdir()) if found.saved else []
        ['diagnosis.rrd', 'margin.toml', 'model.toml', 'report.html', 'report.json']
    """

    folder: Path
    margin: CalibratedMargin
    drive: str | None

    def to_dict(self) -> dict[str, Any]:
        """Returns the part ``margin`` of ``safedpa diagnose --json``."""
        margin = self.margin
        file, period = (None, None) if margin.path is None else (str(margin.path), margin.period)
        return {"file": file, "period": period, "notice": margin.notice, "drive": self.drive}


@final
@dataclass(frozen=True, repr=False, eq=False)
class Diagnosis(AbstractPlottedResult):
    """Which effects a model lacks.

    ``report`` is the full report, ``given_runs`` are the recordings, ``title`` is the model's name in reports,
    ``saved`` are the files that ``out`` asked for. The table of ``to_dataframe`` has one row per candidate.
    ``print(diagnosis)`` shows what ``safedpa diagnose`` prints.

    Example:

        >>> found = safedpa.diagnose("frictionless.toml", "log.csv")
        >>> found.verdict, found.added
        ('effect_missing', ('viscous_friction',))
        >>> fitted = found.parameters["viscous_friction.coefficient"]
        >>> round(fitted.value, 1), fitted.unit
        (0.2, 'N m s/rad')
        >>> safedpa.save_model(found.model, "corrected.toml")
    """

    report: Report
    given_runs: tuple[Run, ...]
    title: str
    saved: SavedDiagnosis | None = None

    @property
    def verdict(self) -> str:
        """``effect_missing``, ``nothing_missing``, ``unexplained`` or ``undecided``."""
        return self.report.verdict

    @property
    def added(self) -> tuple[str, ...]:
        """Names of the effects that the model lacks, in the order in which they were found."""
        return self.report.added

    @property
    def model(self) -> PhysicsModel:
        """The model with the effects that were found, fitted."""
        return self.report.models[-1]

    @property
    def parameters(self) -> dict[str, FittedValue]:
        """Fitted parameters by path: value, standard deviation (None if unknown) and unit."""
        return dict(self.report.parameters)

    @property
    def stages(self) -> Rows[DiagnosisStage]:
        """The model after each addition and its error on data that was not used for fitting."""
        return Rows("stages", self.report.stages)

    @property
    def candidates(self) -> Rows[Candidate]:
        """Every effect that was tried, with its decision and the reason."""
        return Rows("candidates", self.report.candidates)

    @property
    def findings(self) -> Rows[dict[str, Any]]:
        """What was found in the data, by run."""
        return Rows("findings", self.report.data_quality)

    def to_dict(self) -> dict[str, Any]:
        """Returns report.json; with ``out`` also the margin, as ``safedpa diagnose --json`` prints it."""
        return as_document(self.report) | ({} if self.saved is None else {"margin": self.saved.to_dict()})

    def to_html(self, path: str | Path) -> Path:
        """Writes the page of ``safedpa diagnose``, with all figures, and returns its path."""
        need("diagnosis", what="to_html()")
        page = report_page(as_document(self.report), self.given_runs, self.report.models, self.title)
        written = Path(path)
        written.write_text(page, encoding="utf-8")
        return written

    def __str__(self) -> str:
        return "\n".join(line for line, _ in story_lines(self.report))

    def _facts(self) -> dict[str, object]:
        stages = self.report.stages
        values = [value_text(path, value) for path, value in self.report.parameters.items()]
        added = [text for text in values if text.split(".")[0] in self.added]
        return {
            "model": self.title,
            "verdict": self.verdict,
            "added": ", ".join(added) or "nothing",
            "error": " to ".join(f"{stage.heldout_error:.3g}" for stage in (stages[:1] + stages[1:][-1:])),
            "candidates": len(self.report.candidates),
            "findings": len(self.report.data_quality),
        }

    def _columns(self) -> dict[str, Sequence[Any]]:
        found = self.report.candidates
        return {
            "stage": [item.stage for item in found],
            "effect": [item.effect for item in found],
            "decision": [item.decision for item in found],
            "score": [item.score for item in found],
            "heldout_error": [item.heldout_error for item in found],
            "parameters": [", ".join(value_text(*pair) for pair in item.parameters.items()) for item in found],
            "reason": [item.reason for item in found],
        }

    def _draw(self, figure: Figure) -> None:
        """Draws the error after each addition, and the window that the given model predicts worst."""
        bars, window = figure.subplots(1, 2, width_ratios=(2, 3))
        stages = self.report.stages
        names = ["given model"]
        for earlier, stage in pairwise(stages):
            names.append("+ " + ", ".join(name for name in stage.effects if name not in earlier.effects))
        colours = [COLOURS["before"], *[COLOURS["after"]] * (len(stages) - 1)]
        bars.barh(names[::-1], [stage.heldout_error for stage in stages][::-1], color=colours[::-1])
        bars.set_title("error on held-out data", fontsize="small")
        bars.tick_params(labelsize="small")
        figure.suptitle(str(self._facts()["added"]), fontsize="small")
        _draw_worst_window(window, self.report, self.given_runs)


def diagnose(
    model: Model,
    runs: Logs,
    *,
    columns: Columns = None,
    horizon: float = 1.0,
    effects: str | Path | None = None,
    out: str | Path | None = None,
    force: bool = False,
) -> Diagnosis:
    """Finds out from recordings which effects of the library a model lacks.

    Fits every effect, alone and in pairs, and adds those that improve the prediction of held-out data; reports as well
    if nothing is missing, if the data cannot distinguish effects, or if no effect explains the error. The data
    determine the horizon of the search; ``horizon`` [s] is that of the displayed errors. ``columns`` is as in
    ``read_log``, ``effects`` a Python file with the user's own effects. With ``out``, a folder, it writes report.json,
    report.html, diagnosis.rrd, model.toml and margin.toml, and replaces an input or an earlier result only with
    ``force``. Takes seconds to minutes. Raises InputError for an unusable horizon or a model of another robot, RunError
    for unusable recordings.

    Example:

        >>> safedpa.diagnose("frictionless.toml", "log.csv").stages[-1].effects
        ('viscous_friction',)
    """
    need("diagnosis", what="diagnose()")
    loaded = model_of(model, effects)
    read = files_of(model, runs, columns, effects)
    folder = None if out is None else Path(out)
    with nullcontext() if folder is None else results_folder(folder, _WRITTEN, read, force):
        recorded = runs_of(runs, loaded, columns)
        with progress_with_notes("diagnosing") as narrate:
            report = diagnose_runs(loaded, recorded, horizon, narrate)
        found = Diagnosis(report, tuple(recorded), title_of(model))
        if folder is None:
            return found
        with progress("writing") as report_progress:
            report_progress(0, 2)
            _write(found, folder)
            report_progress(1, 2)
            margin = _margin(report, recorded, folder)
    drive = None
    # A model that is known to be incomplete, or not known to be complete, is not offered for driving.
    if margin.path is not None and report.verdict in ("effect_missing", "nothing_missing"):
        own = None if effects is None else Path(effects)
        drive = drive_command(found.model, folder / "model.toml", margin.path, own, margin.period)
    return replace(found, saved=SavedDiagnosis(folder, margin, drive))


def _write(found: Diagnosis, out: Path) -> None:
    document, report = as_document(found.report), found.report
    texts = {"report.json": json.dumps(document, allow_nan=False, indent=1) + "\n"}
    if isinstance(found.model.base, LearnedBase):
        save_model(found.model, out / "model.toml")  # writes the weights, too
    else:
        texts["model.toml"] = write_model(found.model)
    for name, text in texts.items():
        with atomic_path(out / name) as temporary:
            temporary.write_text(text, encoding="utf-8")
    write_report(document, found.given_runs, report.models, out, found.title)
    write_recording(document, found.given_runs, report.models, out)


def _margin(report: Report, runs: Sequence[Run], out: Path) -> CalibratedMargin:
    """Calibrates the filter's margin for the diagnosed model; none if the data allowed no verdict."""
    path = out / "margin.toml"
    judged = report.verdict != "unexplained" if report.unexplained is None else report.unexplained.depends_on
    if not judged:
        path.unlink(missing_ok=True)  # a margin of an earlier diagnosis is for another model
        return CalibratedMargin()
    fewer = partial(subsample_runs, most_rows=_MARGIN_ROWS, horizon=report.horizon)
    return calibrate_margin_file(report.models[-1], runs, path, fewer)


def _draw_worst_window(panel: Axes, report: Report, runs: Sequence[Run]) -> None:
    """Draws the state that the given model predicts worst, in its worst window, with both models' predictions."""
    seconds = sum(run.duration for run in runs)
    given = compare_model(report.models[0], runs, report.horizon, every=max(EVERY, seconds / _PLOT_WINDOWS))
    window = given.windows.select(np.array([chosen_windows(given)[0][1]], dtype=np.int64))
    scaled = np.abs(given.errors[chosen_windows(given)[0][1]]) / np.where(
        given.error.scale > 0, given.error.scale, np.inf
    )
    state = int(np.nanargmax(scaled))
    rows = slice(int(window.start[0]), int(window.end[0]) + 1)
    time = window.clock[rows] - window.clock[rows.start]
    lines = {"measured": window.states[rows, state]}
    for name, model in (("before", report.models[0]), ("after", report.models[-1])):
        lines[name] = rollout(model, window)[: len(time), 0, state]
    for name, values in lines.items():
        panel.plot(time, values, color=COLOURS[name], label=name, linewidth=2 if name == "measured" else 1.2)
    variable = window.system.state[state]
    panel.set_title(f"worst window: {variable.name} [{variable.unit}]", fontsize="small")
    panel.set_xlabel("time [s]", fontsize="small")
    panel.legend(fontsize="x-small")
