"""``safedpa experiment tuning``: what tuning the car's networks reaches, row by row and metric by metric."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click

from safedpa.errors import InputError, did_you_mean
from safedpa.extras import needs
from safedpa_lab.provenance.record import KEY, provenance, write_result

__all__ = ["command"]

_PARTS = ("car", "real")


@click.command(name="tuning")
@click.option("--models", type=click.Path(path_type=Path), default=Path("learned/car"), show_default=True,
              help="folder of car_simulated and car_learned; those that ship where it has none")  # fmt: skip
@click.option("--data", type=click.Path(path_type=Path), help="folder with recordings of the real car; without it they "
              "are left out")  # fmt: skip
@click.option("--part", "parts", multiple=True, help="only this part (car, real); may be repeated")
@click.option("--row", "rows", multiple=True, help="only this row of the car's table; may be repeated")
@click.option("--seed", type=int, default=0, show_default=True, help="of trainings and fresh drives")
@click.option("--drives", type=int, default=10, show_default=True, help="fresh drives with each load")
@click.option("--small", is_flag=True, help="trainings of seconds, to see that it runs; the figures mean nothing")
@click.option("--out", type=click.Path(path_type=Path), help="folder for tuning.json, tuning.md, and what is kept")
@click.option("--json", "as_json", is_flag=True, help="print one JSON document and nothing else")
@needs("train")
def command(**options: Any) -> None:
    """Tune the car's networks in every way, and compare them on fresh drives, with loads and without.

    With --out a run that was cut off goes on where it stopped.
    """
    from safedpa_lab.experiments.tuning import CarTuning, car_tuning
    from safedpa_lab.experiments.tuning_page import tuning_page
    from safedpa_lab.experiments.tuning_real import RealTuning, real_tuning

    out, parts = options["out"], options["parts"] or _PARTS
    for part in parts:
        if part not in _PARTS:
            raise InputError(f"--part {part}: {did_you_mean(part, _PARTS)}")
    if options["parts"] == ("real",) and options["data"] is None:
        raise InputError("--part real: got no --data, wanted the folder with recordings of the real car")
    real = RealTuning(options["data"], out, options["seed"], options["small"])  # refused before, not after, long work
    result: dict[str, Any] = {"experiment": "tuning", "seed": options["seed"]}
    if "car" in parts:
        chosen = {"rows": options["rows"]} if options["rows"] else {}
        own = {name: options[name] for name in ("models", "out", "seed", "drives", "small")}
        result["car"] = car_tuning(CarTuning(**own, **chosen), _report)
    if "real" in parts:
        result["real"] = real_tuning(real, _report)
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        write_result(out / "tuning.json", result)
    page = tuning_page({**result, KEY: provenance()})
    if out is not None:
        (out / "tuning.md").write_text(page, encoding="utf-8")
    click.echo(json.dumps(result) if options["as_json"] else page)


def _report(what: str) -> None:
    click.echo(f"experiment tuning: {what}", err=True)
