"""The car experiment's predicted trajectories and latents as a recording for the viewer."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from safedpa_lab.experiments.car_paths import FIRST_STEPS
from safedpa_lab.experiments.car_style import BLACK, LOADS, MODELS

__all__ = ["write_recording"]


def write_recording(result: dict[str, Any], path: Path) -> None:
    """Driven and predicted paths by configuration, latents by load; nothing is written when neither was run."""
    import rerun as rr

    if "paths" not in result and "latent" not in result:
        return
    with rr.RecordingStream("safedpa_car_experiment", recording_id="safedpa_car_experiment") as stream:
        stream.save(path)
        for row in result.get("paths", []):
            _paths(stream, row)
        for name, rows in result.get("latent", {}).items():
            for load, points in rows["points"]["by_load"].items():
                entity = f"latent/{name}/{load}"
                stream.log(entity, rr.Points2D(points, colors=_colour(LOADS[load][0]), radii=0.01), static=True)


def _paths(stream: Any, row: dict[str, Any]) -> None:
    import rerun as rr

    folder = f"predictions/{row['load']}"
    driven = rr.LineStrips2D([row["driven"]], colors=_colour(BLACK), radii=0.015)
    stream.log(f"{folder}/driven", driven, static=True)
    start = row["driven"][FIRST_STEPS]
    for name, found in row["predicted"].items():
        line = rr.LineStrips2D([[start, *found["path"]]], colors=_colour(MODELS[name][0]), radii=0.01)
        stream.log(f"{folder}/{name}", line, static=True)


def _colour(text: str) -> list[int]:
    return [int(text[index : index + 2], 16) for index in (1, 3, 5)]
