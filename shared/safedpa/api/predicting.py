"""``predict``: open-loop predictions of a model along a recording."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, final

from safedpa.api.inputs import Columns, Model, files_of, model_of, runs_of
from safedpa.arrays import FloatArray
from safedpa.comparison.output import refuse_inputs, require_writable_file
from safedpa.comparison.rollout import predict_run
from safedpa.extras import need
from safedpa.records.run import Run
from safedpa.records.writers.tables import write_columns
from safedpa.report.comparison_figures import COLOURS
from safedpa.result import AbstractPlottedResult

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@final
@dataclass(frozen=True, repr=False, eq=False)
class PredictedRun(AbstractPlottedResult):
    """Predictions along a recording, from every tenth row, up to a horizon.

    ``table`` has the columns ``start_t`` and ``t`` [s] and the predicted states by name, each (predictions,), sorted by
    start and time. ``run`` is the recording, ``horizon`` [s] how far is predicted, ``written`` the file, if any.

    Example:

        >>> predicted = safedpa.predict("frictionless.toml", "log.csv", 0.5)
        >>> list(predicted.to_dataframe().columns), predicted.starts
        (['start_t', 't', 'angle', 'rate'], 60)
    """

    table: dict[str, FloatArray]
    run: Run
    horizon: float
    written: Path | None = None

    @property
    def starts(self) -> int:
        """Number of rows from which was predicted."""
        return len(set(self.table["start_t"].tolist()))

    def to_dict(self) -> dict[str, Any]:
        """Returns the document that ``safedpa predict --json`` prints; ``written`` only with a file."""
        written = {} if self.written is None else {"written": str(self.written)}
        return written | {"predictions": len(self.table["t"]), "starts": self.starts, "horizon": self.horizon}

    def _facts(self) -> dict[str, object]:
        return {"run": self.run.name, **self.to_dict(), "horizon": f"{self.horizon:g} s"}

    def _columns(self) -> dict[str, Sequence[Any]]:
        return {name: values.tolist() for name, values in self.table.items()}

    def _draw(self, figure: Figure) -> None:
        states = self.run.system.state
        panels = figure.subplots(1, len(states), squeeze=False)[0]
        starts = sorted(set(self.table["start_t"].tolist()))
        zero = float(self.run.t[0])
        for index, (panel, state) in enumerate(zip(panels, states, strict=True)):
            for t, measured, _ in self.run.parts():
                panel.plot(t - zero, measured[:, index], color=COLOURS["measured"], linewidth=0.8)
            # Starts a horizon apart: overlapping predictions would hide each other.
            last = -float("inf")
            for start in starts:
                if start >= last + self.horizon:
                    last, rows = start, self.table["start_t"] == start
                    panel.plot(self.table["t"][rows] - zero, self.table[state.name][rows], color=COLOURS["model"])
            panel.set_title(f"{state.name} [{state.unit}]", fontsize="small")
            panel.set_xlabel("time [s]; blue: predicted", fontsize="small")


def predict(
    model: Model,
    run: Run | str | Path,
    horizon: float,
    *,
    columns: Columns = None,
    effects: str | Path | None = None,
    out: str | Path | None = None,
    force: bool = False,
) -> PredictedRun:
    """Predicts a recording with a model, open loop, from every tenth row, ``horizon`` [s] ahead.

    Each prediction starts at the measured state and uses only the recorded actions. ``columns`` is as in ``read_log``,
    ``effects`` a Python file with the user's own effects, ``out`` a CSV file to write. Raises InputError for an
    unusable horizon or a model of another robot, RunError for an unusable recording.

    Example:

        >>> safedpa.predict("frictionless.toml", "log.csv", 0.5).table["angle"].shape
        (599,)
    """
    need("diagnosis", what="predict()")
    if out is not None:
        refuse_inputs([Path(out)], files_of(model, run, columns, effects), force)
    loaded = model_of(model, effects)
    recorded = runs_of(run, loaded, columns)[0]
    if out is not None:
        require_writable_file(Path(out))
    table = predict_run(loaded, recorded, horizon)
    if out is not None:
        write_columns(table, Path(out), "csv")
    return PredictedRun(table, recorded, horizon, None if out is None else Path(out))
