"""``safedpa experiment point-learning``: the point robot's policy goes on learning while the filter holds."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

import click

from safedpa.errors import InputError
from safedpa.extras import needs
from safedpa_lab.commands.folder import made_folder

__all__ = ["command"]

_QUICK = {"steps": 4096, "seeds": (0,), "robots": 16}


@click.command(name="point-learning")
@click.option("--starts", default="shipped,nothing", show_default=True, metavar="NAME,NAME", help="also: careless")
@click.option("--steps", type=int, default=250_000, show_default=True, help="of each learning, all its robots together")
@click.option("--seeds", default="0,1,2", show_default=True, metavar="N,N,...", help="of training")
@click.option("--robots", type=int, default=64, show_default=True, help="that drive at once for one policy")
@click.option("--episodes", type=int, default=1, show_default=True, help="of each of 24 winds, by which it is judged")
@click.option("--force", type=float, default=0.008, show_default=True, help="N, of the wind")
@click.option("--margin", type=float, metavar="M", help="of the filter; what 'experiment point' found when left out")
@click.option("--seed", type=int, default=2500, show_default=True, help="of layouts, goals and winds")
@click.option("--processes", type=int, default=1, show_default=True)
@click.option(
    "--record", type=click.Path(path_type=Path), metavar="FILE", help="keep learnings there, and go on with it"
)
@click.option("--quick", is_flag=True, help="4096 steps, 16 robots, one training seed")
@click.option("--out", type=click.Path(path_type=Path), help="folder for tables, JSON and picture")
@click.option("--json", "as_json", is_flag=True, help="print one JSON document and nothing else")
@needs("train")
def command(
    starts: str, seeds: str, margin: float | None, quick: bool, out: Path | None, as_json: bool, **options: Any
) -> None:
    """A policy of the point robot goes on learning by PPO in winds, behind SafeDPA's filter; the same without it.

    Starts: shipped is the PPO-Lagrangian that is told lidar and z; nothing is a fresh network that is told what
    SafeDPA's policy is; careless is a PPO that was told the same. Every step of the learning is counted, and the
    policies are judged before and after. A record is gone on with from the last whole learning.
    """
    from safedpa_lab.experiments.point_learning import PointLearning, point_learning
    from safedpa_lab.experiments.point_learning_report import learning_markdown, write_learning
    from safedpa_services.progress import progress

    options |= {"starts": _text(starts), "seeds": _numbers(seeds)} | ({} if margin is None else {"margin": margin})
    experiment = PointLearning(**{**options, **(_QUICK if quick else {})}, date=time.strftime("%Y-%m-%d"))
    made_folder(out)
    with progress("experiment point-learning") as report_progress:
        result = point_learning(experiment, report_progress)
    if out is not None:
        write_learning(result, out)
    click.echo(json.dumps(result) if as_json else learning_markdown(result))


def _text(given: str) -> tuple[str, ...]:
    return tuple(part.strip() for part in given.split(",") if part.strip())


def _numbers(given: str) -> tuple[int, ...]:
    parts = _text(given)
    if not all(part.isdecimal() for part in parts):
        raise InputError(f"--seeds: got '{given}', wanted whole numbers with commas between, as 0,1,2")
    return tuple(int(part) for part in parts)
