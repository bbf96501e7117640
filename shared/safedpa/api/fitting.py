"""``add``, ``refit`` and ``remove``: changes of a model that the user chooses, and what they do to its error."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, final

from safedpa.api.inputs import Columns, Logs, Model, files_of, model_of, runs_of
from safedpa.comparison.output import refuse_inputs, require_writable_file
from safedpa.diagnosis.add_effect import add_effect
from safedpa.diagnosis.interactive import first_step, given_error, with_final
from safedpa.diagnosis.report_schema import FittedValue
from safedpa.dynamics import PhysicsModel, Setting, save_model
from safedpa.effects import Varies, Where
from safedpa.effects.law import law_of
from safedpa.errors import InputError, did_you_mean
from safedpa.extras import need
from safedpa.report.comparison_figures import COLOURS
from safedpa.report.diagnosis_lines import value_text
from safedpa.result import AbstractPlottedResult

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@final
@dataclass(frozen=True, repr=False, eq=False)
class FittedModel(AbstractPlottedResult):
    """A changed and fitted model.

    ``model`` is the new one; ``effect`` was added or removed (empty for ``refit``); ``before`` and ``after`` are the
    errors on held-out data after ``horizon`` [s], as shares of the usual change. ``parameters`` are the fitted ones by
    path. ``sentence`` says where or when the effect acts; empty if always. The table of ``to_dataframe`` has one row
    per fitted parameter.

    Example:

        >>> fitted = safedpa.add("frictionless.toml", "viscous_friction", "log.csv")
        >>> fitted.after < fitted.before, list(fitted.parameters)
        (True, ['viscous_friction.coefficient'])
    """

    model: PhysicsModel
    effect: str
    before: float
    after: float
    horizon: float
    parameters: dict[str, FittedValue]
    sentence: str = ""

    def to_dict(self) -> dict[str, Any]:
        """Returns the document that ``safedpa add --json`` prints; errors that are not finite become null."""
        errors = {"before": self.before, "after": self.after}
        return {
            "format": 1,
            **({"effect": self.effect} if self.effect else {}),
            **{name: value if math.isfinite(value) else None for name, value in errors.items()},
            "parameters": {path: vars(value) for path, value in self.parameters.items()},
            **({"sentence": self.sentence} if self.sentence else {}),
        }

    def __str__(self) -> str:
        change = f" ({100 * (self.after / self.before - 1):+.1f} %)" if self.before > 0 else ""
        there = any(item.name == self.effect for item in self.model.effects)
        what = f" {'with' if there else 'without'} {self.effect}" if self.effect else ""
        error = f"held-out error after {self.horizon:g} s: {self.before:.4g} before, {self.after:.4g}{what}{change}"
        values = [value_text(path, value) for path, value in self.parameters.items()]
        return "\n".join([*([self.sentence] if self.sentence else []), *values, error])

    def _facts(self) -> dict[str, object]:
        return {
            "effect": self.effect or "none",
            "before": f"{self.before:.4g}",
            "after": f"{self.after:.4g}",
            "parameters": ", ".join(value_text(path, value) for path, value in self.parameters.items()),
        }

    def _columns(self) -> dict[str, Sequence[Any]]:
        names = ("value", "std", "unit")
        fitted = self.parameters
        return {"parameter": list(fitted)} | {name: [getattr(one, name) for one in fitted.values()] for name in names}

    def _draw(self, figure: Figure) -> None:
        panel = figure.subplots()
        panel.barh(["after", "before"], [self.after, self.before], color=[COLOURS["after"], COLOURS["before"]])
        panel.set_title(f"error on held-out data after {self.horizon:g} s {self.effect}", fontsize="small")


def add(
    model: Model,
    effect: str,
    runs: Logs,
    *,
    columns: Columns = None,
    horizon: float = 1.0,
    effects: str | Path | None = None,
    where: str | None = None,
    varies: str | None = None,
    edge: float = 0.05,
    out: str | Path | None = None,
    force: bool = False,
) -> FittedModel:
    """Adds one effect of the user's choice to a model and fits it to recordings.

    With ``where`` ('x above', 'abs_speed below', 'circle', 'strip') the effect acts in a region only, whose edge is
    ``edge`` wide; with ``varies`` ('gain with time', 'gain with abs_speed') one of its parameters varies. The borders
    of the region and the dependence are fitted as well. Errors are those after ``horizon`` [s]. ``out`` is the file for
    the new model; an input is replaced only with ``force``. Raises InputError for an unknown effect, one that the model
    has, or a law that does not suit it; RunError for unusable recordings.

    Example:

        >>> str(safedpa.add("frictionless.toml", "viscous_friction", "log.csv")).splitlines()[0][:33]
        'viscous_friction.coefficient 0.20'
    """
    need("diagnosis", what="add()")
    loaded = model_of(model, effects)
    law = _law(where, varies, edge, effect)
    _check_out(out, files_of(model, runs, columns, effects), force)
    found = add_effect(loaded, effect, runs_of(runs, loaded, columns), horizon, law)
    made = FittedModel(
        found.model, effect, found.before.value, found.after.value, horizon, found.values, found.sentence
    )
    return _saved(made, out)


def refit(
    model: Model,
    runs: Logs,
    *,
    free: str | Sequence[str] = (),
    columns: Columns = None,
    horizon: float = 1.0,
    effects: str | Path | None = None,
    out: str | Path | None = None,
    force: bool = False,
) -> FittedModel:
    """Fits the free parameters of a model to recordings, and those that ``free`` names.

    ``free`` has paths such as 'base.drive_gain' or names of effects, whose parameters are all fitted. Other arguments
    are as in ``add``. Raises InputError if nothing is free or a name is unknown, RunError for unusable recordings.

    Example:

        >>> again = safedpa.refit("friction.toml", "log.csv", free="viscous_friction")
        >>> round(again.parameters["viscous_friction.coefficient"].value, 1)
        0.2
    """
    need("diagnosis", what="refit()")
    loaded = model_of(model, effects)
    marked = _freed(loaded, [free] if isinstance(free, str) else free)
    _check_out(out, files_of(model, runs, columns, effects), force)
    step = first_step(marked, runs_of(runs, loaded, columns), horizon)
    fitted = with_final(step)
    values = fitted.values
    settings = {path: Setting(value.value, loaded.settings[path].free) for path, value in values.items()}
    made = FittedModel(
        loaded.with_settings(settings), "", given_error(loaded, step), fitted.error.value, horizon, values
    )
    return _saved(made, out)


def remove(
    model: Model,
    effect: str,
    runs: Logs,
    *,
    columns: Columns = None,
    horizon: float = 1.0,
    effects: str | Path | None = None,
    out: str | Path | None = None,
    force: bool = False,
) -> FittedModel:
    """Removes one effect from a model, fits the free parameters and the other effects again, and compares the errors.

    Arguments are as in ``add``. Raises InputError for an effect that the model does not have, RunError for unusable
    recordings.

    Example:

        >>> without = safedpa.remove("friction.toml", "viscous_friction", "log.csv")
        >>> without.model.effects, without.after > without.before
        ((), True)
    """
    need("diagnosis", what="remove()")
    loaded = model_of(model, effects)
    names = [item.name for item in loaded.effects]
    if effect not in names:
        raise InputError(f"effect '{effect}': the model does not have it; {did_you_mean(effect, names)}")
    _check_out(out, files_of(model, runs, columns, effects), force)
    rest = {path: setting for path, setting in loaded.settings.items() if path.split(".")[0] != effect}
    kept = [item for item in loaded.effects if item.name != effect]
    # The other effects have compensated for this one, or the one for them.
    marked = {path: replace(setting, free=setting.free or path[:5] != "base.") for path, setting in rest.items()}
    without = PhysicsModel(loaded.base, kept, marked, loaded.period, loaded.holds)
    step = first_step(without, runs_of(runs, loaded, columns), horizon)
    fitted = with_final(step)
    settings = {path: replace(fitted.model.settings[path], free=setting.free) for path, setting in rest.items()}
    made = FittedModel(
        fitted.model.with_settings(settings),
        effect,
        given_error(loaded, step),
        fitted.error.value,
        horizon,
        fitted.values,
    )
    return _saved(made, out)


def _freed(model: PhysicsModel, free: Sequence[str]) -> PhysicsModel:
    """Returns the model with the named parameters marked free."""
    owners = {path.split(".")[0] for path in model.settings}
    for name in free:
        if name not in model.settings and name not in owners:
            raise InputError(f"free: got '{name}'; {did_you_mean(name, [*owners, *model.settings])}")
    named = [path for path in model.settings if path in free or path.split(".")[0] in free]
    marked = model.with_settings({path: replace(model.settings[path], free=True) for path in named})
    if not marked.latent_names:
        raise InputError(f"free: no parameter is free; name some of {', '.join(model.settings)}")
    return marked


def _law(where: str | None, varies: str | None, edge: float, effect: str) -> Where | Varies | None:
    if where is not None and varies is not None:
        raise InputError("where, varies: got both, wanted one of them")
    if where is not None:
        return law_of("where", where, edge, effect)
    return None if varies is None else law_of("varies", varies, None, effect)


def _check_out(out: str | Path | None, read: list[str | Path], force: bool) -> None:
    if out is not None:
        refuse_inputs([Path(out)], read, force)
        require_writable_file(Path(out))


def _saved(made: FittedModel, out: str | Path | None) -> FittedModel:
    if out is not None:
        save_model(made.model, Path(out))
    return made
