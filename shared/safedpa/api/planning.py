"""``check_data`` and ``rehearse``: which effects recordings could show, before a diagnosis."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, final

from safedpa.api.inputs import Columns, Logs, Model, model_of, runs_of
from safedpa.diagnosis.identifiability.check import (
    IdentifiabilityCheck,
    as_document,
    check_identifiability,
    check_lines,
)
from safedpa.diagnosis.identifiability.rehearsal import RehearsalResult, RehearsalTrial, rehearse_diagnosis
from safedpa.diagnosis.report_schema import Detectable
from safedpa.errors import InputError
from safedpa.extras import need
from safedpa.progress import progress
from safedpa.report.comparison_figures import COLOURS
from safedpa.result import AbstractPlottedResult, Rows

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@final
@dataclass(frozen=True, repr=False, eq=False)
class DataCheck(AbstractPlottedResult):
    """Which effects recordings could show, and from which size on.

    ``details`` has the full check. The table of ``to_dataframe`` has one row per parameter of each effect that the
    model lacks. ``print(check)`` shows what ``safedpa diagnose --check`` prints.

    Example:

        >>> check = safedpa.check_data("frictionless.toml", "log.csv")
        >>> "wind" in [size.effect for size in check.sizes if size.shown]
        True
    """

    details: IdentifiabilityCheck

    @property
    def sizes(self) -> Rows[Detectable]:
        """For each parameter, the smallest change that is found with 95 % power, and the typical one."""
        return Rows("sizes", self.details.sizes)

    def to_dict(self) -> dict[str, Any]:
        """Returns the document that ``safedpa diagnose --check --json`` prints."""
        return as_document(self.details)

    def __str__(self) -> str:
        return "\n".join(check_lines(self.details))

    def _facts(self) -> dict[str, object]:
        found = self.details
        lists = {"found": found.identifiable(), "only_as_sums": found.only_as_sums(), "not_found": found.undetectable()}
        return {
            "robot": found.robot,
            "error": f"{found.error:.3g}",
            **{name: len(parts) for name, parts in lists.items()},
            **({"no_effect_because": found.why_not} if found.why_not else {}),
        }

    def _columns(self) -> dict[str, Sequence[Any]]:
        names = ("effect", "parameter", "unit", "smallest", "ordinary", "shown", "drive")
        return {name: [getattr(size, name) for size in self.details.sizes] for name in names}

    def _draw(self, figure: Figure) -> None:
        panel = figure.subplots()
        sizes = [size for size in self.details.sizes if size.smallest is not None][::-1]
        shares = [(size.smallest or 0.0) / size.ordinary for size in sizes]
        colours = [COLOURS["after" if size.shown else "before"] for size in sizes]
        panel.scatter(shares, [f"{size.effect} {size.parameter}" for size in sizes], color=colours)
        panel.axvline(1.0, color=COLOURS["measured"], linestyle=":")
        panel.set_xscale("log")
        panel.set_xlabel("smallest size that is found, as a share of the typical size", fontsize="small")
        panel.tick_params(labelsize="x-small")


@final
@dataclass(frozen=True, repr=False, eq=False)
class Rehearsal(AbstractPlottedResult):
    """Which hidden effects a diagnosis of simulated copies of recordings found.

    ``details`` has the trials and the check that predicted them. The table of ``to_dataframe`` has one row per trial.

    Example:

        >>> rehearsal = safedpa.rehearse("frictionless.toml", "log.csv", effect="viscous_friction")
        >>> [(trial.effect, trial.found) for trial in rehearsal.trials]
        [('viscous_friction', True)]
    """

    details: RehearsalResult

    @property
    def trials(self) -> Rows[RehearsalTrial]:
        """Each effect hidden at each size, whether it was found, and whether that was predicted."""
        return Rows("trials", self.details.trials)

    @property
    def agreeing(self) -> int:
        """Number of trials in which ``check_data`` predicted the result."""
        return self.details.agreeing

    def to_dict(self) -> dict[str, Any]:
        """Returns the document that ``safedpa rehearse --json`` prints."""
        trials = [asdict(trial) | {"named": list(trial.named)} for trial in self.details.trials]
        return {"format": 1, "trials": trials, "agreeing": self.agreeing}

    def _facts(self) -> dict[str, object]:
        found = [f"{trial.effect} {trial.size:.3g}" for trial in self.details.trials if trial.found]
        counts = f"{len(found)} of {len(self.details.trials)}"
        return {"found": counts, "named": ", ".join(found), "as_predicted": self.agreeing}

    def _columns(self) -> dict[str, Sequence[Any]]:
        names = ("effect", "parameter", "unit", "size", "found", "predicted", "verdict")
        return {name: [getattr(trial, name) for trial in self.details.trials] for name in names}

    def _draw(self, figure: Figure) -> None:
        panel = figure.subplots()
        trials = self.details.trials[::-1]
        colours = [COLOURS["after" if trial.found else "before"] for trial in trials]
        panel.barh(range(len(trials)), [trial.size for trial in trials], color=colours)
        panel.set_yticks(range(len(trials)), [f"{trial.effect} {trial.parameter}" for trial in trials])
        panel.set_xlabel("size of the hidden effect; blue: found", fontsize="small")
        panel.tick_params(labelsize="x-small")


def check_data(model: Model, runs: Logs, *, columns: Columns = None, effects: str | Path | None = None) -> DataCheck:
    """Computes which effects the recordings could show, in seconds and without a search.

    ``columns`` is as in ``read_log``, ``effects`` a Python file with the user's own effects. Raises InputError for a
    model of another robot, RunError for unusable recordings.

    Example:

        >>> safedpa.check_data("frictionless.toml", "log.csv").details.robot
        'pendulum'
    """
    need("diagnosis", what="check_data()")
    loaded = model_of(model, effects)
    recorded = runs_of(runs, loaded, columns)
    with progress("checking"):
        return DataCheck(check_identifiability(loaded, recorded))


def rehearse(
    model: Model,
    runs: Logs,
    *,
    columns: Columns = None,
    effects: str | Path | None = None,
    effect: str | Sequence[str] = (),
    size: float | Sequence[float] = (1.0,),
    seed: int = 0,
) -> Rehearsal:
    """Tests which effects a diagnosis of recordings like these would find.

    Simulates the runs with a hidden effect that the model lacks, with the commands and the noise of the runs, and
    diagnoses them: for each ``effect`` (a name or several; none: all of the library) and each ``size`` relative to its
    typical size. ``seed`` is that of the noise. Takes the time of one diagnosis per effect and size. Raises InputError
    for an unknown effect, a size of 0 or less, or a seed below 0; RunError for unusable recordings.

    Example:

        >>> safedpa.rehearse("frictionless.toml", "log.csv", effect="viscous_friction", size=[2.0]).agreeing
        1
    """
    need("diagnosis", what="rehearse()")
    sizes = [float(size)] if isinstance(size, (int, float)) else list(size)
    names = [effect] if isinstance(effect, str) else list(effect)
    if seed < 0 or not all(one > 0 for one in sizes):
        raise InputError(f"size {sizes}, seed {seed}: wanted sizes above 0, and a seed of 0 or more")
    loaded = model_of(model, effects)
    recorded = runs_of(runs, loaded, columns)
    with progress("rehearsing") as report_progress:
        return Rehearsal(rehearse_diagnosis(loaded, recorded, sizes, names, seed, report_progress))
