"""``calibrate``: the filter's margins from recorded drives."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, final

from safedpa.api.inputs import Model, model_of
from safedpa.calibration.from_recordings import calibration_from_recordings
from safedpa.comparison.output import refuse_inputs, require_writable_folder
from safedpa.report.comparison_figures import COLOURS
from safedpa.result import AbstractPlottedResult
from safedpa.safety.defaults import settings_named
from safedpa.safety.margins.calibration import MarginCalibration
from safedpa.safety.settings import FilterSettings
from safedpa.systems.robots import DEFAULT_ROBOT

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_MARGINS = ("conformal", "drive", "theorem")


@final
@dataclass(frozen=True, repr=False, eq=False)
class CalibratedMargins(AbstractPlottedResult):
    """Margins of the filter by kind of barrier, and the share of held-out data that they cover.

    ``calibration`` is what a filter uses, ``written`` the margin file, if any. The table of ``to_dataframe`` has one
    row per kind and margin: ``conformal`` for a step, ``drive`` for a whole drive, ``theorem`` from the bound.

    Example:

        >>> made = safedpa.calibrate("drive.mcap", coverage=0.9)
        >>> made.to_dataframe()["margin"].tolist()[:2], made.calibration.transitions > 100
        (['conformal', 'theorem'], True)
    """

    calibration: MarginCalibration
    written: Path | None = None

    def to_dict(self) -> dict[str, Any]:
        """Returns the document that ``safedpa calibrate --json`` prints; ``margin`` only with a file."""
        made = self.calibration
        document: dict[str, Any] = {} if self.written is None else {"margin": str(self.written)}
        document |= {name: dict(getattr(made, name)) for name in ("epsilon", "drive", "theorem", "covered")}
        return document | {name: getattr(made, name) for name in ("transitions", "drives", "coverage")}

    def __str__(self) -> str:
        made = self.calibration
        drives = f" of {made.drives} drives" if made.drives else ", too few drives for a margin of a whole drive"
        lines = [
            f"{made.transitions} transitions{drives}",
            f"coverage {made.coverage:g}; epsilon (coverage on held-out data)",
        ]
        for kind in made.epsilon:
            parts = [(name, table[kind]) for name, table in self._tables() if kind in table]
            shown = "   ".join(f"{name} {epsilon:.4f}{self._share(name, kind)}" for name, epsilon in parts)
            lines.append(f"  {kind:<10} {shown}")
        return "\n".join(lines)

    def _tables(self) -> list[tuple[str, dict[str, float]]]:
        made = self.calibration
        return list(zip(_MARGINS, (made.epsilon, made.drive, made.theorem), strict=True))

    def _share(self, name: str, kind: str) -> str:
        share = self.calibration.covered.get(f"{name}.{kind}")
        return "" if share is None else f" ({100 * share:.2f} %)"

    def _facts(self) -> dict[str, object]:
        made = self.calibration
        margins = ", ".join(f"{kind} {epsilon:.4f}" for kind, epsilon in made.epsilon.items())
        return {
            "epsilon": margins,
            "coverage": f"{made.coverage:g}",
            "transitions": made.transitions,
            "drives": made.drives,
        }

    def _columns(self) -> dict[str, Sequence[Any]]:
        rows = [(kind, name, epsilon) for name, table in self._tables() for kind, epsilon in table.items()]
        rows.sort(key=lambda row: list(self.calibration.epsilon).index(row[0]))
        covered = self.calibration.covered
        return {
            "kind": [kind for kind, _, _ in rows],
            "margin": [name for _, name, _ in rows],
            "epsilon": [epsilon for _, _, epsilon in rows],
            "covered": [covered.get(f"{name}.{kind}") for kind, name, _ in rows],
        }

    def _draw(self, figure: Figure) -> None:
        panel = figure.subplots()
        columns = self._columns()
        names = [f"{kind} {name}" for kind, name in zip(columns["kind"], columns["margin"], strict=True)]
        panel.barh(names[::-1], columns["epsilon"][::-1], color=COLOURS["bar"])
        panel.set_xlabel("epsilon, in the unit of h", fontsize="small")


def calibrate(
    recordings: str | Path | Sequence[str | Path],
    *,
    model: Model = DEFAULT_ROBOT,
    settings: str | FilterSettings = DEFAULT_ROBOT,
    coverage: float = 0.99,
    out: str | Path | None = None,
) -> CalibratedMargins:
    """Calibrates the filter's margins from recordings of the bus (MCAP) that were not used for fitting.

    A margin covers the amount by which h falls below its prediction, for the share ``coverage`` of the steps and of the
    drives. Four fifths of the drives give the margins; their coverage is measured on the last fifth. Fewer than 123
    drives (for 99 %) are cut into blocks instead and give no margin for a whole drive. ``settings`` is a file, a name
    or the settings themselves; ``out`` is the margin file to write. Raises InputError for too few transitions, or
    recordings of another model.

    Example:

        >>> sorted(safedpa.calibrate("drive.mcap", coverage=0.9, out="margin.toml").calibration.epsilon)
        ['field', 'obstacle', 'speed']
    """
    paths = [Path(recordings)] if isinstance(recordings, (str, Path)) else [Path(path) for path in recordings]
    written = None if out is None else Path(out)
    if written is not None:
        refuse_inputs([written], paths)
        require_writable_folder(written.parent)
    chosen = settings_named(settings) if isinstance(settings, str) else settings
    made = calibration_from_recordings(model_of(model), chosen, paths, coverage, time.strftime("%Y-%m-%d"))
    if written is not None:
        made.save(written)
    return CalibratedMargins(made, written)
