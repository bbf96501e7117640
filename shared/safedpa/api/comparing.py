"""``compare``: how large a model's error on recordings is, and where."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, final

from safedpa.api.inputs import Columns, Logs, Model, files_of, model_of, runs_of, title_of
from safedpa.comparison.comparison import PREDICTORS, Comparison, compare_model
from safedpa.comparison.output import results_folder
from safedpa.comparison.summary import as_json, bin_text, worse_sentence, worst_bins
from safedpa.extras import need
from safedpa.progress import progress
from safedpa.report.comparison_figures import COLOURS
from safedpa.report.comparison_page import compare_page, write_comparison
from safedpa.result import AbstractPlottedResult, Rows

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_WRITTEN = ("compare.html", "compare.json")


@final
@dataclass(frozen=True, repr=False, eq=False)
class ComparisonResult(AbstractPlottedResult):
    """A model compared with recordings.

    ``details`` has every number as arrays, ``title`` is the model's name in reports, ``change`` says which states a
    model predicts worse than the one ``before`` (empty without one). The table of ``to_dataframe`` has the error of
    each state at each horizon, in the state's unit. ``print(result)`` shows the summary.

    Example:

        >>> result = safedpa.compare("frictionless.toml", "log.csv")
        >>> result.error < 0.1, list(result.to_dataframe().columns)
        (True, ['seconds', 'state', 'unit', 'model', 'no_change', 'constant_velocity'])
    """

    details: Comparison
    title: str
    change: str = ""

    @property
    def error(self) -> float:
        """Error after the horizon, as a share of the usual change of each state, mean over the states."""
        return self.details.error.value

    @property
    def summary(self) -> tuple[str, ...]:
        """Sentences: where the model fails, which state is worst, and how good naive predictors are."""
        return (*self.to_dict()["summary"], *([self.change] if self.change else []))

    @property
    def where(self) -> Rows[Any]:
        """The error in ranges of each variable, the worst first."""
        return Rows("where", worst_bins(self.details))

    @property
    def runs(self) -> Rows[Any]:
        """The error in each run."""
        return Rows("runs", self.details.runs)

    @property
    def findings(self) -> Rows[Any]:
        """What was found in the data, by run."""
        return Rows("findings", self.to_dict()["data_quality"])

    def to_dict(self) -> dict[str, Any]:
        """Returns the document that ``safedpa compare --json`` prints."""
        return as_json(self.details) | ({"change": self.change} if self.change else {})

    def to_html(self, path: str | Path) -> Path:
        """Writes the page of ``safedpa compare``, with all figures, and returns its path."""
        need("diagnosis", what="to_html()")
        written = Path(path)
        written.write_text(compare_page(self.details, self.title), encoding="utf-8")
        return written

    def __str__(self) -> str:
        return "\n".join(self.summary)

    def _facts(self) -> dict[str, object]:
        naive = self.details.horizons[-1].errors
        worst = worst_bins(self.details)
        return {
            "model": self.title,
            "error": f"{self.error:.3g}",
            **{name: f"{naive[name].value:.3g}" for name in PREDICTORS[1:]},
            "horizon": f"{self.details.horizon:g} s",
            "worst": bin_text(worst[0], 40) if worst else "",
            "runs": len(self.details.runs),
            "findings": len(self.details.findings),
        }

    def _columns(self) -> dict[str, Sequence[Any]]:
        states = list(enumerate(self.details.windows.system.state))
        cells = [(item, index, state) for item in self.details.horizons for index, state in states]
        columns: dict[str, Sequence[Any]] = {
            "seconds": [item.seconds for item, _, _ in cells],
            "state": [state.name for _, _, state in cells],
            "unit": [state.unit for _, _, state in cells],
        }
        for name in PREDICTORS:
            errors = [(item.errors[name], index) for item, index, _ in cells]
            columns[name] = [float(error.per_state[index] * error.scale[index]) for error, index in errors]
        return columns

    def _draw(self, figure: Figure) -> None:
        states = self.details.windows.system.state
        panels = figure.subplots(1, len(states) + 1, squeeze=False)[0]
        seconds = [0.0, *(item.seconds for item in self.details.horizons)]
        for index, (panel, state) in enumerate(zip(panels, states, strict=False)):
            for name in PREDICTORS:
                errors = [item.errors[name] for item in self.details.horizons]
                values = [0.0, *(error.per_state[index] * error.scale[index] for error in errors)]
                panel.plot(seconds, values, color=COLOURS[name], label=name.replace("_", " "))
            panel.set_title(f"{state.name} [{state.unit}]", fontsize="small")
            panel.set_xlabel("horizon [s]", fontsize="small")
        panels[0].legend(fontsize="x-small")
        worst = worst_bins(self.details)[:6][::-1]
        panels[-1].barh([bin_text(item, 20) for item in worst], [item.error for item in worst], color=COLOURS["bar"])
        panels[-1].axvline(self.error, color=COLOURS["model"], linestyle=":")
        panels[-1].set_title("worst ranges; dotted: average", fontsize="small")
        panels[-1].tick_params(labelsize="x-small")


def compare(
    model: Model,
    runs: Logs,
    *,
    columns: Columns = None,
    horizon: float = 1.0,
    effects: str | Path | None = None,
    before: Model | None = None,
    out: str | Path | None = None,
    force: bool = False,
) -> ComparisonResult:
    """Compares a model with recordings: predicts open loop from a start every 0.1 s, ``horizon`` [s] ahead.

    ``columns`` is as in ``read_log``. ``effects`` is a Python file with the user's own effects, systems and robots.
    With ``before``, an earlier model, the result also says which states got worse. With ``out``, a folder, it writes
    compare.html and compare.json, and replaces an input or an earlier result only with ``force``. Raises InputError for
    an unusable horizon or a model of another robot, RunError for unusable recordings.

    Example:

        >>> safedpa.compare("frictionless.toml", "log.csv", horizon=0.5).runs[0].windows
        295
    """
    need("diagnosis", what="compare()")
    loaded = model_of(model, effects)
    earlier = None if before is None else model_of(before)
    read = files_of(model, runs, columns, effects, before)
    folder = None if out is None else Path(out)
    with nullcontext() if folder is None else results_folder(folder, _WRITTEN, read, force):
        recorded = runs_of(runs, loaded, columns)
        with progress("comparing") as report_progress:
            report_progress(0, 2)
            comparison = compare_model(loaded, recorded, horizon)
            report_progress(1, 2)
            change = "" if earlier is None else worse_sentence(compare_model(earlier, recorded, horizon), comparison)
            if folder is not None:
                write_comparison(comparison, folder, title_of(model))
    return ComparisonResult(comparison, title_of(model), change)
