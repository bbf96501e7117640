"""``safedpa train-baselines``: PPO, TRPO, their Lagrangian kin and CPO on the point robot."""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path

import click

from safedpa.errors import InputError
from safedpa.extras import needs

__all__ = ["command"]


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
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True)
@click.option("--json", "as_json", is_flag=True, help="print one JSON document and nothing else")
@needs("train")
def command(out: Path, names: str | None, tasks: str | None, steps: int | None, seed: int, as_json: bool) -> None:
    """Train the model-free baselines of the point robot: in still air (the benchmark's task), and in winds.

    A baseline that is there already from the same plan is skipped. Writes weights, baselines.json with the learning
    curves, baselines.md and a picture of the curves.
    """
    from safedpa_lab.experiments.point_baselines import markdown_of, write_baselines
    from safedpa_lab.point.baseline_set import TASKS, baselines_in, train_baselines
    from safedpa_lab.point.plan import BASELINES

    chosen = _split("--names", names, BASELINES), _split("--tasks", tasks, tuple(TASKS))
    train_baselines(out, *chosen, steps, seed, _tell)
    found = baselines_in(out)
    write_baselines(found, out)
    click.echo(json.dumps(found) if as_json else markdown_of(found))


def _split(option: str, given: str | None, everything: tuple[str, ...]) -> tuple[str, ...]:
    if given is None:
        return everything
    chosen = tuple(name.strip() for name in given.split(",") if name.strip())
    if not chosen:
        raise InputError(f"{option}: got none, wanted one or more of {', '.join(everything)}")
    return chosen


def _tell(phase: str, done: int, everything: int, note: str) -> None:
    """One line that stays where it is on a terminal, a line each elsewhere."""
    line = f"{time.strftime('%H:%M:%S')} {phase} {done}/{everything} {note}"
    click.echo(f"\r{line:<79}" if sys.stderr.isatty() else line, err=True, nl=not sys.stderr.isatty())
