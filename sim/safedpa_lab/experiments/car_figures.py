"""The figures of the car experiment: each only if its part was run."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from safedpa_lab.experiments.car_figure_errors import errors_figure
from safedpa_lab.experiments.car_figure_latent import latent_figure
from safedpa_lab.experiments.car_figure_margin import margin_figure
from safedpa_lab.experiments.car_figure_paths import paths_figure
from safedpa_lab.experiments.car_figure_table import table_figure

__all__ = ["write_figures"]


def write_figures(result: dict[str, Any], out: Path) -> list[Path]:
    """``car_table.png``, ``car_predictions.png``, ``car_errors.png``, ``car_latent.png`` and ``car_margin.png``.

    Returns the paths of those written.
    """
    drawings = (
        ("cells", "car_table.png", table_figure),
        ("paths", "car_predictions.png", paths_figure),
        ("errors", "car_errors.png", errors_figure),
        ("latent", "car_latent.png", latent_figure),
        ("margin", "car_margin.png", margin_figure),
    )
    written = []
    for part, name, draw in drawings:
        if result.get(part):
            draw(result, out / name)
            written.append(out / name)
    return written
