"""``safedpa train-baselines``: PPO, TRPO, their Lagrangian kin and CPO on the point robot."""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path
from typing import Any

import click

from safedpa.errors import InputError
from safedpa.extras import needs
from safedpa_lab.point.plan import BASELINES, COST_LIMIT, INPUTS, MULTIPLIERS


@click.command(name="train-baselines")
@click.option(
    "--out",
    type=click.Path(path_type=Path, file_okay=False),
    default=Path("learned/point_baselines"),
    show_default=True,
)
@click.option("--names", metavar="NAME,NAME,...", help="which ones; all of ppo, trpo, both with _lagrangian, cpo")
@click.option("--tasks", metavar="NAME,NAME", help="still, wind; both when left out")
@click.option("--steps", type=click.IntRange(min=1), help="of each; 4 million when left out")
@click.option("--seeds", default="0", show_default=True, metavar="N,N,...", help="of training; one folder each")
@click.option("--inputs", type=click.Choice(INPUTS), default="lidar", show_default=True, help="what the policy gets")
@click.option("--limit", type=click.FloatRange(min=0.0), default=COST_LIMIT, show_default=True, help="of the cost")
@click.option("--cap", type=click.FloatRange(min=0.0), help="of the multiplier; none when left out")
@click.option("--multiplier", type=click.Choice(MULTIPLIERS), default=MULTIPLIERS[0], show_default=True)
@click.option("--filtered", type=click.FloatRange(0.0, 1.0), default=0.0, help="share of the steps behind the filter")
@click.option("--json", "as_json", is_flag=True, help="print one JSON document and nothing else")
@needs("train")
def command(
    out: Path, names: str | None, tasks: str | None, seeds: str, steps: int | None, as_json: bool, **plan: Any
) -> None:
    """Train the model-free baselines of the point robot: in still air (the benchmark's task), and in winds.

    Inputs: lidar is the benchmark's; latent adds what SafeDPA's history encoder knows; equal is all that SafeDPA's own
    policy gets. A baseline that exists already from the same plan is skipped. Writes weights, baselines.json with
    the learning curves, baselines.md and a picture of the curves.
    """
    from safedpa_lab.experiments.point.baselines import markdown_of, write_baselines
    from safedpa_lab.point.baseline_set import TASKS, baselines_in
    from safedpa_lab.point.baselines import train_baselines

    chosen = _split("--names", names, BASELINES), _split("--tasks", tasks, tuple(TASKS))
    numbers = _numbers(seeds)
    changes = plan if steps is None else {**plan, "steps": steps}
    train_baselines(out, *chosen, numbers, _report, changes)
    found = baselines_in(out, numbers[0])
    write_baselines(found, out)
    click.echo(json.dumps(found) if as_json else markdown_of(found))


def _numbers(seeds: str) -> tuple[int, ...]:
    parts = [part.strip() for part in seeds.split(",")]
    if not all(part.isdecimal() for part in parts):
        raise InputError(f"--seeds: got '{seeds}', wanted whole numbers with commas between, as 0,1,2")
    return tuple(int(part) for part in parts)


def _split(option: str, given: str | None, everything: tuple[str, ...]) -> tuple[str, ...]:
    if given is None:
        return everything
    chosen = tuple(name.strip() for name in given.split(",") if name.strip())
    if not chosen:
        raise InputError(f"{option}: got none, wanted one or more of {', '.join(everything)}")
    return chosen


def _report(phase: str, done: int, everything: int, note: str) -> None:
    """One line that stays where it is on a terminal, a line each elsewhere."""
    line = f"{time.strftime('%H:%M:%S')} {phase} {done}/{everything} {note}"
    click.echo(f"\r{line:<79}" if sys.stderr.isatty() else line, err=True, nl=not sys.stderr.isatty())
